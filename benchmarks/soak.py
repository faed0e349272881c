"""Ten minutes of mixed load over every protocol at a bounded rate, and whether the server's memory stays flat.

    python benchmarks/soak.py [--minutes 10] [--rate 200] [--replicas 2] [--bundle DIR]

JSON (single, batch, refused), the Open Inference Protocol (JSON, binary, compressed), WebSockets (kept, and opened
anew), metadata and metrics; the mix is in `MIX`. Every answer is checked: its status, and where it is an action, the
action. The resident memory of every replica and proxy is sampled; a line is fitted after a warm-up. Exits with 1 when
an answer was wrong or memory grew. Written to bench/soak.json.
"""

from __future__ import annotations

import argparse
import json
import re
import secrets
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from serving import OUT, policy
from speed.asks import Asker, askers
from speed.catalogue import Case, case_of, rlservo
from speed.loads import ClosedError, LoadError
from speed.machine import PROXY, REPLICA, rss_mb
from speed.servers import START_S, Exchange, Server, StartError, ask, running

WARM_UP = 0.5  # of the time: allocators and caches fill up first
SETTLE_S = 10.0  # after the last replica is there: Serve replaces HAProxy's process for each
REPLICA_LABEL = re.compile(rb'rlservo_policy_loaded\{[^}]*replica="([^"]*)"')
FLAT_MB = 3.0  # growth over the fitted time that counts as none: allocators move in steps of this size

Ask = Callable[[], None]


@dataclass
class Track:
    """A process's resident memory over time."""

    name: str
    role: str
    times_s: list[float]
    rss_mb: list[float]

    def growth(self, after_s: float) -> tuple[float, float]:
        """Return (growth [MB] over the time after `after_s` by a fitted line, slope [MB/h])."""
        times, values = np.array(self.times_s), np.array(self.rss_mb)
        late = times >= after_s
        if late.sum() < 3:
            return 0.0, 0.0
        slope = float(np.polyfit(times[late], values[late], 1)[0])
        return slope * float(np.ptp(times[late])), slope * 3600


def main() -> None:
    arguments = parse()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the server is ended then, too
    console = Console(highlight=False)
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rlsb-", ignore_cleanup_errors=True)))
        case = case_of(*policy(arguments, folder, console))
        server = rlservo(case, folder, replicas=arguments.replicas)
        try:
            cleanup.enter_context(running(server, folder, secrets.token_hex(8)))
        except StartError as error:
            raise SystemExit(str(error)) from None
        console.print(
            f"{arguments.minutes:g} minutes at {arguments.rate:g} requests/s, {arguments.replicas} replicas ..."
        )
        asks = mix(case, server, cleanup)
        counts, failures, tracks = soak(asks, server, arguments.minutes * 60, arguments.rate, console)
        console.print("stopping the server ...")
    grown = report(counts, failures, tracks, arguments, console)
    sys.exit(1 if grown or failures else 0)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=200.0, help="requests per second, all protocols together")
    parser.add_argument("--replicas", type=int, default=2)
    parser.add_argument("--bundle", type=Path, help="a bundle with a flat Box observation (default: the shipped UR5's)")
    arguments = parser.parse_args()
    arguments.checkpoint = Path()  # the peers' affair
    return arguments


# The mix


def mix(case: Case, server: Server, cleanup: ExitStack) -> dict[str, Ask]:
    """Return what is asked in turn, by name; each checks its own answer."""
    asks: dict[str, Ask] = {}
    for name, make in askers(case, server).items():
        cleanup.callback((asker := make()).close)
        asks[name] = asker if name.startswith("websocket") else partial(_patiently, asker)
    return asks


def _patiently(asker: Asker) -> None:
    try:
        asker()
    except (ConnectionError, ClosedError):  # an idle connection may be closed; a robot opens another
        asker()


MIX = ("json", "websocket", "oip binary", "json", "websocket", "grpc", "json", "oip json", "websocket", "json batch")
SELDOM = ("websocket anew", "json refused", "oip compressed", "contract", "metadata", "metrics")  # one in every turn


# The run


def settle(server: Server, replicas: int) -> None:
    """Wait for every replica, as each says in its metrics: the server answers as soon as the first does."""
    deadline = time.monotonic() + START_S
    metrics = replace(server, act=Exchange("GET", "/metrics", b""))
    seen: set[bytes] = set()
    while len(seen) < replicas:
        if time.monotonic() > deadline:
            raise SystemExit(f"{server.name} did not start {replicas} replicas within {START_S:g} s")
        seen |= set(REPLICA_LABEL.findall(ask(metrics)[1]))
        time.sleep(0.1)
    time.sleep(SETTLE_S)


def soak(
    asks: dict[str, Ask], server: Server, seconds: float, rate: float, console: Console
) -> tuple[Counter[str], Counter[str], dict[int, Track]]:
    """Ask in turn at the rate; return what was asked, what failed, and the memory of every process."""
    counts: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    tracks: dict[int, Track] = {}
    order = [name for seldom in SELDOM for name in (*MIX, seldom) if name in asks]
    began = now = time.monotonic()
    every = max(1.0, seconds / 120)
    next_sample, next_word = began, began + 60
    number = 0
    while now < began + seconds:
        if now >= next_sample:
            sample(server, tracks, now - began)
            next_sample += every
        if now >= next_word:
            console.print(
                f"{(now - began) / 60:.0f} min: {sum(counts.values())} answers, {sum(failures.values())} wrong"
            )
            next_word += 60
        name = order[number % len(order)]
        try:
            asks[name]()
            counts[name] += 1
        except (LoadError, OSError) as error:
            failures[f"{name}: {str(error)[:200]}"] += 1
            console.print(f"WRONG: {name}: {str(error)[:200]}", style="red", markup=False)
        number += 1
        time.sleep(max(0.0, began + number / rate - time.monotonic()))  # behind the rate: no catching up faster
        now = time.monotonic()
    sample(server, tracks, now - began)
    return counts, failures, tracks


def sample(server: Server, tracks: dict[int, Track], at_s: float) -> None:
    for pid, process in server.members().items():
        track = tracks.setdefault(pid, Track(process.command.split("/")[-1][:40], process.role, [], []))
        track.times_s.append(at_s)
        track.rss_mb.append(rss_mb(pid))


def report(
    counts: Counter[str],
    failures: Counter[str],
    tracks: dict[int, Track],
    arguments: argparse.Namespace,
    console: Console,
) -> bool:
    """Print and write; return whether a replica or proxy grew, or was replaced on the way."""
    whole = max((track.times_s[-1] for track in tracks.values()), default=0.0)
    rows = []
    judged = False
    for track in tracks.values():
        if track.role not in (REPLICA, PROXY):
            continue
        growth, slope = track.growth(WARM_UP * whole)
        lived = track.times_s[0] < 0.1 * whole and track.times_s[-1] >= whole - 1e-6
        flat = growth <= FLAT_MB and lived
        judged = judged or not flat
        rows.append(
            {
                "process": track.name,
                "role": track.role,
                "first_mb": round(track.rss_mb[0], 1),
                "last_mb": round(track.rss_mb[-1], 1),
                "growth_mb": round(growth, 2),
                "mb_per_hour": round(slope, 1),
                "verdict": "flat" if flat else "GREW" if lived else "DID NOT LAST",
            }
        )
        console.print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), markup=False)
    console.print(f"{sum(counts.values())} answers: {dict(counts)}", markup=False)
    for failure, times in failures.items():
        console.print(f"WRONG, {times} times: {failure}", style="red", markup=False)
    console.print(
        "memory grew" if judged else f"memory is flat: at most {FLAT_MB:g} MB over {(1 - WARM_UP) * whole:.0f} s"
    )
    OUT.mkdir(exist_ok=True)
    document = {
        "minutes": arguments.minutes,
        "rate": arguments.rate,
        "replicas": arguments.replicas,
        "answers": counts,
        "failures": failures,
        "processes": rows,
        "tracks": [vars(track) for track in tracks.values()],
    }
    (OUT / "soak.json").write_text(json.dumps(document) + "\n")
    return judged


if __name__ == "__main__":
    main()
