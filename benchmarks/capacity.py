"""Capacity of a server: CPU per decision by protocol, memory per policy, session and stream, start-up, size of a plan.

    python benchmarks/capacity.py POLICY_FOLDER [--recurrent POLICY_FOLDER] [--policies 1000] [--seconds 4]

for folders of one policy each: a stateless one, and one with a recurrent state for the memory of sessions. Every number
of policies is loaded in a process of its own; requests go through HAProxy to one replica of `rlservo serve`, and CPU is
what the kernel counted for the replica and for the proxy, so that a busy machine changes the rates and little else.
Ends with what it comes to for 10,000 robots at 20 Hz.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from rlservo.export.contract.bundle import GOLDEN_FILE, ONNX_FILE, TORCHSCRIPT_FILE, read_contract, write_contract
from rlservo.serve_app.episodes.episodes import Episodes
from rlservo.serve_app.episodes.request import Episode, Request
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.network_restorer import NetworkRestorer
from rlservo.serve_app.versions.plan import PRODUCTION, Plan, PolicyPlan, ServedConfig, now
from rlservo.serve_app.versions.policy_store import PolicyStore
from speed.asks import askers, open_stream
from speed.catalogue import Case, case_of, rlservo
from speed.machine import PROXY, REPLICA, cpu_by_role, pss_mb, rss_mb
from speed.servers import Server, running

KINDS = ("json", "oip json", "grpc", "websocket")  # one observation each
SESSIONS, STREAMS = 5000, 200
ROBOTS, RATE_HZ, POLICIES, VERSIONS = 10_000, 20.0, 1000, 100
BUSY = 0.6  # of a core that a replica may be busy: what `autoscaling.py` aims at, with room for bursts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--recurrent", type=Path)
    parser.add_argument("--policies", type=int, default=1000)
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="of load for each protocol and each number of robots"
    )
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the server is ended then, too
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    bundle = newest(arguments.policy)
    case = case_of(bundle, Path())
    with tempfile.TemporaryDirectory(prefix="rlsx-") as name:
        folder = Path(name)
        for count in sorted({1, arguments.policies // 10, arguments.policies} - {0}):
            copies = folder / str(count)
            copy_policy(bundle, copies, count)
            alone(load, copies, count)
        alone(load_some, folder / str(arguments.policies), max(1, arguments.policies // 10))
        if arguments.recurrent is not None:
            alone(remember, newest(arguments.recurrent))
        alone(plan, str(case.name))
        cpu_ms = serve(case, folder, arguments.seconds)
    on_paper(cpu_ms)


def newest(folder: Path) -> Path:
    return max(path.parent for path in folder.absolute().rglob("contract.json"))


def alone(measure: Callable[..., str], *given: Any) -> None:
    """Print what a measurement in a process of its own says."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        print(pool.submit(measure, *given).result(), flush=True)


def copy_policy(bundle: Path, folder: Path, count: int) -> None:
    """Make so many policies of one; they share the files, except for the contract."""
    folder.mkdir()
    graph = onnx.load(bundle / ONNX_FILE)
    del graph.metadata_props[:]  # the contract in it has one name
    onnx.save(graph, folder / ONNX_FILE)
    for file in (TORCHSCRIPT_FILE, GOLDEN_FILE):
        shutil.copyfile(bundle / file, folder / file)
    contract = read_contract(bundle)
    for number in range(count):
        name = f"policy-{number:04}"
        copy = folder / name / contract.version
        copy.mkdir(parents=True)
        for file in (ONNX_FILE, TORCHSCRIPT_FILE, GOLDEN_FILE):
            (copy / file).hardlink_to(folder / file)
        write_contract(copy, contract.model_copy(update={"name": name}))
    for file in (ONNX_FILE, TORCHSCRIPT_FILE, GOLDEN_FILE):
        (folder / file).unlink()


def load(folder: Path, count: int) -> str:
    """Load all policies of a folder as a replica does."""
    before, began, cpu = rss_mb(os.getpid()), time.perf_counter(), time.process_time()
    store = load_served(
        [folder], ServedConfig(), ServerSettings.from_environment({"load_timeout_s": 600.0, "scan_timeout_s": 600.0})
    )
    taken, used, grown = time.perf_counter() - began, time.process_time() - cpu, rss_mb(os.getpid()) - before
    found = len(store.names)
    assert found == count, f"{found} of {count} policies were loaded"
    store.close()
    return f"{count} policies: {taken:.1f} s, {used:.2f} CPU s ({1e3 * used / count:.1f} ms each), {grown:.0f} MB"


def load_some(folder: Path, fitting: int) -> str:
    """Load all policies of a folder with a bound that so many networks fit into; open those again that were dropped."""
    size = (newest(folder) / ONNX_FILE).stat().st_size
    before, began, cpu = rss_mb(os.getpid()), time.perf_counter(), time.process_time()
    patience = {"load_timeout_s": 600.0, "scan_timeout_s": 600.0}
    store = load_served(
        [folder], ServedConfig(), ServerSettings.from_environment({"network_bytes": size * fitting, **patience})
    )
    taken, used, grown = time.perf_counter() - began, time.process_time() - cpu, rss_mb(os.getpid()) - before
    networks = [network for name in store.names if (network := store.get(name).droppable) is not None]
    restorer, opened_ms = NetworkRestorer(), []

    async def restore() -> None:
        for index in np.random.default_rng(0).integers(0, len(networks), 600):
            if not networks[index].is_in_memory:
                since = time.perf_counter()
                await restorer.restore(networks[index], 60.0)
                opened_ms.append(1e3 * (time.perf_counter() - since))

    asyncio.run(restore())
    after = rss_mb(os.getpid()) - before
    p50, p99 = np.percentile(opened_ms, (50, 99))
    store.close()
    return (
        f"{len(networks)} policies, {fitting} in memory: {taken:.1f} s, {used:.2f} CPU s, {grown:.0f} MB, "
        f"{after:.0f} MB after {len(opened_ms)} were opened again (p50 {p50:.1f} ms, p99 {p99:.1f} ms each)"
    )


def remember(bundle: Path) -> str:
    """Fill sessions."""
    policy = Policy.load(bundle)
    name, version = policy.contract.name, policy.contract.version
    store = PolicyStore([policy], {name: PolicyPlan(versions={version: policy.digest}, aliases={PRODUCTION: version})})
    episodes = Episodes(max_sessions=SESSIONS + 1, idle_s=600.0)
    obs = case_of(bundle, Path()).obs
    before = 0.0
    for number in range(SESSIONS + 1):
        if number == 1:
            before = rss_mb(os.getpid())
        request = Request("json", name, None, time.perf_counter(), obs=obs, seq=0)
        request.episode = Episode(session_id=secrets.token_hex(16), reset=True)
        episodes.act(store, request)
    each_kb = (rss_mb(os.getpid()) - before) * 2**20 / 1e3 / SESSIONS
    floats = sum(int(np.prod(spec.shape)) for spec in policy.contract.state)
    return f"a session of {name} ({floats} numbers of state): {each_kb:.1f} kB"


def plan(name: str) -> str:
    """Write down what is served."""
    digest = secrets.token_hex(32)

    def size(policies: int, versions: int) -> int:
        one = PolicyPlan(
            versions={str(number): digest for number in range(1, versions + 1)}, aliases={PRODUCTION: str(versions)}
        )
        names = [f"{name}-{number:04}" for number in range(policies)]
        made = Plan(
            generation=1, config=digest, policies=dict.fromkeys(names, one), changed_at=now(), changed_by="capacity.py"
        )
        return len(made.model_dump_json())

    return (
        f"a plan of {POLICIES} policies: in 1 version each {size(POLICIES, 1) / 1e3:.0f} kB, "
        f"in {VERSIONS} {size(POLICIES, VERSIONS) / 1e6:.1f} MB"
    )


def serve(case: Case, folder: Path, seconds: float) -> dict[str, float]:
    """Ask one replica; return the CPU [ms] that a decision takes of it and of the proxy, by protocol."""
    server, cpu_ms = rlservo(case, folder), dict[str, float]()
    with running(server, folder, secrets.token_hex(8)):
        time.sleep(5.0)  # Serve replaces HAProxy once
        for kind in KINDS:
            before = cpu_by_role(server.members())
            answers = ask(askers(case, server)[kind], seconds)
            used = {role: value - before[role] for role, value in cpu_by_role(server.members()).items()}
            replica, proxy = (1e3 * used[role] / answers for role in (REPLICA, PROXY))
            cpu_ms[kind] = replica + proxy
            print(f"{kind}: {answers / seconds:.0f}/s, CPU a decision: replica {replica:.3f} ms, proxy {proxy:.3f} ms")
        hold(server)
        for robots in (10, 20, 40, 80):
            late, rate = asyncio.run(drive(server, robots, seconds))
            print(f"{robots} robots at {RATE_HZ:g} Hz: {rate:.0f} decisions/s, {100 * late:.1f}% after their period")
    return cpu_ms


def ask(make: Callable[[], Any], seconds: float, clients: int = 4) -> int:
    """Ask with several clients without pause; return how often they were answered."""
    until, counts = time.monotonic() + seconds, [0] * clients

    def loop(which: int) -> None:
        client = make()
        while time.monotonic() < until:
            client()
            counts[which] += 1
        client.close()

    threads = [threading.Thread(target=loop, args=(which,)) for which in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(counts)


def hold(server: Server) -> None:
    """Open streams that ask once."""

    def memory() -> dict[str, float]:
        found = {REPLICA: 0.0, PROXY: 0.0}
        for pid, process in server.members().items():
            if process.role in found:
                found[process.role] += pss_mb(pid)
        return found

    before, streams = memory(), []
    try:
        for _ in range(STREAMS):
            streams.append(open_stream(server))
            streams[-1]()
        after = memory()
    finally:
        for stream in streams:
            stream.close()
    replica, proxy = (1e3 * (after[role] - before[role]) / STREAMS for role in (REPLICA, PROXY))
    print(f"a stream: replica {replica:.0f} kB, proxy {proxy:.0f} kB")


async def drive(server: Server, robots: int, seconds: float) -> tuple[float, float]:
    """Let robots ask at their rate, each over its connection; return (share of late answers, decisions a second)."""
    body = server.act.body
    head = f"POST {server.act.path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: "
    message = f"{head}{len(body)}\r\n\r\n".encode() + body
    late = answered = 0

    async def robot(number: int) -> None:
        nonlocal late, answered
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        due = began + number / robots / RATE_HZ
        while due < began + seconds:
            await asyncio.sleep(due - time.monotonic())
            writer.write(message)
            answer = await reader.readuntil(b"\r\n\r\n")
            if b" 200 " not in answer.split(b"\r\n", 1)[0]:
                raise SystemExit(f"no action: {answer!r}")
            lines = dict(line.lower().split(b": ", 1) for line in answer.split(b"\r\n")[1:] if b": " in line)
            await reader.readexactly(int(lines[b"content-length"]))
            answered += 1
            late += time.monotonic() > due + 1 / RATE_HZ
            due += 1 / RATE_HZ
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()

    began = time.monotonic()
    await asyncio.gather(*(robot(number) for number in range(robots)))
    return late / answered, answered / (time.monotonic() - began)


def on_paper(cpu_ms: dict[str, float]) -> None:
    decisions = ROBOTS * RATE_HZ
    for kind, each in cpu_ms.items():
        cores = decisions * each / 1e3
        print(f"{ROBOTS:,} robots at {RATE_HZ:g} Hz over {kind}: {cores:.0f} cores busy, {cores / BUSY:.0f} to have")


if __name__ == "__main__":
    main()
