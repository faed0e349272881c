"""Three Ray nodes on one machine, a proxy and replicas on each, a Redis for the head and one address in front.

With `namespaces` every node has a network namespace and an address of its own (`ip netns`, as root), so that the
network between two of them can be cut. Without, they share 127.0.0.1 and have ports of their own, and the kernel gives
the connections to the proxies' common port to one of them. A node is what `ray start --block` makes; to kill one is to
kill all its processes at once.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from rlservo.serve_app.ray_serve.environment import cluster_environment, proxy_files, proxy_ports
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.server.api_keys import new_key
from speed.catalogue import Case, asked
from speed.cluster import SHIPPED, Cluster, replica_ports
from speed.machine import Process
from speed.servers import Exchange, Server, StartError, environment, listening, stop

NODES, SPARE = 3, 1
MAX_QUEUE_MS = 10_000.0  # four nodes on one machine stand still while one of them starts: not what is counted here
START_S = 120.0
NOBODY = "02:00:00:00:00:fe"  # a hardware address that no interface has: what is sent there is lost without a word
KEY, _LINE = new_key("operator", admin=True)
# A front such as a cloud's load balancer or a Kubernetes Service: it asks each node whether it can answer.
FRONT = """global
    maxconn 4000
defaults
    mode tcp
    timeout connect 1s
    timeout client 1d
    timeout server 1d
    timeout check 3s
    retries 3
    option redispatch 1
    option httpchk GET /v2/health/ready
    default-server check inter 1s fall 2 rise 1 on-marked-down shutdown-sessions
"""


class Unsupported(StartError):
    """What this machine lacks."""


@dataclass
class Node:
    """One node: its address, and the process that holds it while it runs."""

    number: int
    address: str
    home: Path
    variables: dict[str, str]
    namespace: str | None = None
    server: Server | None = None

    @property
    def log(self) -> Path:
        return self.home / "ray.log"

    def command(self, *words: str) -> list[str]:
        """Return a command that runs in the node's network."""
        return [*words] if self.namespace is None else ["ip", "netns", "exec", self.namespace, *words]

    def start(self, words: list[str], mark: str) -> None:
        """Start the node; returns at once."""
        command = self.command(sys.executable, "-m", "rlservo.serve_app.ray_serve.ray_node", "start", "--block", *words)
        self.server = Server(f"node {self.number}", command, 0, NOTHING, env=self.variables)
        self.server.mark = f"{mark}:{self.number}:{secrets.token_hex(4)}"
        with self.log.open("wb") as output:
            self.server.process = subprocess.Popen(
                command, env=environment(self.server.mark, self.variables), cwd=self.home, stdout=output,
                stderr=output, start_new_session=True,
            )  # fmt: skip

    def members(self) -> dict[int, Process]:
        return {} if self.server is None else self.server.members()

    def has_joined(self) -> bool:
        return "Ray runtime started." in self.log.read_text(errors="replace")

    def runs(self) -> bool:
        return self.server is not None and self.server.process is not None and self.server.process.poll() is None

    def kill(self) -> None:
        """SIGKILL to all of the node's processes, again until none is left: as when its power goes."""
        assert self.server is not None and self.server.process is not None
        while members := self.server.members():
            for pid in members:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self.server.process.poll()
            time.sleep(0.02)
        self.server = None

    def stop(self) -> None:
        if self.server is not None:
            stop(self.server)
            self.server = None


NOTHING = Exchange("GET", "/", b"")


@dataclass
class Nodes(Cluster):
    """The nodes of one cluster, of which the first is the head."""

    nodes: list[Node] = field(default_factory=list)
    redis: subprocess.Popen[bytes] | None = None
    gcs_port: int = 6379
    client_port: int = 10001
    mark: str = ""

    @property
    def head(self) -> Node:
        return self.nodes[0]

    def start(self, node: Node) -> None:
        """Start one node of the cluster."""
        words = [
            f"--node-ip-address={node.address}",
            "--num-cpus=2",
            "--num-gpus=0",
            f"--object-store-memory={80 << 20}",
        ]
        if node is self.head:
            # Ray takes other nodes' processes, which name this address, for a head that runs here already.
            (self.folder / "r" / "ray_current_cluster").unlink(missing_ok=True)
            words += ["--head", f"--port={self.gcs_port}", f"--dashboard-host={node.address}"]
            words += [
                f"--dashboard-port={self.dashboard}",
                f"--temp-dir={self.folder / 'r'}",
                f"--ray-client-server-port={self.client_port}",
            ]
        else:
            words.append(f"--address={self.head.address}:{self.gcs_port}")
        node.start(words, self.mark)

    def start_redis(self) -> None:
        """Start Redis with what its file has. Raises StartError."""
        program = shutil.which("redis-server")
        if program is None:
            raise Unsupported("GCS fault tolerance needs the program redis-server (Debian's redis-server)")
        host, _, port = self.variables["RAY_REDIS_ADDRESS"].rpartition(":")
        words = ["--bind", host, "--port", port, "--protected-mode", "no", "--appendonly", "yes"]
        words += ["--dir", str(self.folder)]
        self.redis = subprocess.Popen([program, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _until(lambda: listening(int(port), host), None)

    def stop_redis(self, *, kill: bool = False) -> None:
        if self.redis is not None:
            self.redis.send_signal(signal.SIGKILL if kill else signal.SIGTERM)
            self.redis.wait()
            self.redis = None

    def await_head(self) -> None:
        """Return when the head's dashboard listens. Raises StartError."""
        _until(lambda: listening(self.dashboard, self.host), self.head)

    def cut(self, one: Node, other: Node) -> None:
        """Lose every packet between two nodes."""
        for here, there in ((one, other), (other, one)):
            self._neighbour("replace", here, there, "lladdr", NOBODY, "nud", "permanent")

    def mend(self, one: Node, other: Node) -> None:
        for here, there in ((one, other), (other, one)):
            self._neighbour("del", here, there)

    def _neighbour(self, verb: str, here: Node, there: Node, *words: str) -> None:
        run(*here.command("ip", "neigh", verb, there.address, "dev", "eth0", *words))


def run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise Unsupported(f"{' '.join(command)}: {done.stderr.strip()}")


@contextmanager
def nodes_running(case: Case, policies: Path, folder: Path, mark: str, *, namespaces: bool) -> Iterator[Nodes]:
    """Start Redis, the nodes and the front, and end all of it. Raises StartError."""
    with ExitStack() as cleanup:
        made = _nodes(case, folder, mark, namespaces, cleanup)
        _configure(made, policies, namespaces)
        cleanup.callback(made.stop_redis)
        made.start_redis()
        for node in made.nodes:
            cleanup.callback(node.stop)
        made.start(made.head)
        made.await_head()
        for node in made.nodes[1:NODES]:
            made.start(node)
            _until(node.has_joined, node)  # else all replicas would go to the head
        yield made


def _nodes(case: Case, folder: Path, mark: str, namespaces: bool, cleanup: ExitStack) -> Nodes:
    home = folder / "c"
    home.mkdir()
    shared = cluster_environment(home) | {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
    port, grpc_port, dashboard, gcs, redis, client = free_ports(6)
    addresses = ["127.0.0.1"] * (NODES + SPARE)
    names: list[str | None] = [None] * (NODES + SPARE)
    if namespaces:
        subnet = f"10.177.{secrets.randbelow(200)}"
        addresses = [f"{subnet}.{number + 1}" for number in range(NODES + SPARE)]
        names = list(_make_namespaces(subnet, addresses, cleanup))
        dashboard, gcs, redis = 8265, 6379, 6380
    outside = addresses[0].rpartition(".")[0] + ".254" if namespaces else addresses[0]
    shared["RAY_REDIS_ADDRESS"] = f"{outside}:{redis}"
    nodes = []
    for number, (address, name) in enumerate(zip(addresses, names, strict=True)):
        own = home / str(number)
        own.mkdir()
        variables = shared | proxy_files(own)
        if not namespaces:
            variables |= replica_ports() | proxy_ports()
        nodes.append(Node(number, address, own, variables, name))
    server = asked(case, "three nodes", [], port, grpc_port)
    if namespaces:
        server.command = [str(find_binary()), "-db", "-f", str(_front(home, port, grpc_port, addresses))]
    return Nodes(
        server, dashboard, home, shared, host=addresses[0], nodes=nodes, gcs_port=gcs, client_port=client, mark=mark
    )


def _front(home: Path, port: int, grpc_port: int, addresses: list[str]) -> Path:
    text = FRONT
    for name, ours, theirs in (("http", port, 8000), ("grpc", grpc_port, 8001)):
        servers = "".join(f"    server n{n} {each}:{theirs} port 8000\n" for n, each in enumerate(addresses))
        text += f"listen {name}\n    bind 127.0.0.1:{ours}\n{servers}"
    file = home / "front.cfg"
    file.write_text(text)
    return file


def _make_namespaces(subnet: str, addresses: list[str], cleanup: ExitStack) -> Iterator[str]:
    """Make a network namespace for each address, joined by a bridge on which this process is `.254`."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        raise Unsupported("network namespaces need root and the program `ip` (Debian's iproute2)")
    name = f"rls{secrets.token_hex(3)}"
    run("ip", "link", "add", name, "type", "bridge")
    cleanup.callback(run, "ip", "link", "del", name)
    run("ip", "addr", "add", f"{subnet}.254/24", "dev", name)
    run("ip", "link", "set", name, "up")
    for number, address in enumerate(addresses):
        space, link = f"{name}n{number}", f"{name}v{number}"
        run("ip", "netns", "add", space)
        cleanup.callback(run, "ip", "netns", "del", space)
        run("ip", "link", "add", link, "type", "veth", "peer", "name", "eth0", "netns", space)
        run("ip", "link", "set", link, "master", name, "up")
        for words in (f"addr add {address}/24 dev eth0", "link set eth0 up", "link set lo up"):
            run("ip", "-n", space, *words.split())
        yield space


def _configure(made: Nodes, policies: Path, namespaces: bool) -> None:
    configuration = yaml.safe_load(SHIPPED.read_text())
    configuration["proxy_location"] = "EveryNode"
    configuration["http_options"] = {"host": "0.0.0.0" if namespaces else "127.0.0.1"}
    configuration["http_options"]["port"] = 8000 if namespaces else made.server.port
    configuration["grpc_options"]["port"] = 8001 if namespaces else made.server.grpc_port
    settings: dict[str, Any] = {"operator_key": _LINE.split()[-1], "allow_unauthenticated": namespaces}
    settings["max_queue_ms"] = MAX_QUEUE_MS
    arguments = {"policies": [str(policies)], "replicas": NODES, "settings": settings}
    configuration["applications"][0]["args"] = arguments
    made.configuration = configuration


def _until(condition: Callable[[], bool], node: Node | None) -> None:
    deadline = time.monotonic() + START_S
    while not condition():
        if time.monotonic() > deadline or (node is not None and not node.runs()):
            log = "" if node is None else node.log.read_text(errors="replace")[-2000:]
            raise StartError(f"a node did not start: {log}")
        time.sleep(0.1)
