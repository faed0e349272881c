"""Count what clients see when parts of a running server die or are replaced under load.

    python benchmarks/faults.py [--on serve|cluster|nodes|namespaces] [FAULT ...]

The UR5 policy and the LSTM policy that ship, two replicas, on `rlservo serve` or on a cluster by `serve deploy
deploy/serve.yaml`; or three replicas on three Ray nodes with a proxy each (`nodes`), in network namespaces with
addresses of their own as well (`namespaces`, as root). Meanwhile clients ask without end, over JSON, the Open Inference
Protocol (binary, gRPC) and WebSockets, and with the LSTM's state carried, on a stream, and in sessions by id; each
tries once more when it has failed, and checks every action, the LSTM's bit by bit. A fault is over when all replicas
answer requests again. Exits with 1 when they do not, when an answer was wrong, when a client learned of our insides, or
when what must cost nothing cost something. Written to bench/faults-WHERE.json.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from flood import flood
from rlservo.export.contract.bundle import ONNX_FILE
from rlservo.export.contract.errors import RlservoError
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from serving import OUT, ROOT
from speed.asks import Episode, SessionsById, WrongError, askers, episode_of, open_stream
from speed.catalogue import Case, case_of, rlservo
from speed.cluster import Cluster, cluster
from speed.loads import LoadError, PoliteError, WebSocketLine
from speed.machine import Process
from speed.nodes import KEY, NODES, Node, Nodes, nodes_running
from speed.servers import Server, StartError, ask, listening, running, started, wait_until_answering

CHECKPOINTS = ROOT / "examples" / "checkpoints"
SHIPPED = {"ur5": CHECKPOINTS / "ur5_positioning", "sparse": CHECKPOINTS / "mir100_sparse_fixes"}
PROTOCOLS = ("json", "oip binary", "grpc", "websocket", "websocket anew")
STEPS = 50  # of an episode
DEADLINE_MS = 10_000.0  # of those who have one: what is counted is failures, not how slow a busy machine is
PAUSE_S = 0.02  # between a client's requests
BEFORE_S, CALM_S = 2.0, 4.0  # of load before a fault, and without a failure before it counts as over
BOUND_S = 90.0  # for a fault to be over
RAY_NOTICES_S = 30.0  # that one of its processes has ended
ALL_SERVE_S = 120.0  # and for every replica to answer
HEAD_AWAY_S = REDIS_AWAY_S = 5.0
CUT_S, LONG_CUT_S = 8.0, 45.0  # Ray gives a node up that it has not reached for some 15 s
OLD_STREAM_S = 140.0  # Ray's own limit for a replaced HAProxy is 120
SETTLE_S = 10.0  # until a new proxy has taken over
COME_S = 120.0  # for what was deployed to be there
NO_STORE = "the cluster's store cannot say"
NO_REPLICA = "no replica"  # can be reached, is there yet: a proxy that has just started
INSIDES = ("Traceback", "site-packages", 'File "')


@dataclass
class Seen:
    """What the clients of one kind saw."""

    asked: int = 0
    told: int = 0
    """How often the server said that a memory is gone, or closed a stream with the code for it."""
    first: list[tuple[float, str]] = field(default_factory=list)  # (when, what) of failed first tries
    twice: list[tuple[float, str]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


class Crowd:
    """Clients that ask without end, each in a thread of its own, and try once more when that failed."""

    def __init__(self, made: dict[str, Callable[[], Any]], pause_s: float = PAUSE_S) -> None:
        self.seen = {name: Seen() for name in made}
        self._stop = threading.Event()
        self._pause_s = pause_s
        self._threads = [threading.Thread(target=self._ask, args=each) for each in made.items()]

    def __enter__(self) -> Crowd:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def last_failure(self) -> float:
        """Return when somebody last failed (`time.monotonic`), 0 for never."""
        return max((each.first[-1][0] for each in self.seen.values() if each.first), default=0.0)

    def _ask(self, name: str, make: Callable[[], Any]) -> None:
        ask, seen = make(), self.seen[name]
        while not self._stop.is_set():
            if (failure := _failure(ask, seen)) is not None:
                seen.first.append((time.monotonic(), failure))
                if (failure := _failure(ask, seen)) is not None:
                    seen.twice.append((time.monotonic(), failure))
            seen.asked += 1
            time.sleep(self._pause_s)
        seen.told += getattr(ask, "told", 0)
        ask.close()


def _failure(ask: Callable[[], None], seen: Seen) -> str | None:
    try:
        ask()
    except PoliteError:
        seen.told += 1
        return _failure(ask, seen)
    except WrongError as error:
        seen.wrong.append(str(error)[:300])
    except (LoadError, OSError) as error:
        return f"{type(error).__name__}: {error}"[:400]
    return None


@dataclass
class Row:
    """What one fault cost."""

    fault: str
    asked: int = 0
    first: int = 0
    twice: int = 0
    wrong: int = 0
    told: int = 0
    over_s: float = 0.0
    """From the fault to the last failure."""
    all_serve_s: float | None = None
    """From the fault until every replica had answered requests; None: not within the deadline."""
    free: bool = False
    """Whether no try but the first of each may fail (and for `smooth`, not even that)."""
    smooth: bool = False
    notes: list[str] = field(default_factory=list)
    kinds: dict[str, int] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)
    """Why this does not hold; empty when it does."""


@dataclass
class Bench:
    """The running server, and what it is asked."""

    case: Case
    lstm: Path
    server: Server
    cluster: Cluster | None
    folder: Path
    console: Console

    def crowd(self, pause_s: float = PAUSE_S) -> Crowd:
        made: dict[str, Callable[[], Any]] = {}
        kinds = askers(self.case, self.server)
        for name in PROTOCOLS:
            if name in kinds:
                made[name] = kinds[name]
        seen, expected = episode_of(self.lstm, STEPS)
        url = f"http://127.0.0.1:{self.server.port}"
        name = self.lstm.parent.name
        made["lstm, state carried"] = lambda: Episode(PolicyClient(url, name, deadline_ms=DEADLINE_MS), seen, expected)
        made["lstm, stream"] = lambda: Episode(
            StreamClient(url, name, server_state=True, deadline_ms=DEADLINE_MS), seen, expected, held=True
        )
        made["lstm, session"] = lambda: Episode(
            PolicyClient(url, name, server_state=True, deadline_ms=DEADLINE_MS), seen, expected, held=True
        )
        made["lstm, sessions by id"] = lambda: SessionsById(self.server.port, name, seen, expected)
        return Crowd(made, pause_s)

    @property
    def replicas(self) -> int:
        """How many replicas there should be."""
        return REPLICAS if self.cluster is None else int(self.cluster.application["args"]["replicas"])

    @property
    def has_no_front(self) -> bool:
        """Whether clients reach a node's proxy before it is ready: nodes that share an address have none in front."""
        return isinstance(self.cluster, Nodes) and not self.server.command

    def members(self) -> dict[int, Process]:
        """Return the server's processes, those of all nodes."""
        if not isinstance(self.cluster, Nodes):
            return self.server.members()
        return {pid: process for node in self.cluster.nodes for pid, process in node.members().items()}

    def pids(self, title: str) -> list[int]:
        return pids_of(self.members(), title)

    def serving(self) -> dict[str, int]:
        """Ask once, and return by the answering replica how many requests it has answered."""
        ask(self.server)
        told = get(self.server, "/v1/policies")
        versions = [version for policy in told["policies"] for version in policy["version_states"]]
        return {told["replica"]: sum(version["requests"] for version in versions)}


def pids_of(members: dict[int, Process], title: str) -> list[int]:
    """Return the processes with this in their title or program; a script's is in the words after it."""
    words = 3 if title.endswith(".py") else 1
    return sorted(pid for pid, process in members.items() if title in " ".join(process.command.split(" ")[:words]))


# The faults: each does its harm, and returns when what it did has come to its end


def kill(title: str, count: int, renews: str | None = None) -> Callable[[Bench, Row], None]:
    """Return the fault that kills one process with SIGKILL, and waits for as many as there were.

    `renews`: another process that Serve replaces for it, later.
    """

    def fault(bench: Bench, row: Row) -> None:
        before = wait_for(lambda: len(found := bench.pids(title)) >= count and found, f"{count} {title}")
        victim = before[-1]
        node = next((each for each in _all_nodes(bench) if victim in each.members()), None)

        def alike(what: str) -> list[int]:  # a replica may come back on another node, a node's own parts only there
            return bench.pids(what) if node is None or title == REPLICA else pids_of(node.members(), what)

        before, renewed = alike(title), alike(renews) if renews else []
        began = time.monotonic()
        os.kill(victim, signal.SIGKILL)
        wait_for(
            lambda: len(now := alike(title)) >= min(count, len(before)) and set(now) - set(before),
            f"a new {title}",
        )
        row.notes.append(f"a new process after {time.monotonic() - began:.1f} s")
        if renews is not None:
            other = renews
            wait_for(lambda: set(alike(other)) - set(renewed), f"a new {other}")
            row.notes.append(f"Serve's own after {time.monotonic() - began:.1f} s")
        if "HAProxy" in f"{title}{renews}":
            time.sleep(SETTLE_S)

    return fault


def deploy(change: Callable[[Bench], None], arrived: Callable[[Bench], Any]) -> Callable[[Bench, Row], None]:
    """Return the fault that deploys a changed configuration, and waits until it is there."""

    def fault(bench: Bench, row: Row) -> None:
        assert bench.cluster is not None
        kept = json.dumps(bench.cluster.configuration)
        old = set(bench.cluster.replicas())
        change(bench)
        taken, said = bench.cluster.deploy()
        if not taken:
            row.notes.append(f"`serve deploy` refused it: {said.strip().splitlines()[-1][:200]}")
        told = wait_for(lambda: arrived(bench), "what was deployed")
        if isinstance(told, str):
            row.notes.append(told[:300])
            bench.cluster.configuration = json.loads(kept)
            bench.cluster.deploy()
        row.notes.append(f"{len(set(bench.cluster.replicas()) - old)} new replicas")

    return fault


def _user_config(bench: Bench) -> None:
    assert bench.cluster is not None
    bench.cluster.application["deployments"] = served("2")


def served(production: str) -> list[dict[str, Any]]:
    """Return the deployments' part of the configuration: version 1, and another one if that is the default."""
    versions = sorted({"1", production})
    config = {"policies": {"ur5": {"versions": versions, "aliases": {"production": production}}}}
    return [{"name": "PolicyServer", "user_config": config}]


def _versions(bench: Bench) -> dict[str, Any]:
    return get(bench.server, "/v1/policies")


def _replicas(number: int) -> Callable[[Bench], None]:
    def change(bench: Bench) -> None:
        assert bench.cluster is not None
        bench.cluster.application["args"]["replicas"] = number

    return change


def _running(number: int) -> Callable[[Bench], Any]:
    return lambda bench: bench.cluster is not None and len(bench.cluster.replicas()) == number


def _all_new(change: Callable[[Bench], None]) -> Callable[[Bench, Row], None]:
    old: set[str] = set()

    def changed(bench: Bench) -> None:
        assert bench.cluster is not None
        old.clear()
        old.update(bench.cluster.replicas())
        change(bench)

    def arrived(bench: Bench) -> bool:
        assert bench.cluster is not None
        now = set(bench.cluster.replicas())
        return len(now) == len(old) and not now & old and bench.cluster.status()["status"] == "RUNNING"

    return deploy(changed, arrived)


def _variable(bench: Bench) -> None:
    assert bench.cluster is not None
    bench.cluster.application["runtime_env"] = {"env_vars": {"RLSERVO_RUN": secrets.token_hex(4)}}


def _code(bench: Bench) -> None:
    """Another module, on a path that only the changed runtime environment knows."""
    assert bench.cluster is not None
    home = bench.folder / "code"
    home.mkdir(exist_ok=True)
    (home / "changed_app.py").write_text(
        "from rlservo.serve_app.ray_serve import app\n\n\n"
        "def build(args: app.BuildArguments):\n    return app.build(args)\n"
    )
    bench.cluster.application["import_path"] = "changed_app:build"
    bench.cluster.application["runtime_env"] = {"env_vars": {"PYTHONPATH": str(home)}}


def _broken_version(bench: Bench) -> None:
    assert bench.cluster is not None
    bench.cluster.application["deployments"] = served("3")


def _refused(bench: Bench) -> str | None:
    refused = _versions(bench).get("refused")
    return None if not refused else f"/v1/policies: {refused['reason']}"


def _broken_code(bench: Bench) -> None:
    assert bench.cluster is not None
    bench.cluster.application["import_path"] = "rlservo.serve_app.ray_serve.app:not_there"


def _broken_folder(bench: Bench) -> None:
    assert bench.cluster is not None
    bench.cluster.application["args"]["policies"] = [str(bench.folder / "nowhere")]


def _failed(bench: Bench) -> str | None:
    assert bench.cluster is not None
    status = bench.cluster.status()
    messages = [str(status.get("message", ""))]
    messages += [str(each.get("message", "")) for each in status.get("deployments", {}).values()]
    if status.get("status") not in ("DEPLOY_FAILED", "UNHEALTHY"):
        return None
    return f"{status['status']}: {' '.join(' '.join(messages).split())[-300:]}"


def autoscale(bench: Bench, row: Row) -> None:
    """Deploy with one to two replicas by load; the load makes two, its end one."""
    assert bench.cluster is not None
    bench.cluster.application["deployments"] = [
        {
            **served("1")[0],
            "autoscaling_config": {
                "min_replicas": 1,
                "max_replicas": 2,
                "upscale_delay_s": 2,
                "downscale_delay_s": 5,
                "metrics_interval_s": 1,
                "look_back_period_s": 3,
                "policy": {"policy_function": "rlservo.serve_app.ray_serve.autoscaling:by_load"},
            },
        }
    ]
    bench.cluster.application["args"]["replicas"] = 1
    began = time.monotonic()
    taken, said = bench.cluster.deploy()
    if not taken:
        row.broken.append(said.strip().splitlines()[-1])
    wait_for(lambda: _running(1)(bench), "one replica")
    row.notes.append(f"1 replica after {time.monotonic() - began:.0f} s")
    kind = askers(bench.case, bench.server)["json batch"]
    with Crowd({f"busy {number}": kind for number in range(6)}, pause_s=0.0) as busy:
        began = time.monotonic()
        wait_for(lambda: _running(2)(bench), "a second replica")
        row.notes.append(f"2 under load after {time.monotonic() - began:.0f} s")
        time.sleep(3)
    add(row, busy, began)
    began = time.monotonic()
    wait_for(lambda: _running(1)(bench), "one replica less")
    row.notes.append(f"1 again after {time.monotonic() - began:.0f} s")


def old_streams(bench: Bench, row: Row) -> None:
    """Kill a replica, so that HAProxy is replaced; the other's streams stay on the old one, and outlive Ray's limit."""
    with ExitStack() as cleanup:
        streams = [open_stream(bench.server) for _ in range(4)]
        for stream in streams:
            cleanup.callback(stream.close)
        kill("ray::ServeReplica", REPLICAS)(bench, row)
        began, left = time.monotonic(), [stream for stream in streams if _answers(stream)]
        while time.monotonic() < began + OLD_STREAM_S:
            time.sleep(5)  # uvicorn pings, and closes streams that do not answer
            left = [stream for stream in left if _answers(stream)]
        row.notes.append(f"{len(left)} of {len(streams)} streams still answered {OLD_STREAM_S:g} s later")
        if not left:
            row.broken.append("no stream outlived HAProxy's replacement")


def _answers(stream: WebSocketLine) -> bool:
    try:
        stream()
    except (LoadError, OSError):
        return False
    return True


# Faults of several nodes


def kill_node(bench: Bench, row: Row) -> None:
    """Kill all of a worker node, wait for its replica elsewhere; then start it anew, and wait for its proxy."""
    nodes = _nodes(bench)
    victim, lost = nodes.nodes[NODES - 1], set(nodes.replicas())
    began = time.monotonic()
    victim.kill()
    # Serve knows of it when Ray does.
    wait_for(lambda: len(now := set(nodes.replicas())) == bench.replicas and now != lost, "the lost replica")
    row.notes.append(f"as many replicas as before after {time.monotonic() - began:.0f} s")
    _start_node(nodes, victim, row)


def kill_part(title: str, number: int) -> Callable[[Bench, Row], None]:
    """Return the fault that kills one process of a node, whose supervisor starts the node again should it end.

    Not free: the node's other processes end one after the other, within a second, and two tries may meet that.
    """

    def fault(bench: Bench, row: Row) -> None:
        nodes = _nodes(bench)
        node = nodes.nodes[number]
        (victim, *_) = wait_for(lambda: pids_of(node.members(), title), title)
        began = time.monotonic()
        os.kill(victim, signal.SIGKILL)
        _supervise(bench, row, lambda: not node.runs() or set(pids_of(node.members(), title)) - {victim}, began)

    return fault


def kill_redis(bench: Bench, row: Row) -> None:
    """Kill the head's Redis, and start it again with the file that it has."""
    nodes = _nodes(bench)
    began = time.monotonic()
    nodes.stop_redis(kill=True)
    time.sleep(REDIS_AWAY_S)
    nodes.start_redis()
    _supervise(bench, row, lambda: time.monotonic() > began + RAY_NOTICES_S, began)


def _supervise(bench: Bench, row: Row, noticed: Callable[[], Any], began: float) -> None:
    """Start every node that ends, as what runs it does, until Ray has `noticed` and all replicas run again."""
    nodes, ended = _nodes(bench), Counter[int]()
    up = [node for node in nodes.nodes if node.server is not None]

    def well() -> bool:
        for node in up:
            if not node.runs():
                ended[node.number] += 1
                node.stop()
                nodes.start(node)
        running = nodes.status()["status"] == "RUNNING" and len(nodes.replicas()) == bench.replicas
        return running and all(node.has_joined() for node in up)

    with suppress(TimeoutError):  # it is noted below
        wait_for(noticed, "", RAY_NOTICES_S)
    wait_for(well, "all nodes and replicas", BOUND_S * 3)
    row.notes.append(
        ", ".join(f"node {number} ended and was started {times} time(s)" for number, times in ended.items())
        or "no node ended"
    )
    row.notes.append(f"as many nodes and replicas as before after {time.monotonic() - began:.0f} s")


def add_node(bench: Bench, row: Row) -> None:
    """Start one more node, and deploy one more replica."""
    nodes = _nodes(bench)
    _start_node(nodes, nodes.nodes[NODES], row)
    deploy(_replicas(NODES + 1), _running(NODES + 1))(bench, row)
    _await_proxy(nodes.nodes[NODES])  # Serve starts one where there is a replica


def kill_head(bench: Bench, row: Row) -> None:
    """Kill all of the head, start it again with what Redis kept; alias, canary and commands must be there still."""
    nodes = _nodes(bench)
    with _admin(bench) as admin:
        admin.load("ur5", "2")
        admin.alias("ur5", "candidate", "2")
        admin.canary("ur5", "candidate", 0.2)
    before = wait_for(lambda: _plans(bench, len(nodes.replicas())), "one plan on all replicas")
    began = time.monotonic()
    nodes.head.kill()
    time.sleep(HEAD_AWAY_S)
    alone = _plans(bench, NODES - 1, by_one=True)
    if alone != before:
        row.broken.append(f"without its head the plan was {alone}, before {before}")
    starts = 0
    while not listening(nodes.dashboard, nodes.host):  # Ray gives a start up after 30 s: whoever runs it tries again
        if not nodes.head.runs():
            starts += 1
            nodes.head.stop()
            nodes.start(nodes.head)
        if time.monotonic() > began + BOUND_S * 3:
            raise TimeoutError("the head did not start again")
        time.sleep(0.5)
    row.notes.append(f"{starts} start(s)")
    wait_for(lambda: _listening(nodes), "the head's dashboard")
    row.notes.append(f"the head was away for {time.monotonic() - began:.0f} s")
    replicas = nodes.application["args"]["replicas"]
    wait_for(lambda: nodes.status()["status"] == "RUNNING" and len(nodes.replicas()) == replicas, "all replicas")
    row.notes.append(f"as many replicas as before after {time.monotonic() - began:.0f} s")
    after = wait_for(lambda: _plans(bench, replicas), "one plan on all replicas")
    if after != before:
        row.broken.append(f"the plan was {before}, and is {after}")
    with _admin(bench) as admin:
        admin.canary("ur5", None)
        admin.alias("ur5", "candidate", None)
        admin.unload("ur5", "2")
    wait_for(lambda: _plans(bench, replicas) not in (None, after), "a change after it")
    _await_proxy(nodes.head)


def cut_shortly(bench: Bench, row: Row) -> None:
    """Cut the network between the head and a worker for less than Ray takes to give the node up."""
    nodes = _nodes(bench)
    replicas = set(nodes.replicas())
    nodes.cut(nodes.head, nodes.nodes[1])
    time.sleep(CUT_S)
    nodes.mend(nodes.head, nodes.nodes[1])
    wait_for(lambda: nodes.status()["status"] == "RUNNING", "Serve")
    new = len(set(nodes.replicas()) - replicas)
    row.notes.append(f"cut for {CUT_S:g} s, {new} new replicas")


def cut_for_long(bench: Bench, row: Row) -> None:
    """Cut it until Ray has given the node up, and Serve has replaced its replica; mend it, and start the node anew."""
    nodes = _nodes(bench)
    cut, lost = nodes.nodes[1], set(nodes.replicas())
    began = time.monotonic()
    nodes.cut(nodes.head, cut)
    wait_for(lambda: len(now := set(nodes.replicas())) == len(lost) and now != lost, "another replica", BOUND_S * 3)
    row.notes.append(f"as many replicas as before after {time.monotonic() - began:.0f} s")
    time.sleep(max(0.0, began + LONG_CUT_S - time.monotonic()))  # Serve is faster than Ray
    nodes.mend(nodes.head, cut)
    wait_for(lambda: not cut.runs(), "the given-up node's end", BOUND_S * 3)
    row.notes.append(f"the node ended {time.monotonic() - began:.0f} s after the cut")
    cut.stop()
    _start_node(nodes, cut, row)


def _all_nodes(bench: Bench) -> list[Node]:
    return bench.cluster.nodes if isinstance(bench.cluster, Nodes) else []


def _nodes(bench: Bench) -> Nodes:
    assert isinstance(bench.cluster, Nodes)
    return bench.cluster


def _start_node(nodes: Nodes, node: Node, row: Row) -> None:
    began = time.monotonic()
    nodes.start(node)
    wait_for(node.has_joined, "the node")
    row.notes.append(f"a node has joined {time.monotonic() - began:.0f} s after its start")


def _await_proxy(node: Node) -> None:
    """Wait until the node's own proxy answers; where all share an address, until its HAProxy is there."""
    if node.namespace is None:
        wait_for(lambda: any("/haproxy" in each.command.split(" ")[0] for each in node.members().values()), "a proxy")
    else:
        wait_for(lambda: _is_ready(node.address), "the node's proxy")


def _is_ready(address: str) -> bool:
    with closing(HTTPConnection(address, 8000, timeout=2)) as connection:
        connection.request("GET", "/v2/health/ready")
        return connection.getresponse().status == 200


def _admin(bench: Bench) -> AdminClient:
    return AdminClient(f"http://127.0.0.1:{bench.server.port}", api_key=KEY, timeout_s=60)


def _plans(bench: Bench, replicas: int, *, by_one: bool = False) -> dict[str, Any] | None:
    """Return what is served of ur5, where so many replicas say the same, or what one says; else None."""
    told: list[dict[str, Any]] = []
    if by_one:
        told = [_versions(bench)]
    else:
        with suppress(RlservoError), _admin(bench) as admin:
            told = admin.replicas()
            if len(told) != replicas:
                return None
    plans = []
    for each in told:
        served = [policy for policy in each["policies"] if policy["name"] == "ur5"]
        plans.append({key: served[-1].get(key) for key in ("aliases", "canary", "version")})
    return plans[0] if plans and all(plan == plans[0] for plan in plans) else None


def overload(bench: Bench, row: Row) -> None:
    """512 connections at once (`flood.py`)."""
    replicas = bench.pids("ServeReplica")
    found = flood(bench.server.port, bench.case, replicas)
    row.asked += found.asked
    row.wrong += len(found.wrong)
    row.notes.append(found.sentence())
    row.broken += found.wrong[:3] + found.broken


@dataclass(frozen=True)
class Fault:
    """A fault, and what it may cost."""

    do: Callable[[Bench, Row], None]
    free: bool = True  # nobody fails twice
    smooth: bool = False  # nobody fails at all
    takes_store: bool = False  # the GCS is away for a while, for all or one node, which sessions by id need
    only_on: tuple[str, ...] = ()
    pause_s: float = PAUSE_S


REPLICAS = 2
REPLICA = "ray::ServeReplica"
CLUSTERS, NODED = ("cluster",), ("nodes", "namespaces")
EVERYWHERE = ("serve", *CLUSTERS, *NODED)
FAULTS = {
    "replica": Fault(kill(REPLICA, REPLICAS), only_on=EVERYWHERE),
    "haproxy": Fault(kill("/haproxy", 1, "ray::HAProxyManager"), free=False, only_on=EVERYWHERE),
    "proxy-manager": Fault(kill("ray::HAProxyManager", 1), free=False, only_on=EVERYWHERE),
    "proxy-actor": Fault(kill("ray::ProxyActor", 1), only_on=EVERYWHERE),
    "controller": Fault(kill("ray::ServeController", 1), smooth=True, only_on=EVERYWHERE),
    "old-streams": Fault(old_streams),
    "overload": Fault(overload, free=False),
    "user-config": Fault(
        deploy(_user_config, lambda bench: _versions(bench)["policies"][-1]["version"] == "2"),
        smooth=True,
        only_on=CLUSTERS,
    ),
    "broken-version": Fault(deploy(_broken_version, _refused), smooth=True, only_on=CLUSTERS),
    "broken-code": Fault(deploy(_broken_code, _failed), smooth=True, only_on=CLUSTERS),
    "broken-folder": Fault(deploy(_broken_folder, _failed), smooth=True, only_on=CLUSTERS),
    "more-replicas": Fault(deploy(_replicas(3), _running(3)), smooth=True, only_on=CLUSTERS),
    "fewer-replicas": Fault(deploy(_replicas(REPLICAS), _running(REPLICAS)), smooth=True, only_on=CLUSTERS),
    "variable": Fault(_all_new(_variable), smooth=True, only_on=CLUSTERS),
    "code": Fault(_all_new(_code), smooth=True, only_on=CLUSTERS),
    "autoscale": Fault(autoscale, smooth=True, only_on=CLUSTERS, pause_s=0.25),
    "raylet": Fault(kill_part("/raylet", NODES - 1), free=False, only_on=NODED),
    "runtime-env-agent": Fault(kill_part("ray::RuntimeEnvAgent", NODES - 1), free=False, only_on=NODED),
    "gcs": Fault(kill_part("/gcs_server", 0), free=False, takes_store=True, only_on=NODED),
    "head-raylet": Fault(kill_part("/raylet", 0), free=False, takes_store=True, only_on=NODED),
    "dashboard": Fault(kill_part("/dashboard.py", 0), free=False, takes_store=True, only_on=NODED),
    "redis": Fault(kill_redis, free=False, takes_store=True, only_on=NODED),
    "node": Fault(kill_node, only_on=NODED),
    "add-node": Fault(add_node, smooth=True, only_on=NODED),
    "head": Fault(kill_head, takes_store=True, only_on=NODED),
    "upgrade": Fault(_all_new(_variable), smooth=True, only_on=NODED),
    "cut-shortly": Fault(cut_shortly, takes_store=True, only_on=("namespaces",)),
    "cut": Fault(cut_for_long, free=False, takes_store=True, only_on=("namespaces",)),
}


def main() -> None:
    arguments = parse()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the server is ended then, too
    console = Console(highlight=False, width=200)
    rows: list[Row] = []
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rlsf-", ignore_cleanup_errors=True)))
        policies = shutil.copytree(exported(arguments.keep, folder, console), folder / "served")
        case = case_of(policies / "ur5" / "1", Path())
        try:
            bench = cleanup.enter_context(serving(arguments.on, case, policies, folder, console))
            for name in arguments.faults:
                console.print(f"{name} ...")
                rows.append(undergo(name, FAULTS[name], bench))
                tell(rows[-1], console)
        except StartError as error:
            raise SystemExit(str(error)) from None
        finally:
            console.print("stopping the server ...")
    console.print(table(rows))
    OUT.mkdir(exist_ok=True)
    (OUT / f"faults-{arguments.on}.json").write_text(json.dumps([vars(row) for row in rows], indent=1) + "\n")
    sys.exit(1 if any(row.broken for row in rows) else 0)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--on", choices=("serve", *CLUSTERS, *NODED), default="serve")
    parser.add_argument("--keep", type=Path, help="a folder for the exported policies, to be used again")
    parser.add_argument("faults", nargs="*", metavar="FAULT", help=f"default: all. {', '.join(FAULTS)}")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.faults if name not in FAULTS]:
        parser.error(f"unknown fault {unknown[0]!r}: known are {', '.join(FAULTS)}")
    possible = [name for name, fault in FAULTS.items() if arguments.on in (fault.only_on or ("serve", "cluster"))]
    if impossible := [name for name in arguments.faults if name not in possible]:
        parser.error(
            f"{impossible[0]!r} needs --on {' or '.join(FAULTS[impossible[0]].only_on or ('serve', 'cluster'))}"
        )
    arguments.faults = arguments.faults or possible
    return arguments


def exported(keep: Path | None, folder: Path, console: Console) -> Path:
    """Return the repository, exported now unless it was kept."""
    root = (keep or folder / "policies").absolute()
    if not root.exists():
        export(root, console)
    return root


def export(root: Path, console: Console) -> None:
    """Make a repository: both policies in version 1, ur5 in 2 as well, and in 3 with a byte of its weights changed."""
    console.print("exporting the shipped checkpoints ...")
    for name in (*SHIPPED, "ur5", "ur5"):
        command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(SHIPPED[name])]
        done = subprocess.run([*command, "--out", str(root), "--name", name], capture_output=True, text=True)
        if done.returncode != 0:
            raise SystemExit(f"the shipped checkpoint could not be exported:\n{done.stderr[-2000:]}")
    weights = root / "ur5" / "3" / ONNX_FILE
    content = bytearray(weights.read_bytes())
    content[len(content) // 2] ^= 1
    weights.write_bytes(content)


@contextmanager
def serving(on: str, case: Case, policies: Path, folder: Path, console: Console) -> Iterator[Bench]:
    """Start the server, and give it when all of its replicas answer."""
    console.print("starting the server ...")
    mark, lstm = secrets.token_hex(8), policies / "sparse" / "1"
    if on == "serve":
        server = rlservo(case, folder, replicas=REPLICAS)
        server.command[server.command.index("serve") + 1] = str(policies)
        shutil.rmtree(policies / "ur5" / "3")  # whoever starts with a damaged version does not start
        with running(server, folder, mark):
            bench = Bench(case, lstm, server, None, folder, console)
            wait_for(lambda: len(bench.pids("ray::ServeReplica")) == REPLICAS, "the replicas")
            time.sleep(CALM_S)  # Serve replaces HAProxy for each
            yield bench
        return
    if on in NODED:
        with nodes_running(case, policies, folder, mark, namespaces=on == "namespaces") as nodes, ExitStack() as front:
            wait_for(lambda: _listening(nodes), "the cluster")
            nodes.application["deployments"] = served("1")
            taken, said = nodes.deploy()
            if not taken:
                raise StartError(f"`serve deploy` failed: {said[-1000:]}")
            if nodes.server.command:
                front.enter_context(started(nodes.server, folder, mark))
            wait_for(lambda: len(nodes.replicas()) == NODES, "the replicas")
            for node in nodes.nodes[:NODES]:
                _await_proxy(node)
                console.print(f"node {node.number} answers")
            time.sleep(CALM_S)
            yield Bench(case, lstm, nodes.server, nodes, folder, console)
        return
    made = cluster(case, policies, folder)
    made.application["args"]["replicas"] = REPLICAS
    made.application["deployments"] = served("1")
    with started(made.server, folder, mark) as log:
        wait_for(lambda: _listening(made), "the cluster")
        began = time.monotonic()
        taken, said = made.deploy()
        if not taken:
            raise StartError(f"`serve deploy` failed: {said[-1000:]}")
        wait_until_answering(made.server, log)
        console.print(f"first deployment: answering {time.monotonic() - began:.0f} s after `serve deploy` was called")
        wait_for(lambda: len(made.replicas()) == REPLICAS, "the replicas")
        time.sleep(CALM_S)
        yield Bench(case, lstm, made.server, made, folder, console)


def _listening(made: Cluster) -> bool:
    with suppress(OSError, ValueError, KeyError):
        made.status()
        return True
    return False


def undergo(name: str, fault: Fault, bench: Bench) -> Row:
    """Let a crowd ask, do the harm, wait until nobody has failed for a while, and count."""
    row = Row(name, free=fault.free, smooth=fault.smooth)
    with bench.crowd(fault.pause_s) as crowd:
        time.sleep(BEFORE_S)
        began = time.monotonic()
        try:
            fault.do(bench, row)
        except TimeoutError as error:
            row.broken.append(str(error))
        wait_for_replicas(bench, row, began)
        done = time.monotonic()
        while time.monotonic() < min(done + BOUND_S, max(crowd.last_failure(), began) + CALM_S):
            time.sleep(0.1)
    add(row, crowd, began)
    if crowd.last_failure() > time.monotonic() - CALM_S / 2:
        row.broken.append("it did not recover")
    if fault.smooth and row.first:
        row.broken.append("a request failed")
    costly = [
        f"{name}: {what}"
        for name, seen in crowd.seen.items()
        for _, what in seen.twice
        if not (fault.takes_store and NO_STORE in what) and not (bench.has_no_front and NO_REPLICA in what)
    ]
    if fault.free and costly:
        row.broken.append(f"a client failed twice: {costly[0]}")
    return row


def wait_for_replicas(bench: Bench, row: Row, began: float) -> None:
    """Wait until as many replicas as there should be answer requests, while sessions by id exist.

    A process that is there, or that Ray calls running, may end at once, again and again: what counts are requests.
    """
    deadline = time.monotonic() + ALL_SERVE_S
    first: dict[str, int] = {}
    serving: set[str] = set()
    while len(serving) < bench.replicas and time.monotonic() < deadline:
        with suppress(OSError, KeyError, ValueError):
            for replica, answered in bench.serving().items():
                if answered > first.setdefault(replica, answered):
                    serving.add(replica)
        time.sleep(0.1)
    if len(serving) < bench.replicas:
        row.broken.append(f"of {bench.replicas} replicas {len(serving)} answered requests within {ALL_SERVE_S:g} s")
        return
    if isinstance(bench.cluster, Nodes) and not bench.has_no_front:
        try:
            wait_for(lambda: all(_is_ready(address) for address in _nodes(bench).replicas_at()), "a node's proxy")
        except TimeoutError as error:
            row.broken.append(str(error))
            return
    row.all_serve_s = time.monotonic() - began
    row.notes.append(f"all {bench.replicas} replicas answer requests, seen after {row.all_serve_s:.0f} s")


def add(row: Row, crowd: Crowd, began: float) -> None:
    """Count what a crowd saw."""
    kinds: Counter[str] = Counter(row.kinds)
    for name, seen in crowd.seen.items():
        row.asked += seen.asked
        row.told += seen.told
        row.first += len(seen.first)
        row.twice += len(seen.twice)
        row.wrong += len(seen.wrong)
        row.over_s = max(row.over_s, seen.first[-1][0] - began if seen.first else 0.0)
        kinds.update(f"{name}: {what[:330]}" for _, what in seen.first)
        row.broken += [f"{name}: {what}" for what in seen.wrong[:2]]
        row.broken += [f"{name} was shown: {what}" for _, what in seen.first if any(part in what for part in INSIDES)]
        row.notes += [f"{name} asked {seen.asked}, {len(seen.first)}/{len(seen.twice)}"] if seen.first else []
    row.kinds = dict(kinds.most_common(12))


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = COME_S) -> Any:
    """Return what the condition tells when that is true. Raises TimeoutError."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        with suppress(OSError, KeyError, ValueError, IndexError):
            if found := condition():
                return found
        time.sleep(0.25)
    raise TimeoutError(f"{what} did not come within {timeout_s:g} s")


def get(server: Server, path: str) -> dict[str, Any]:
    connection = HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request("GET", path)
        document: dict[str, Any] = json.loads(connection.getresponse().read())
    finally:
        connection.close()
    return document


def tell(row: Row, console: Console) -> None:
    tries = f"first try failed {row.first}, retry failed {row.twice}"
    console.print(f"  asked {row.asked}, {tries}, wrong {row.wrong}, told {row.told}")
    for note in row.notes:
        console.print(f"  {note}", markup=False)
    for kind, times in row.kinds.items():
        console.print(f"  {times} x {kind}", markup=False)
    for reason in row.broken:
        console.print(f"  BROKEN: {reason}", markup=False, style="red")


def table(rows: list[Row]) -> Table:
    found = Table(
        "fault",
        "asked",
        "first try failed",
        "retry failed",
        "wrong",
        "told",
        "over after s",
        "all serve after s",
        "holds",
    )
    for row in rows:
        serve = "never" if row.all_serve_s is None else f"{row.all_serve_s:.0f}"
        cells = (row.asked, row.first, row.twice, row.wrong, row.told, f"{row.over_s:.1f}", serve, not row.broken)
        found.add_row(row.fault, *map(str, cells))
    return found


if __name__ == "__main__":
    main()
