"""Memory and CPU of a head node and of a worker node, by process: what deploy/kuberay's requests come from.

    python benchmarks/cluster_resources.py policies          # a folder of bundles
    python benchmarks/cluster_resources.py policies --tls    # with Ray's own TLS between the nodes

Two `ray start` on loopback, as two pods would be: no replica on the head, one on the worker. Memory is PSS (a page that
n processes share counts 1/n in each), largest of the samples taken while one client asks without pause. One machine
has one HAProxy: it is the head's here, a worker pod has its own, so its line and its actor's are added to the worker's.
With --tls, what talks to Ray without the certificate is refused, or the run fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import psutil
from ray.util import get_node_ip_address

from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.ray_serve.environment import cluster_environment, proxy_files, proxy_ports
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.ray_serve.processes import MARK, end_marked, find_marked, remove_folder

NODE = "RLSERVO_BENCHMARK_NODE"  # inherited by all that a node starts
TICKS = os.sysconf("SC_CLK_TCK")
START_S = 180.0
Readings = dict[int, tuple[str, str, float, float]]  # by pid: node, title, PSS [MB], CPU [s]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", type=Path)
    parser.add_argument("--tls", action="store_true")
    parser.add_argument("--seconds", type=float, default=15.0, help="of idling, and again of load")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `timeout` leaves nothing behind, either
    folder = Path(tempfile.mkdtemp(prefix="r"))
    mark = secrets.token_hex(16)
    try:
        measure(options.policies.absolute(), folder, mark, tls=options.tls, seconds=options.seconds)
    finally:
        end_marked(mark)
        remove_folder(folder)


def measure(policies: Path, folder: Path, mark: str, *, tls: bool, seconds: float) -> None:
    gcs, dashboard, agent, other_agent, port, metrics, other_metrics = free_ports(7)
    environment = node_environment(folder, mark)
    secured = {**environment, **(make_certificates(folder) if tls else {})}
    common = ["--block", "--node-ip-address", "127.0.0.1", "--object-store-memory", "80000000"]
    with (
        node(
            "head", secured, "--head", "--port", str(gcs), "--num-cpus", "0", "--temp-dir", str(folder / "h"),
            "--dashboard-port", str(dashboard), "--dashboard-agent-listen-port", str(agent),
            "--metrics-export-port", str(metrics), *common,
        ),
        node(
            "worker", secured, "--address", f"127.0.0.1:{gcs}", "--num-cpus", "1",
            "--dashboard-agent-listen-port", str(other_agent), "--metrics-export-port", str(other_metrics), *common,
        ),
    ):  # fmt: skip
        deploy(policies, folder, secured, port, dashboard)
        name = sorted(each.name for each in policies.iterdir() if each.is_dir())[0]
        with PolicyClient(f"http://127.0.0.1:{port}", name, timeout_s=START_S, retries=10_000) as client:
            observation = np.zeros(client.contract.observation_space.shape, np.float32)
            client.act(observation)
            idle = sample(mark, seconds, lambda: time.sleep(0.5))
            answers = 0

            def ask() -> None:
                nonlocal answers
                until = time.monotonic() + 0.5
                while time.monotonic() < until:
                    client.act(observation)
                    answers += 1

            busy = sample(mark, seconds, ask)
        print(f"TLS between nodes: {'yes' if tls else 'no'}; under load {answers / seconds:.0f} requests/s, JSON")
        report(idle, busy, seconds)
        if tls:
            refuse_without_certificate(environment, secured, gcs)


def node_environment(folder: Path, mark: str) -> dict[str, str]:
    """Return what both nodes have in their environment, with ports and files of our own."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    (first,) = free_ports(1)
    return own | cluster_environment(folder / "haproxy") | proxy_ports() | proxy_files(folder) | {
        MARK: mark,
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(first),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(first + 20),
    }  # fmt: skip


def make_certificates(folder: Path) -> dict[str, str]:
    """Make an authority and a certificate for this node; return Ray's variables. Every node has both (mutual TLS)."""

    def openssl(*words: object) -> None:
        subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True, timeout=60)

    authority, signer, request = folder / "ca.pem", folder / "ca.key", folder / "node.csr"
    certificate, key, extensions = folder / "node.pem", folder / "node.key", folder / "extensions"
    # Ray goes by the machine's address where it is told 127.0.0.1.
    extensions.write_text(f"subjectAltName=IP:127.0.0.1,IP:{get_node_ip_address()},DNS:localhost\n")
    kind = ("-newkey", "rsa:2048", "-nodes")
    openssl("req", "-x509", *kind, "-keyout", signer, "-out", authority, "-days", 2, "-subj", "/CN=ray CA")
    openssl("req", *kind, "-keyout", key, "-out", request, "-subj", "/CN=ray")
    openssl("x509", "-req", "-in", request, "-CA", authority, "-CAkey", signer, "-CAcreateserial", "-days", 2,
            "-extfile", extensions, "-out", certificate)  # fmt: skip
    return {
        "RAY_USE_TLS": "1",
        "RAY_TLS_SERVER_CERT": str(certificate),
        "RAY_TLS_SERVER_KEY": str(key),
        "RAY_TLS_CA_CERT": str(authority),
    }


@contextlib.contextmanager
def node(name: str, environment: Mapping[str, str], *words: str) -> Iterator[None]:
    """Run `ray start --block`; SIGTERM ends the node."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *words]
    process = subprocess.Popen(command, env={**environment, NODE: name}, stdout=subprocess.DEVNULL)
    try:
        time.sleep(5)  # the other node would find no head
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(30)


def deploy(policies: Path, folder: Path, environment: Mapping[str, str], port: int, dashboard: int) -> None:
    """Deploy the folder as deploy/kuberay does, with one replica; trying again until the head is up."""
    configuration = {
        "proxy_location": "HeadOnly",
        "http_options": {"host": "127.0.0.1", "port": port},
        "applications": [
            {
                "name": "rlservo",
                "route_prefix": "/",
                "import_path": "rlservo.serve_app.ray_serve.app:build",
                "args": {"policies": [str(policies)]},
            }
        ],
    }
    file = folder / "serve.yaml"
    file.write_text(json.dumps(configuration))  # JSON is YAML
    command = [sys.executable, "-m", "ray.serve.scripts", "deploy", str(file), "-a", f"http://127.0.0.1:{dashboard}"]
    deadline = time.monotonic() + START_S
    while (done := subprocess.run(command, env=dict(environment), capture_output=True, text=True)).returncode != 0:
        if time.monotonic() > deadline:
            raise SystemExit(done.stdout + done.stderr)
        time.sleep(1)


def sample(mark: str, seconds: float, act: Callable[[], None]) -> Readings:
    """Read every process until the time is up: the largest PSS, and the CPU seconds of the whole time."""
    before = readings(mark)
    largest: Readings = {}
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        act()
        for pid, (where, title, memory, cpu) in readings(mark).items():
            kept = largest.get(pid, ("", "", 0.0, 0.0))
            used = cpu - before.get(pid, ("", "", 0.0, 0.0))[3]
            largest[pid] = (where, title, max(memory, kept[2]), used)
    return largest


def readings(mark: str) -> Readings:
    """Read what carries the mark, and what that started: some of Ray's processes overwrite their environment."""
    found: Readings = {}
    nodes: dict[int, str] = {}
    for pid in find_marked(mark):
        with contextlib.suppress(OSError, psutil.Error):
            where = node_of(pid)
            for each in [pid, *(child.pid for child in psutil.Process(pid).children(recursive=True))]:
                nodes[each] = where or nodes.get(each, "?")
    for pid, where in nodes.items():
        process = Path("/proc") / str(pid)
        with contextlib.suppress(OSError, IndexError, ValueError):
            title = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
            rollup = (process / "smaps_rollup").read_text()
            memory = next(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) / 1024
            times = (process / "stat").read_text().rpartition(")")[2].split()
            found[pid] = (where, kind_of(title), memory, (int(times[11]) + int(times[12])) / TICKS)
    return found


def node_of(pid: int) -> str:
    variables = (Path("/proc") / str(pid) / "environ").read_bytes().split(b"\0")
    return next((each.decode().partition("=")[2] for each in variables if each.startswith(NODE.encode())), "")


def kind_of(title: str) -> str:
    """Return what a process is, from its command line."""
    names = (
        ("gcs_server", "GCS"), ("raylet/raylet", "raylet"), ("dashboard/dashboard.py", "dashboard"),
        ("dashboard/agent.py", "agents"), ("DashboardAgent", "agents"), ("runtime_env/agent", "agents"),
        ("RuntimeEnvAgent", "agents"), ("client.server", "client server"), ("multiprocessing", "dashboard"),
        ("monitor.py", "monitors"), ("log_monitor", "monitors"), ("ServeController", "controller"),
        ("ServeReplica", "replica"), ("ProxyActor", "proxy actor"), ("HAProxyManager", "proxy actor"),
        ("haproxy", "HAProxy and its watcher"), ("ray::IDLE", "idle workers"), ("ray.scripts", "ray start"),
    )  # fmt: skip
    return next((kind for part, kind in names if part in title), title[:60])


def report(idle: Readings, busy: Readings, seconds: float) -> None:
    """Print a line per node and kind of process, and each node's sum."""
    pairs = sorted({(where, kind) for where, kind, *_ in [*idle.values(), *busy.values()]})
    sums: dict[str, list[float]] = {}
    print(f"{'node':8}{'process':36}{'PSS [MB]':>10}{'CPU idle':>10}{'CPU busy':>10}")
    for where, kind in pairs:
        memory = max(total(each, where, kind, 2) for each in (idle, busy))
        cores = [total(each, where, kind, 3) / seconds for each in (idle, busy)]
        print(f"{where:8}{kind:36}{memory:10.0f}{cores[0]:10.3f}{cores[1]:10.3f}")
        for to in {where, "worker"} if kind in ("proxy actor", "HAProxy and its watcher") else {where}:
            sums[to] = [a + b for a, b in zip(sums.get(to, [0.0] * 3), [memory, *cores], strict=True)]
    for where, (memory, *cores) in sums.items():
        print(f"{where:8}{'as a pod':36}{memory:10.0f}{cores[0]:10.3f}{cores[1]:10.3f}")


def total(found: Readings, where: str, kind: str, column: int) -> float:
    return sum(float(each[column]) for each in found.values() if each[:2] == (where, kind))


def refuse_without_certificate(plain: Mapping[str, str], secured: Mapping[str, str], gcs: int) -> None:
    """Ask the cluster with its token, with and without the certificate; only the first may get an answer."""
    program = "import ray, sys; ray.init(sys.argv[1], logging_level='ERROR', log_to_driver=False); print('ANSWERED')"

    def is_answered(environment: Mapping[str, str]) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            asked = subprocess.run(
                [sys.executable, "-c", program, f"127.0.0.1:{gcs}"],
                env=dict(environment), capture_output=True, text=True, timeout=60,
            )  # fmt: skip
            return "ANSWERED" in asked.stdout
        return False

    if is_answered(plain) or not is_answered(secured):
        raise SystemExit("Ray answered a client that had no certificate, or none that had one")
    print("a client with the token and the certificate got an answer, one with the token alone none")


if __name__ == "__main__":
    main()
