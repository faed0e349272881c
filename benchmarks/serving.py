"""Compare what serving one policy costs: in process, bare FastAPI, rlservo, and Ray Serve with RLlib's own example.

    python benchmarks/serving.py [--quick] [--bundle DIR --checkpoint RL_MODULE_DIR]

One machine, one run, one policy, one load generator: a sequential client that keeps its connection. All servers run at
the same time, each in its own processes, and take turns, so that a slow moment of the machine falls on all of them.
What is compared are ratios; absolute times belong to the machine. Results go to bench/serving.json and
bench/serving.md. Where `wrk` is installed, requests per second with 1 and 16 connections are measured as well.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import secrets
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rlservo.export.bundle import ONNX_FILE, Contract, load_bundle
from rlservo.serve_app.client import PolicyClient
from rlservo.serve_app.policy import Policy

ROOT = Path(__file__).resolve().parent.parent
PEERS = ROOT / "benchmarks" / "peers"
OUT = ROOT / "bench"
MARK = "RLSERVO_BENCHMARK"  # in the environment of every process started here, so that none can be left unnoticed
START_S = 180.0  # a cold Ray on a small machine needs most of a minute
STOP_S = 60.0
WARM_UP = 50  # calls before a round counts
MOST_OVER_BARE = 2.5  # issue 2's targets
LEAST_UNDER_RAY = 8.0

BARE, RLSERVO, RLLIB = "uvicorn + FastAPI", "rlservo serve", "Ray Serve, RLlib example"
CLIENT = "rlservo via PolicyClient"
SESSION, IN_PROCESS = "onnxruntime in process", "Policy.act in process"

Call = Callable[[], object]


@dataclass
class Server:
    """A peer: how it is started and what it is asked."""

    name: str
    command: list[str]
    port: int
    method: str
    path: str
    body: bytes
    env: dict[str, str] = field(default_factory=dict)


@dataclass
class Row:
    """One peer's result: the medians over the rounds [ms]; ratios are medians of the rounds' own ratios."""

    name: str
    p50_ms: float
    p95_ms: float
    p99_ms: float
    calls_per_s: float
    calls: int
    over_bare: float
    wrk_1_per_s: float | None = None  # a leaner client than Python's: shows more of the servers' difference
    wrk_16_per_s: float | None = None


def main() -> None:
    arguments = parse()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the servers are ended then, too
    console = Console()
    rounds, seconds = (3, 0.7) if arguments.quick else (7, 2.0)
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rlsb-", ignore_cleanup_errors=True)))
        mark = secrets.token_hex(8)
        cleanup.callback(report_leftovers, mark, console)
        bundle, checkpoint = arguments.bundle, arguments.checkpoint
        if bundle is None:
            console.print("writing a sample policy (27 observations, 2 x 256 tanh, 6 actions) ...")
            write_sample(folder, mark)
            bundle, checkpoint = folder / "bundle", folder / "rl_module"
        policy = cleanup.enter_context(Policy.load(bundle))
        obs = observation_of(policy.contract)
        servers = peers(bundle, checkpoint, policy.contract, obs, folder)
        for server in servers:
            console.print(f"starting {server.name} ...")
            cleanup.enter_context(running(server, folder, mark))
        check_answers(servers, policy, obs)
        calls = calls_of(policy, obs, servers, cleanup)
        console.print(f"measuring {len(calls)} ways, {rounds} rounds of {seconds:g} s each ...")
        rows = summarise(measure(calls, rounds, seconds))
        if shutil.which("wrk") is not None:
            for row, server in ((row, server) for row in rows for server in servers if row.name == server.name):
                row.wrk_1_per_s, row.wrk_16_per_s = (
                    wrk(server, folder, count, 2 if arguments.quick else 8) for count in (1, 16)
                )
        console.print("stopping the servers ...")
    show(rows, console)
    write(rows, rounds, seconds)
    console.print(f"written: {OUT.relative_to(ROOT)}/serving.json, {OUT.relative_to(ROOT)}/serving.md")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few seconds of measuring: noisy, but the same path")
    parser.add_argument("--bundle", type=Path, help="a bundle with a flat Box observation (default: a sample policy)")
    parser.add_argument("--checkpoint", type=Path, help="the RLModule checkpoint of the same policy, for the example")
    arguments = parser.parse_args()
    if (arguments.bundle is None) != (arguments.checkpoint is None):
        parser.error("--bundle and --checkpoint belong together: RLlib's example serves the checkpoint itself")
    return arguments


# -- the peers


def peers(bundle: Path, checkpoint: Path, contract: Contract, obs: np.ndarray[Any, Any], folder: Path) -> list[Server]:
    """Return the three servers; each has its own port, and those on Ray their own folder and token."""
    python = sys.executable
    onnx_file = str(load_bundle(bundle).path / ONNX_FILE)
    ours = json.dumps({"obs": obs.tolist()}).encode()
    theirs = json.dumps({"observation": obs.tolist()}).encode()
    ports = free_ports(3)

    def script(name: str, *arguments: object) -> list[str]:
        return [python, str(PEERS / name), *map(str, arguments)]

    # A token of our own: a local ray.init() would otherwise write one into the user's home and keep using it.
    ray = {"RAY_TMPDIR": str(folder), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    act = f"/v1/policies/{contract.name}/act"
    return [
        Server(BARE, script("bare.py", ports[0], onnx_file), ports[0], "POST", "/act", ours),
        Server(RLSERVO, script("rlservo_server.py", ports[1], bundle), ports[1], "POST", act, ours),
        Server(
            RLLIB, script("rllib_example.py", ports[2], checkpoint), ports[2], "GET", "/rllib-rlmodule", theirs, ray
        ),
    ]


def write_sample(folder: Path, mark: str) -> None:
    command = [sys.executable, str(PEERS / "sample_policy.py"), str(folder)]
    done = subprocess.run(command, env=environment(mark), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"the sample policy could not be written:\n{done.stderr[-2000:]}")


@contextmanager
def running(server: Server, folder: Path, mark: str) -> Iterator[None]:
    """Start the server, wait until it answers, and at the end stop it and see that its port is free."""
    log = folder / f"{server.port}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            server.command, env=environment(mark, server.env), stdout=output, stderr=output, start_new_session=True
        )
    try:
        wait_until_answering(server, process, log)
        yield
    finally:
        stop(process)
        if listening(server.port):
            print(f"{server.name}: port {server.port} is still in use after it was stopped", file=sys.stderr)


def wait_until_answering(server: Server, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        with suppress(OSError):
            if ask_once(server)[0] == 200:
                return
        time.sleep(0.3)
    text = log.read_text(errors="replace")[-3000:]
    raise SystemExit(f"{server.name} did not come up within {START_S:g} s; the end of its log:\n{text}")


def stop(process: subprocess.Popen[bytes]) -> None:
    """Ask with SIGTERM, wait, then end the process group: it is the one that was started here."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def environment(mark: str, extra: dict[str, str] | None = None) -> dict[str, str]:
    """Return the environment of a peer: the user's own RAY_* settings would not be Ray's defaults."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    return {**kept, **(extra or {}), MARK: mark}


def report_leftovers(mark: str, console: Console) -> None:
    """Name and end every process that carries this run's mark."""
    deadline = time.monotonic() + 10  # Ray's processes go one after the other
    while (left := marked(mark)) and time.monotonic() < deadline:
        time.sleep(0.3)
    for pid, command in left.items():
        console.print(f"left behind and ended now: {pid} {command[:100]}", style="red", markup=False)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    if not left:
        console.print("nothing was left running")


def marked(mark: str) -> dict[int, str]:
    """Return pid -> command of the processes started by this run (Linux only; elsewhere none is seen)."""
    found: dict[int, str] = {}
    needle = f"{MARK}={mark}".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if needle in (entry / "environ").read_bytes():
                found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue  # gone meanwhile, or another user's
    return found


# -- the load


def calls_of(policy: Policy, obs: np.ndarray[Any, Any], servers: list[Server], cleanup: ExitStack) -> dict[str, Call]:
    """Return one call per way; each has its connection or session open."""

    def through(client: PolicyClient) -> Call:
        return lambda: client.act(obs)

    run, feed = session_of(policy), {"obs": obs[None]}
    calls: dict[str, Call] = {
        SESSION: lambda: run(["action"], feed),
        IN_PROCESS: lambda: policy.act(obs),
    }
    for server in servers:
        calls[server.name] = keep_alive(server, cleanup)
        if server.name == RLSERVO:
            url = f"http://127.0.0.1:{server.port}"
            client = cleanup.enter_context(PolicyClient(url, policy.contract.name, timeout_s=30.0))
            calls[CLIENT] = through(client)
    return calls


def session_of(policy: Policy) -> Callable[..., Any]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(policy.path / ONNX_FILE), options, providers=["CPUExecutionProvider"])
    run: Callable[..., Any] = session.run
    return run


def keep_alive(server: Server, cleanup: ExitStack) -> Call:
    """Return a call that sends the request on one kept connection, reads the answer, and demands a 200."""
    connection = HTTPConnection("127.0.0.1", server.port, timeout=30)
    cleanup.callback(connection.close)
    headers = {"content-type": "application/json"}

    def exchange() -> HTTPResponse:
        connection.request(server.method, server.path, server.body, headers)
        return connection.getresponse()

    def call() -> bytes:
        try:
            response = exchange()
        except ConnectionError:  # closed by the server while the others had their turn; falls into the warm-up
            connection.close()
            response = exchange()
        body = response.read()
        if response.status != 200:
            raise SystemExit(f"{server.name} answered {response.status}: {body[:300]!r}")
        return body

    return call


def ask_once(server: Server) -> tuple[int, bytes]:
    connection = HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request(server.method, server.path, server.body, {"content-type": "application/json"})
        response = connection.getresponse()
        return response.status, response.read()
    except TimeoutError as error:
        raise OSError("no answer yet") from error
    finally:
        connection.close()


def check_answers(servers: list[Server], policy: Policy, obs: np.ndarray[Any, Any]) -> None:
    """See that the servers that return the policy's action return the same one."""
    expected = policy.act(obs)
    for server in servers:
        answer = json.loads(ask_once(server)[1])["action"]
        if server.name != RLLIB and not np.allclose(answer, expected, atol=1e-5):
            raise SystemExit(f"{server.name} answers {answer}, the policy itself {expected.tolist()}")


def measure(calls: dict[str, Call], rounds: int, seconds: float) -> dict[str, list[np.ndarray[Any, Any]]]:
    """Return the latencies [ms] of each round; the order turns by one each round."""
    names = list(calls)
    latencies: dict[str, list[np.ndarray[Any, Any]]] = {name: [] for name in names}
    for number in range(rounds):
        for name in names[number % len(names) :] + names[: number % len(names)]:
            latencies[name].append(one_round(calls[name], seconds))
    return latencies


def one_round(call: Call, seconds: float) -> np.ndarray[Any, Any]:
    for _ in range(WARM_UP):
        call()
    taken: list[float] = []
    now = time.perf_counter()
    end = now + seconds
    while now < end:
        call()
        then, now = now, time.perf_counter()
        taken.append(now - then)
    return 1e3 * np.array(taken)


def wrk(server: Server, folder: Path, connections: int, seconds: int) -> float:
    """Return requests per second over so many connections."""
    script = folder / "wrk.lua"
    # A long bracket of level 1 cannot end inside JSON.
    script.write_text(
        f'wrk.method = "{server.method}"\nwrk.body = [=[{server.body.decode()}]=]\n'
        'wrk.headers["Content-Type"] = "application/json"\n'
    )
    url = f"http://127.0.0.1:{server.port}{server.path}"
    command = ["wrk", "-t1", f"-c{connections}", f"-d{seconds}s", "-s", str(script), url]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    if "Non-2xx" in text or "Socket errors" in text:
        raise SystemExit(f"{server.name} failed under wrk with {connections} connections:\n{text}")
    line = next(line for line in text.splitlines() if line.startswith("Requests/sec"))
    return float(line.split(":")[1])


# -- the result


def summarise(latencies: dict[str, list[np.ndarray[Any, Any]]]) -> list[Row]:
    medians = {name: [float(np.median(one)) for one in rounds] for name, rounds in latencies.items()}
    rows: list[Row] = []
    for name, rounds in latencies.items():
        p50, p95, p99 = (statistics.median(float(np.percentile(one, p)) for one in rounds) for p in (50, 95, 99))
        rows.append(
            Row(
                name=name,
                p50_ms=p50,
                p95_ms=p95,
                p99_ms=p99,
                calls_per_s=statistics.median(1e3 / float(one.mean()) for one in rounds),
                calls=sum(len(one) for one in rounds),
                over_bare=statistics.median(a / b for a, b in zip(medians[name], medians[BARE], strict=True)),
            )
        )
    return rows


def verdicts(rows: list[Row]) -> list[str]:
    ratio = {row.name: row.over_bare for row in rows}
    under = ratio[RLLIB] / ratio[RLSERVO]
    return [
        f"rlservo serve takes {ratio[RLSERVO]:.2f} times as long as the bare server (wanted: at most {MOST_OVER_BARE})",
        f"rlservo serve is {under:.1f} times faster than Ray Serve's defaults with RLlib's example "
        f"(wanted: at least {LEAST_UNDER_RAY:g})",
    ]


def cells(row: Row) -> list[str]:
    wrks = ["" if rate is None else f"{rate:,.0f}" for rate in (row.wrk_1_per_s, row.wrk_16_per_s)]
    times = [f"{value:.3f}" if value >= 0.1 else f"{value:.4f}" for value in (row.p50_ms, row.p95_ms, row.p99_ms)]
    return [row.name, *times, f"{row.calls_per_s:,.0f}", f"{row.over_bare:.2f}", *wrks]


HEADINGS = ["server", "p50 ms", "p95 ms", "p99 ms", "calls/s", "x bare", "wrk c=1", "wrk c=16"]


def show(rows: list[Row], console: Console) -> None:
    # No frame and narrow gaps: it fits a terminal of 80 columns.
    table = Table(title="one observation in, one action out, sequential", box=None, padding=(0, 1, 0, 0))
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading == "server" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*cells(row))
    console.print(table)
    for sentence in verdicts(rows):
        console.print(sentence, highlight=False)


def write(rows: list[Row], rounds: int, seconds: float) -> None:
    OUT.mkdir(exist_ok=True)
    document = {
        "when": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": {"cores": os.cpu_count(), "system": platform.platform(), "python": platform.python_version()},
        "rounds": rounds,
        "seconds_per_round": seconds,
        "load_average": os.getloadavg(),
        "rows": [asdict(row) for row in rows],
        "verdicts": verdicts(rows),
    }
    (OUT / "serving.json").write_text(json.dumps(document, indent=2) + "\n")
    lines = ["| " + " | ".join(line) + " |" for line in (HEADINGS, ["---"] * len(HEADINGS), *map(cells, rows))]
    (OUT / "serving.md").write_text("\n".join([*lines, "", *(f"- {line}" for line in verdicts(rows))]) + "\n")


# -- ports


def free_ports(count: int) -> list[int]:
    """Return ports that are free now, all different because all are held at once."""
    with ExitStack() as held:
        sockets = [held.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


def listening(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def observation_of(contract: Contract) -> np.ndarray[Any, Any]:
    space = contract.observation_space
    if space.kind != "box" or len(space.shape) != 1:
        raise SystemExit(f"the bare server reads a flat list of numbers; policy {contract.name!r} expects {space}")
    low, high = space.bounds()
    drawn = np.random.default_rng(0).uniform(np.maximum(low, -1.0), np.minimum(high, 1.0))
    return drawn.astype(space.dtype)


if __name__ == "__main__":
    main()
