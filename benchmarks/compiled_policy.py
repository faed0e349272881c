"""Measure a step of a compiled policy against onnxruntime and TorchScript in this process.

    python benchmarks/compiled_policy.py [--rounds 7] [--cc gcc]

The shipped UR5 policy (27-256-256-5) and the LSTM of the MiR100 are exported and compiled. The self-test, built with
-DMEASURE, times 20,000 steps; onnxruntime's session and TorchScript run for as long, one after the other in each round.
A round's figure is a step's median, and the smallest of the rounds counts: other programs only add to it. Ratios are of
two figures of one round; their median counts. Written to bench/compiled_policy.json.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from measuring import alternate, median_ratio, parser, show, write

from rlservo.export.compiled.compile import Compiled, compile_bundle
from rlservo.export.compiled.proof import FLAGS, find_compiler
from rlservo.export.contract.bundle import Bundle, load_bundle
from rlservo.serve_app.runtime.compiled_policy import CompiledPolicy
from rlservo.serve_app.runtime.policy import Policy

ROOT = Path(__file__).resolve().parent.parent
CHECKPOINTS = ("ur5_positioning", "mir100_sparse_fixes")
STEPS = 2000
MOST_US = 6.0  # issue 43's target, for the first


def median_us(step: Callable[[], Any]) -> float:
    taken = []
    for _ in range(STEPS):
        began = time.perf_counter_ns()
        step()
        taken.append(time.perf_counter_ns() - began)
    return float(np.median(taken)) / 1e3


def sides(bundle: Bundle, made: Compiled, compiler: str, folder: Path) -> dict[str, Callable[[], float]]:
    """Return, by name, functions that measure the median of a step [µs]."""
    prefix = str(made.about["prefix"])
    program = folder / f"{prefix}_measured"
    sources = [made.folder / f"{prefix}_test.c", made.folder / f"{prefix}.c"]
    command = [compiler, *FLAGS, "-march=native", "-DMEASURE", *sources, "-o", program, "-lm"]
    subprocess.run([*map(str, command)], check=True)

    def measured() -> float:
        said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
        return float(re.findall(r"nanoseconds: (\d+)", said)[0]) / 1e3

    inputs, _ = bundle.golden()
    feed = {tensor.name: inputs[tensor.name][:1] for tensor in bundle.contract.inputs}
    policy, compiled = Policy.load(bundle.path), CompiledPolicy(made.folder)
    ort_run = policy.network()
    script = cast(Any, torch.jit).load(str(bundle.torchscript))
    tensors = [torch.from_numpy(array) for array in feed.values()]
    obs = feed["obs"][0]

    def torch_step() -> None:
        with torch.inference_mode():
            script(*tensors)

    return {
        "C": measured,
        "onnxruntime, in process": lambda: median_us(lambda: ort_run(feed)),
        "TorchScript, in process": lambda: median_us(torch_step),
        "CompiledPolicy.act (Python)": lambda: median_us(lambda: compiled.act(obs)),
        "Policy.act (Python)": lambda: median_us(lambda: policy.act(obs)),
    }


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=7)
    options.add_argument("--cc", help="C compiler; the machine's own by default")
    args = options.parse_args()
    compiler = find_compiler(args.cc)
    if compiler is None:
        sys.exit("there is no C compiler")
    torch.set_num_threads(1)
    document: dict[str, Any] = {"compiler": compiler}
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for checkpoint in CHECKPOINTS:
            source = ROOT / "examples" / "checkpoints" / checkpoint
            command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(source), "--out", str(folder)]
            subprocess.run([*command, "--name", checkpoint], check=True, stdout=subprocess.DEVNULL)
            bundle = load_bundle(folder / checkpoint)
            made = compile_bundle(bundle.path, folder / f"{checkpoint}-c", compiler=compiler)
            measured = sides(bundle, made, compiler, folder)
            found = alternate(measured, args.rounds)
            document[checkpoint] = {side: min(own) for side, own in found.items()}
            ratios = {side: median_ratio(own, found["C"]) for side, own in found.items()}
            document[checkpoint] |= {"as_multiple_of_C": ratios, "proof": made.about["proof"]}
        for side in document[CHECKPOINTS[0]]["as_multiple_of_C"]:
            figures = [(document[name][side], document[name]["as_multiple_of_C"][side]) for name in CHECKPOINTS]
            rows.append([side, *(f"{time:.1f} ({ratio:.1f} x)" for time, ratio in figures)])
        for what in ("slowest_observation", "longest"):
            longest = (f"{document[name]['proof']['step_us'][what]:.1f}" for name in CHECKPOINTS)
            rows.append([f"C, {what.replace('_', ' ')}", *longest])
        rows.append(["C, stack [bytes]", *(str(document[name]["proof"]["stack_bytes"]) for name in CHECKPOINTS)])
    show("", ("a step [µs]", *CHECKPOINTS), rows)
    write(args.out, "compiled_policy", document)
    if document[CHECKPOINTS[0]]["C"] > MOST_US:
        print(f"the UR5's step took more than {MOST_US} µs")


if __name__ == "__main__":
    main()
