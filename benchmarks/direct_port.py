"""Compare the direct port with the proxy and with a bare ASGI server: in turns, and paced as robots ask.

    python benchmarks/direct_port.py [--rounds N] [--seconds S] [--bundle DIR]

One replica each, the shipped UR5's policy. `wrk` asks over one and over 16 connections as fast as it goes; then 16
robots ask at 50 Hz and 64 at 20 Hz, with latencies from when each should have asked (`speed/paced.py`). All take turns
in short rounds; medians are shown, and a round's own ratio over the bare server.
"""

from __future__ import annotations

import argparse
import secrets
import signal
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rlservo.serve_app.ray_serve.processes import free_ports
from speed import loads
from speed.catalogue import PEERS, Case, asked, case_of, plain
from speed.machine import REPLICA, cpu_by_role
from speed.paced import http_robot, paced, stream_robot
from speed.servers import Server, running

ROOT = Path(__file__).resolve().parent.parent
UR5 = ROOT / "examples" / "checkpoints" / "ur5_positioning"
FLEETS = ((16, 50.0), (64, 20.0))
BARE, PROXY, DIRECT = "bare ASGI", "through HAProxy", "direct port"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each turn of a paced load; of wrk, 2")
    parser.add_argument("--bundle", type=Path, help="default: the shipped UR5 checkpoint's, exported first")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the servers are ended then, too
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rlsb-", ignore_cleanup_errors=True)))
        case = case_of(arguments.bundle or export(folder), UR5)
        mark = secrets.token_hex(8)
        for server in (ours := rlservo(case), bare := bare_asgi(case)):
            cleanup.enter_context(running(server[0], folder, mark))
        table = measure(ours, bare, folder, arguments.rounds, arguments.seconds)
    for row in table:
        print(row)


def export(folder: Path) -> Path:
    command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(UR5), "--out", str(folder), "--name", "ur5"]
    subprocess.run(command, check=True, capture_output=True)
    return folder / "ur5"


def rlservo(case: Case) -> tuple[Server, int]:
    """Return (server, its direct port)."""
    port, direct = free_ports(2)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(case.bundle.path), "--port", str(port)]
    return asked(case, PROXY, [*command, "--direct-port", str(direct)], port), direct


def bare_asgi(case: Case) -> tuple[Server, int]:
    (port,) = free_ports(1)
    command = [sys.executable, str(PEERS / "bare_asgi.py"), str(port), case.onnx_file]
    act = plain(case, "/act")
    return Server(BARE, command, port, act, stream="/", message=case.obs.tobytes()), port


def measure(ours: tuple[Server, int], bare: tuple[Server, int], folder: Path, rounds: int, seconds: float) -> list[str]:
    """Return the table's rows."""
    ways = [(BARE, *bare), (PROXY, ours[0], ours[0].port), (DIRECT, *ours)]
    found: dict[tuple[str, str], list[float]] = {}

    def note(what: str, way: str, value: float) -> None:
        found.setdefault((what, way), []).append(value)

    for number in range(rounds):
        shift = number % len(ways)
        for way, server, port in ways[shift:] + ways[:shift]:
            for connections in (1, 16):
                before = cpu_by_role(server.members())
                load = loads.wrk(port, server.act, folder, connections=connections, seconds=2)
                after = cpu_by_role(server.members())
                role = REPLICA if way != BARE else max(after, key=lambda role: after[role] - before[role])
                note(f"JSON, {connections} connections: p50 [ms]", way, load.p50_ms)
                note(f"JSON, {connections} connections: requests/s", way, load.per_s)
                note(
                    f"JSON, {connections} connections: CPU of the replica [us]",
                    way,
                    (after[role] - before[role]) * 1e6 / load.count,
                )
            assert server.stream is not None
            line = loads.WebSocketLine(port, server.stream, server.message, greets=server.greets)
            note("WebSocket: p50 [ms]", way, loads.timed(line, 1.0).p50_ms)
            line.close()
            for robots, rate in FLEETS:
                for protocol, make in (
                    ("JSON", partial(http_robot, port, server.act)),
                    ("WebSocket", partial(stream_robot, port, server.stream, server.message, server.greets)),
                ):
                    load_of_robots = paced(make, robots=robots, rate_hz=rate, seconds=seconds)
                    fleet = f"{protocol}, {robots} robots at {rate:g} Hz"
                    note(f"{fleet}: p50 [ms]", way, load_of_robots.p50_ms)
                    note(f"{fleet}: p99 [ms]", way, load_of_robots.p99_ms)
                    note(f"{fleet}: p99.9 [ms]", way, load_of_robots.p999_ms)
                    note(f"{fleet}: later than half a period [%]", way, 100 * load_of_robots.late)
    names = [way for way, _, _ in ways]
    rows = [f"| | {' | '.join(names)} | direct over bare |", "|---" * (len(names) + 2) + "|"]
    for what in dict.fromkeys(what for what, _ in found):
        values = [f"{statistics.median(found[what, way]):.3g}" for way in names]
        pairs = [a / b for a, b in zip(found[what, DIRECT], found[what, BARE], strict=True) if b]
        rows.append(
            f"| {what} | {' | '.join(values)} | {statistics.median(pairs):.2f} |"
            if pairs
            else f"| {what} | {' | '.join(values)} | |"
        )
    return rows


if __name__ == "__main__":
    main()
