"""Measure a step of a compiled policy against onnxruntime and TorchScript in this process.

    python benchmarks/compiled_policy.py [--rounds 7] [--cc gcc]

The shipped UR5 policy (27-256-256-5), the LSTM of the MiR100 and three convolutional networks with random weights are
exported and compiled. The self-test, built with -DMEASURE, times 20,000 steps; onnxruntime's session and TorchScript
run for as long, one after the other in each round. A round's figure is a step's median, and the smallest of the rounds
counts: other programs only add to it. Ratios are of two figures of one round; their median counts. Written to
bench/compiled_policy.json.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from measuring import alternate, median_ratio, parser, show, write

import rlservo
from rlservo.bundle.bundle import Bundle, load_bundle
from rlservo.export.compiled.compile import Compiled, compile_bundle
from rlservo.export.compiled.proof import FLAGS, find_compiler
from rlservo.policy.compiled_policy import CompiledPolicy
from rlservo.policy.policy import Policy

ROOT = Path(__file__).resolve().parent.parent
CHECKPOINTS = ("ur5_positioning", "mir100_sparse_fixes")
IMAGES: dict[str, tuple[tuple[int, int, int], Sequence[int], Sequence[int], Sequence[int], int]] = {
    "36x36x3, 8 16": ((36, 36, 3), (8, 16), (5, 3), (2, 2), 64),
    "64x64x3, 16 32 32": ((64, 64, 3), (16, 32, 32), (8, 4, 3), (4, 2, 1), 256),
    "84x84x4, 32 64 64": ((84, 84, 4), (32, 64, 64), (8, 4, 3), (4, 2, 1), 512),
}
"""Convolutional networks by name: image, channels, kernels, strides, hidden layer."""
STEPS = 2000
MOST_US = 6.0  # issue 43's target, for the first


def image_network(
    image: tuple[int, int, int], channels: Sequence[int], kernels: Sequence[int], strides: Sequence[int], hidden: int
) -> torch.nn.Module:
    """Return a network from bytes `[batch, height, width, channel]` to three numbers."""
    torch.manual_seed(0)
    layers: list[torch.nn.Module] = [ChannelsFirst()]
    for inner, outer, kernel, stride in zip((image[2], *channels), channels, kernels, strides, strict=False):
        layers += [torch.nn.Conv2d(inner, outer, kernel, stride), torch.nn.ReLU()]
    size = torch.nn.Sequential(*layers)(torch.zeros(1, *image)).numel()
    return torch.nn.Sequential(
        *layers, torch.nn.Flatten(), torch.nn.Linear(size, hidden), torch.nn.ReLU(), torch.nn.Linear(hidden, 3)
    )


class ChannelsFirst(torch.nn.Module):
    """Bytes as numbers up to 1, channels first."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return image.float().permute(0, 3, 1, 2) / 255


def bundles(folder: Path) -> dict[str, Bundle]:
    """Export what is measured; return the bundles by name."""
    for checkpoint in CHECKPOINTS:
        source = ROOT / "examples" / "checkpoints" / checkpoint
        command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(source), "--out", str(folder)]
        subprocess.run([*command, "--name", checkpoint], check=True, stdout=subprocess.DEVNULL)
    made = {checkpoint: load_bundle(folder / checkpoint) for checkpoint in CHECKPOINTS}
    for name, (image, channels, kernels, strides, hidden) in IMAGES.items():
        seen, acted = Box(0, 255, image, np.uint8), Box(-1, 1, (3,), np.float32)
        network = image_network(image, channels, kernels, strides, hidden)
        made[name] = load_bundle(rlservo.export_policy(network, seen, acted, folder, name=f"cnn{len(made)}").path)
    return made


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
        measured_bundles = bundles(folder)
        for checkpoint, bundle in measured_bundles.items():
            made = compile_bundle(bundle.path, folder / f"{bundle.contract.name}-c", compiler=compiler)
            found = alternate(sides(bundle, made, compiler, folder), args.rounds)
            document[checkpoint] = {side: min(own) for side, own in found.items()}
            ratios = {side: median_ratio(own, found["C"]) for side, own in found.items()}
            document[checkpoint] |= {"as_multiple_of_C": ratios, "proof": made.about["proof"]}
        for side in document[CHECKPOINTS[0]]["as_multiple_of_C"]:
            figures = [(document[name][side], document[name]["as_multiple_of_C"][side]) for name in measured_bundles]
            rows.append([side, *(f"{time:.1f} ({ratio:.1f} x)" for time, ratio in figures)])
        for what in ("slowest_observation", "longest"):
            longest = (f"{document[name]['proof']['step_us'][what]:.1f}" for name in measured_bundles)
            rows.append([f"C, {what.replace('_', ' ')}", *longest])
        rows.append(["C, stack [bytes]", *(str(document[name]["proof"]["stack_bytes"]) for name in measured_bundles)])
    show("", ("a step [µs]", *measured_bundles), rows)
    write(args.out, "compiled_policy", document)
    if document[CHECKPOINTS[0]]["C"] > MOST_US:
        print(f"the UR5's step took more than {MOST_US} µs")


if __name__ == "__main__":
    main()
