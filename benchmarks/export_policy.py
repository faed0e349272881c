"""Measure the cost of an export, and what `Policy.act` adds to the bare onnxruntime session.

    python benchmarks/export_policy.py [--rounds 15]

The shipped UR5 checkpoint (27-256-256-6) is exported by the command line in a fresh process: wall time with all
imports, CPU time and peak memory. Then `Policy.act` and the session's own `run` (for the action only, as in `act`)
alternate in this process; a round's ratio compares times measured a moment apart, and the median of the rounds counts.
The ratio of CPU times says more on a busy machine. Written to bench/export_policy.json.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rlservo.export.contract.bundle import load_bundle
from rlservo.export.contract.ort_session import open_ort_session
from rlservo.serve_app.runtime.policy import Policy

ROOT = Path(__file__).resolve().parent.parent
CHECKPOINT = ROOT / "examples" / "checkpoints" / "ur5_positioning"
OUT = ROOT / "bench"
MOST_SECONDS = 8.0  # issue 3's targets
MOST_OVER_BARE = {1: 1.5, 1024: 1.1}
CALLS = {1: 3000, 1024: 20}  # a round, a few hundredths of a second


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


def compare(act: Callable[[], Any], bare: Callable[[], Any], calls: int, rounds: int) -> dict[str, float]:
    """Return the microseconds per call of each, measured alternately, and the ratios."""
    found: dict[str, list[float]] = {"act": [], "bare": [], "act_cpu": [], "bare_cpu": []}
    for number in range(rounds + 1):
        sides = [("act", act), ("bare", bare)]
        for name, call in sides if number % 2 else reversed(sides):
            began, cpu_began = time.perf_counter(), time.process_time()
            for _ in range(calls):
                call()
            wall, cpu = time.perf_counter() - began, time.process_time() - cpu_began
            if number:  # the first round warms up
                found[name].append(wall / calls * 1e6)
                found[f"{name}_cpu"].append(cpu / calls * 1e6)
    ratio = statistics.median(a / b for a, b in zip(found["act"], found["bare"], strict=True))
    cpu_ratio = statistics.median(a / b for a, b in zip(found["act_cpu"], found["bare_cpu"], strict=True))
    return {
        **{name: statistics.median(values) for name, values in found.items()},
        "ratio": ratio,
        "cpu_ratio": cpu_ratio,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure an export, and Policy.act against the bare session.")
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each comparison")
    rounds = parser.parse_args().rounds
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        results["export"] = cost = export(Path(folder))
        bundle = load_bundle(folder)
        policy, session = Policy.load(folder), open_ort_session(bundle.onnx)
        rng = np.random.default_rng(0)
        for batch, calls in CALLS.items():
            obs = rng.standard_normal((batch, 27)).astype(np.float32)
            one = obs[0] if batch == 1 else obs
            results[f"batch {batch}"] = compare(
                lambda one=one: policy.act(one),  # type: ignore[misc]  # bound now, not when it is called
                lambda obs=obs: session.run(["action"], {"obs": obs}),  # type: ignore[misc]
                calls,
                rounds,
            )
    console = Console()
    console.print(
        f"export: {cost['seconds']:.1f} s (at most {MOST_SECONDS:g} wanted), {cost['cpu_seconds']:.1f} s of CPU time, "
        f"{cost['peak_memory_mb']:.0f} MB at the peak",
        highlight=False,
    )
    table = Table()
    for column in ("observations", "Policy.act [us]", "session.run [us]", "ratio", "of CPU times", "at most"):
        table.add_column(column, justify="right")
    for batch, most in MOST_OVER_BARE.items():
        one = results[f"batch {batch}"]
        numbers = [one["act"], one["bare"], one["ratio"], one["cpu_ratio"], most]
        table.add_row(f"{batch:,}", *(f"{number:.2f}" for number in numbers))
    console.print(table)
    OUT.mkdir(exist_ok=True)
    (OUT / "export_policy.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
