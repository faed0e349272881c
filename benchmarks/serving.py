"""Compare what serving one policy costs: rlservo against a bare server and what people would pick instead.

    python benchmarks/serving.py [--quick] [--publish] [--rounds N] [--starts N] [--only NAME ...]
                                 [--bundle DIR --checkpoint RL_MODULE_DIR]

One machine, one run, one policy (the shipped UR5's), one load generator (`wrk`, and for what it does not speak a line
client in Python). The peers come from PyPI and npm, each in an environment of its own, with one worker each. All
servers run at the same time and take turns in short rounds, so that a slow moment of the machine falls on all of them;
after them one replica and two, alone on the machine.
What is compared are ratios within rounds; absolute times belong to the machine. CPU time per request, of all of a
server's processes, depends on it less. Robots at their pace come from `speed/paced.py`, whose own share of a tail falls
on all servers alike. Results go to bench/serving.md, .json and .svg; with --publish the table and the chart also to
benchmarks/, to be committed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import secrets
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from speed import report
from speed.catalogue import BARE_ASGI, DIRECT, MAKERS, RLLIB, RLSERVO, TWO, Case, case_of, direct, rlservo, servers
from speed.machine import REPLICA, pss_mb
from speed.report import Result, verdicts
from speed.rounds import PLANNED_HZ, Rounds, Samples, carried, check_answers, scaling
from speed.servers import Server, StartError, running

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "bench"
UR5 = ROOT / "examples" / "checkpoints" / "ur5_positioning"
RL_MODULE = Path("learner_group") / "learner" / "rl_module" / "default_policy"


def main() -> None:
    arguments = parse()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the servers are ended then, too
    if shutil.which("wrk") is None:
        raise SystemExit("the load generator wrk is missing: apt-get install wrk")
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    with ExitStack() as cleanup:
        # A short name: Ray puts Unix sockets below it.
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rlsb-", ignore_cleanup_errors=True)))
        case = case_of(*policy(arguments, folder, console))
        console.print("preparing the peers' environments (the first time, a few minutes) ...")
        if strange := [name for name in arguments.only or () if name not in MAKERS]:
            raise SystemExit(f"--only: no server is called '{strange[0]}': there are {', '.join(MAKERS)}")
        compared, missing = servers(case, folder, arguments.only)
        result = measure(case, compared, folder, arguments, console)
        result.missing.update(missing)
    facts = {
        "when": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "rounds": arguments.rounds,
        "seconds": arguments.seconds,
        "load_average": arguments.load_average,
    }
    show(result, console)
    write(result, facts)
    if arguments.publish:
        for name in ("serving.md", "serving.svg"):
            shutil.copy(OUT / name, ROOT / "benchmarks" / name)
    console.print(f"written: {OUT.relative_to(ROOT)}/serving.md, serving.json, serving.svg")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter rounds: noisy, but the same path")
    parser.add_argument("--publish", action="store_true", help="renew benchmarks/serving.md and serving.svg, too")
    parser.add_argument("--rounds", type=int, help="turns of every server (default 7, quick: 3)")
    parser.add_argument("--starts", type=int, help="cold starts of rlservo and RLlib's example (default 3, quick: 1)")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="these servers, by the table's names, and rlservo")
    parser.add_argument("--bundle", type=Path, help="a bundle with a flat Box observation (default: the shipped UR5's)")
    parser.add_argument("--checkpoint", type=Path, help="the RLModule checkpoint of the same policy, for the example")
    arguments = parser.parse_args()
    if (arguments.bundle is None) != (arguments.checkpoint is None):
        parser.error("--bundle and --checkpoint belong together: RLlib's example serves the checkpoint itself")
    arguments.rounds = arguments.rounds or (3 if arguments.quick else 7)
    arguments.seconds = 1 if arguments.quick else 2
    if arguments.starts is None:
        arguments.starts = 1 if arguments.quick else 3
    arguments.load_average = os.getloadavg()
    return arguments


def policy(arguments: argparse.Namespace, folder: Path, console: Console) -> tuple[Path, Path]:
    """Return (bundle, RLModule checkpoint); export the shipped UR5 checkpoint unless others are named."""
    if arguments.bundle is not None:
        return arguments.bundle.absolute(), arguments.checkpoint.absolute()
    console.print("exporting the shipped UR5 checkpoint ...")
    command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(UR5), "--out", str(folder), "--name", "ur5"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"the shipped checkpoint could not be exported:\n{done.stderr[-2000:]}")
    return folder / "ur5", UR5 / RL_MODULE


def measure(
    case: Case, compared: list[Server], folder: Path, arguments: argparse.Namespace, console: Console
) -> Result:
    """Start, measure and stop everything."""
    mark = secrets.token_hex(8)
    cold = cold_starts(
        [one for one in compared if one.name in (RLSERVO, RLLIB)], folder, mark, arguments.starts, console
    )
    with ExitStack() as cleanup:
        started, missing = [], {}
        for server in compared:
            console.print(f"starting {server.name} ...")
            try:
                cleanup.enter_context(running(server, folder, mark))
            except StartError as error:
                if server.name == RLSERVO:
                    raise SystemExit(str(error)) from None
                missing[server.name] = str(error)
            else:
                cold.setdefault(server.name, server.cold_start_s)
                started.append(server)
                if server.name == RLSERVO:
                    started.append(direct(server))
        check_answers(started, case)
        samples = Rounds(case, started, folder, arguments.seconds).run(arguments.rounds, console.print)
        robots = {
            (one.name, rate_hz): carried(one, rate_hz, arguments.seconds)
            for rate_hz in PLANNED_HZ
            for one in started
            if one.name in (RLSERVO, DIRECT, BARE_ASGI)
        }
        replica_mb, server_mb = memory(started)
        console.print("stopping the servers ...")
    for key, taken in two_replicas(case, folder, mark, arguments, console).items():
        samples[key] = taken
    return Result(samples, cold, replica_mb, server_mb, missing, robots)


def cold_starts(pair: list[Server], folder: Path, mark: str, times: int, console: Console) -> dict[str, float]:
    """Return the median time from starting each server to its first action, alone on the machine, taking turns."""
    taken: dict[str, list[float]] = {server.name: [] for server in pair}
    for number in range(times):
        for server in pair:
            with running(server, folder, mark):
                taken[server.name].append(server.cold_start_s)
                console.print(f"cold start {number + 1} of {times}, {server.name}: {server.cold_start_s:.1f} s")
    return {name: statistics.median(each) for name, each in taken.items() if each}


def two_replicas(case: Case, folder: Path, mark: str, arguments: argparse.Namespace, console: Console) -> Samples:
    """Measure one replica and two in turns, each with the machine to itself: two take all of two cores."""
    samples: Samples = {}
    pair = [rlservo(case, folder), rlservo(case, folder, TWO, 2)]
    for number in range(arguments.rounds):
        for server in pair:
            console.print(f"round {number + 1} of {arguments.rounds}, alone on the machine: {server.name}")
            with running(server, folder, mark):
                for key, one in scaling([server, direct(server)], folder, arguments.seconds).items():
                    samples.setdefault(key, []).append(one)
    return samples


def memory(compared: list[Server]) -> tuple[dict[str, float], dict[str, float]]:
    """Return [MB] by server: of a replica, where there are replicas, and of all its processes."""
    replica, whole = {}, {}
    for server in compared:
        members = server.members()
        replicas = [pss_mb(pid) for pid, process in members.items() if process.role == REPLICA]
        if replicas:
            replica[server.name] = statistics.mean(replicas)
        whole[server.name] = sum(map(pss_mb, members))
    return replica, whole


def show(result: Result, console: Console) -> None:
    for title, headings, rows in (
        (
            "sequential JSON, then 16 and 64 connections (CPU: the whole server's, per request)",
            report.HEADINGS,
            report.table(result),
        ),
        ("one protocol and another", report.PROTOCOL_HEADINGS, report.protocols(result)),
        ("robots at their pace", report.PACED_HEADINGS, report.paced_loads(result)),
        ("robots with p99.9 under a quarter of the period", report.ROBOTS_HEADINGS, report.robots(result)),
    ):
        shown = Table(title=title, box=None, padding=(0, 1, 0, 0))  # no frame and narrow gaps: it fits a terminal
        for heading in headings:
            shown.add_column(heading, justify="left" if heading in headings[:1] else "right", no_wrap=True)
        for row in rows:
            shown.add_row(*row)
        console.print(shown)
    for verdict in verdicts(result):
        console.print(str(verdict), style="red" if verdict.holds is False else None, markup=False)
    for name, why in result.missing.items():
        console.print(f"not measured: {name}: {why}", style="red", markup=False)


def write(result: Result, facts: dict[str, Any]) -> None:
    OUT.mkdir(exist_ok=True)
    (OUT / "serving.json").write_text(json.dumps(report.document(result, facts), indent=1) + "\n")
    (OUT / "serving.md").write_text(report.markdown(result, facts))
    report.chart(result, OUT / "serving.svg")


if __name__ == "__main__":
    main()
