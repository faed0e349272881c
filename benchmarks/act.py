"""One `policy.act(obs)` in Python: the time to the action, and the processor time of client and server.

    python benchmarks/act.py              # two minutes
    python benchmarks/act.py --publish    # the same, and writes benchmarks/results/act.md

The ways alternate, since a machine's speed drifts by more than they differ. Processor time is the kernel's count. The
plain sockets send the very bytes that `PolicyClient` sends, to our server and to a bare uvicorn that checks nothing.
"""

from __future__ import annotations

import contextlib
import os
import platform
import socket
import statistics
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import alternate, column, median_ratio, parser, show, write
from serving import CHECKPOINT, POLICY, ROOT, exported, free_port, processor, started, wait_for_answer

import rlservo
from rlservo.client.stream_client import StreamClient
from serving_load import connect, end_of_reply, receive
from serving_peers import BARE, MAKERS, OURS, Case, case_of

PUBLISHED = ROOT / "benchmarks" / "results" / "act.md"
IN_PROCESS, HTTP, STREAM = "in process", "PolicyClient, HTTP", "StreamClient, WebSocket"
PLAIN, FLOOR = "plain socket, rlservo serve", "plain socket, bare uvicorn"
COLUMNS = ("", "p50", "p99", "p99.9", "client", "server", "p50 / bare", "processor / bare")
Figures = tuple[float, float, float, float, float]  # p50, p99, p99.9 [us]; the client's and the server's processor [us]


def measured(act: Callable[[], Any], server: int | None, seconds: float) -> Figures:
    """Act for some seconds; `server` is the id of its process."""
    for _ in range(50):
        act()
    durations, clock = [], time.perf_counter
    client_before, server_before = time.process_time(), processor_s(server)
    until = clock() + seconds
    while (began := clock()) < until:
        act()
        durations.append(clock() - began)
    client_s, server_s = time.process_time() - client_before, processor_s(server) - server_before
    p50, p99, p999 = (1e6 * float(value) for value in np.percentile(durations, (50, 99, 99.9)))
    return p50, p99, p999, 1e6 * client_s / len(durations), 1e6 * server_s / len(durations)


def processor_s(pid: int | None) -> float:
    """Return the processor time of a process's threads, to the nanosecond."""
    if pid is None:
        return 0.0
    files = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(file.read_text().split()[0]) for file in files) / 1e9


@contextlib.contextmanager
def sent_bytes(port: int) -> Iterator[tuple[int, list[bytes]]]:
    """Give the port of a relay to a server, and the list of what clients send through it."""
    sent: list[bytes] = []

    def relay() -> None:
        with contextlib.suppress(OSError):
            client, _ = listener.accept()
            with client, connect(port) as server:
                while request := client.recv(65536):
                    sent.append(request)
                    server.sendall(request)
                    reply = receive(server)
                    while not end_of_reply(reply):
                        reply += receive(server)
                    client.sendall(reply)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=relay, daemon=True)
        thread.start()
        yield listener.getsockname()[1], sent
    thread.join(1)


def plain(port: int, request: bytes) -> Callable[[], bytes]:
    """Return an exchange of bytes on a connection of its own."""
    connection = connect(port)

    def act() -> bytes:
        connection.sendall(request)
        reply = connection.recv(65536)
        while not end_of_reply(reply):
            reply += receive(connection)
        if not reply.startswith(b"HTTP/1.1 200"):
            raise RuntimeError(f"it answers {reply[:300]!r}")
        return reply

    return act


def run(case: Case, rounds: int, seconds: float) -> dict[str, list[Figures]]:
    ways: dict[str, tuple[Callable[[], Callable[[], Any]], int | None]] = {}  # made for each round
    name = case.bundle.parent.name
    with contextlib.ExitStack() as stack:
        ports, pids = {}, {}
        for server in (OURS, BARE):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="b"))
            ports[server] = free_port()
            peer = MAKERS[server](case, ports[server], Path(folder))
            process = stack.enter_context(started(peer))
            wait_for_answer(process, peer, case, ports[server])
            pids[server] = process.pid
        with sent_bytes(ports[OURS]) as (port, sent), rlservo.PolicyClient(f"http://127.0.0.1:{port}", name) as client:
            for _ in range(3):
                client.act(case.obs)
        url = f"http://127.0.0.1:{ports[OURS]}"
        local = stack.enter_context(rlservo.Policy.load(case.bundle))
        http = stack.enter_context(rlservo.PolicyClient(url, name))
        stream = stack.enter_context(StreamClient(url, name))
        for way, policy in ((IN_PROCESS, local), (HTTP, http), (STREAM, stream)):
            pid = None if policy is local else pids[OURS]
            ways[way] = partial(partial, policy.act, case.obs), pid
        for way, server in ((PLAIN, OURS), (FLOOR, BARE)):  # an idle connection is closed after some seconds
            ways[way] = partial(plain, ports[server], sent[-1]), pids[server]
        for policy in (local, http, stream):
            np.testing.assert_allclose(policy.act(case.obs), case.action, rtol=1e-4, atol=1e-5)
        make = {way: lambda act=act, pid=pid: measured(act(), pid, seconds) for way, (act, pid) in ways.items()}
        return alternate(make, rounds)


def report(found: dict[str, list[Figures]]) -> list[list[str]]:
    """Return the table's rows: medians of the rounds, and of the ratios within a round."""
    rows, floor = [], found[FLOOR]
    for way, rounds in found.items():
        cells = [f"{statistics.median(column(rounds, which)):,.0f}" for which in range(5)]
        p50 = median_ratio(column(rounds, 0), column(floor, 0))
        used = median_ratio((each[3] + each[4] for each in rounds), (each[3] + each[4] for each in floor))
        rows.append([way, *cells, f"{p50:.2f}", f"{used:.2f}"])
    return rows


def page(rows: list[list[str]], load: float) -> str:
    """Return the published page."""
    text = f"""
        `python benchmarks/act.py --publish`: this page. {os.cpu_count()} cores ({processor()}), Python
        {platform.python_version()}, load average {load:.1f} before the start. One `act` with the policy
        `examples/checkpoints/{POLICY}`, in microseconds: p50, p99, p99.9, the client's and the server's processor time.
        Medians of the rounds; the last two columns are ratios within a round to a plain socket and a bare uvicorn,
        which check nothing and exchange the same bytes."""
    text = "# What a robot waits for\n\n" + textwrap.fill(" ".join(text.split()), 118, break_on_hyphens=False) + "\n\n"
    lines = [COLUMNS, ["---"] * len(COLUMNS), *rows]
    return text + "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--rounds", type=int, default=7)
    arguments.add_argument("--seconds", type=float, default=1.0, help="of each way in each round")
    arguments.add_argument("--publish", action="store_true", help=f"write {PUBLISHED.relative_to(ROOT)}")
    given = arguments.parse_args()
    load = os.getloadavg()[0]
    checkpoint = CHECKPOINT / "learner_group/learner/rl_module/default_policy"
    found = run(case_of(exported(given.out.absolute()), POLICY, checkpoint), given.rounds, given.seconds)
    rows = report(found)
    show("One act, in microseconds", COLUMNS, rows)
    write(given.out, "act", found)
    if given.publish:
        PUBLISHED.write_text(page(rows, load))


if __name__ == "__main__":
    main()
