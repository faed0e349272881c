"""Measure the cost of an export, and what `Policy.act` adds to the bare onnxruntime session.

    python benchmarks/export_policy.py [--rounds 15]

The shipped UR5 checkpoint (27-256-256-6) is exported by the command line in a fresh process: wall time with all
imports, CPU time and peak memory. Then `Policy.act` and the session's own `run` (for the action only, as in `act`)
alternate in this process; a round's ratio compares times measured a moment apart, and the median of the rounds counts.
The ratio of CPU times says more on a busy machine. Written to bench/export_policy.json.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import CPU, WALL, alternate, column, median_ratio, parser, rate, show, write

from rlservo.bundle.bundle import load_bundle
from rlservo.policy.ort_session import open_ort_session
from rlservo.policy.policy import Policy

CHECKPOINT = Path(__file__).resolve().parent.parent / "examples" / "checkpoints" / "ur5_positioning"
MOST_SECONDS = 8.0  # issue 3's targets
MOST_OVER_BARE = {1: 1.5, 1024: 1.1}
ROUND_S = 0.1


def export(out: Path) -> dict[str, float]:
    """Export by the command line and return what it cost."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(CHECKPOINT), "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": wall, "cpu_seconds": cpu, "peak_memory_mb": json.loads(done.stdout)["peak_memory_mb"]}


def compare(act: Callable[[], Any], bare: Callable[[], Any], rounds: int) -> dict[str, float]:
    """Return the microseconds per call of each, measured alternately, and the ratios."""
    found = alternate({"act": partial(rate, act, ROUND_S), "bare": partial(rate, bare, ROUND_S)}, rounds)
    per_s = {(name, clock): column(found[name], clock) for name in found for clock in (WALL, CPU)}
    return {
        **{f"{name}{'_cpu' * clock}": 1e6 / statistics.median(rates) for (name, clock), rates in per_s.items()},
        "ratio": median_ratio(per_s["bare", WALL], per_s["act", WALL]),
        "cpu_ratio": median_ratio(per_s["bare", CPU], per_s["act", CPU]),
    }


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=15, help="rounds of each comparison")
    args = options.parse_args()
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        cost = export(Path(folder))
        results: dict[str, Any] = {"export": cost}
        bundle = load_bundle(folder)
        policy, session = Policy.load(folder), open_ort_session(bundle.onnx)
        rng = np.random.default_rng(0)
        for batch, most in MOST_OVER_BARE.items():
            obs = rng.standard_normal((batch, 27)).astype(np.float32)
            act = partial(policy.act, obs[0] if batch == 1 else obs)
            results[f"batch {batch}"] = one = compare(act, partial(session.run, ["action"], {"obs": obs}), args.rounds)
            numbers = [one["act"], one["bare"], one["ratio"], one["cpu_ratio"], most]
            rows.append([f"{batch:,}", *(f"{number:.2f}" for number in numbers)])
    print(
        f"export: {cost['seconds']:.1f} s (at most {MOST_SECONDS:g} wanted), {cost['cpu_seconds']:.1f} s of CPU time, "
        f"{cost['peak_memory_mb']:.0f} MB at the peak"
    )
    show("", ("observations", "Policy.act [us]", "session.run [us]", "ratio", "of CPU times", "at most"), rows)
    write(args.out, "export_policy", results)


if __name__ == "__main__":
    main()
