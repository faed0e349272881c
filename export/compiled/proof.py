"""Proof of a compiled policy on this machine: its self-test, and 10,000 further observations beside onnxruntime."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.samples import ROWS, sample_inputs
from rlservo.export.compiled.tolerance import allowed_differences
from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import ActionError, ParityError, UsageError
from rlservo.export.contract.spaces import leaf_specs
from rlservo.serve_app.runtime.action_check import ActionCheck
from rlservo.serve_app.runtime.compiled_policy import CompiledLibrary, acting_contract, is_refused

STEPS = 100  # of ROWS observations
MOVED = 4  # times that observations are moved by their last bit, where a difference is too large otherwise
COMPILERS = ("cc", "gcc", "clang")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
FLAGS = ("-std=c99", "-O3")
Arrays = dict[str, NDArray[Any]]
Compute = Callable[[Mapping[str, NDArray[Any]]], Arrays]
"""The graph in onnxruntime: from every input to every output, by name."""


@dataclass(frozen=True)
class Proof:
    """What was compared, on which machine, and how fast and deep it ran there."""

    compiler: str
    flags: tuple[str, ...]
    golden_vectors: int
    observations: int
    refused: int
    """Of the observations: those whose action must not leave, for onnxruntime and for the compiled policy alike."""
    max_abs: float
    max_rel: float
    """Of the allowed difference."""
    step_us: Mapping[str, float]
    """Median, 99% and longest of 20,000 steps on this machine."""
    stack_bytes: int | None
    """Of the deepest call, libm's own aside; None where the compiler does not tell."""
    state_bytes: int
    """Of the caller's struct: what is remembered, and memory to compute in."""
    code_bytes: int
    """The shared library, weights and all."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def find_compiler(given: str | None) -> str | None:
    """Return the C compiler's path: the one given, that of $CC, or the machine's own; None without one.

    Raises UsageError where the given one, or $CC, does not exist.
    """
    wanted = given or os.environ.get("CC")
    if wanted:
        found = shutil.which(wanted)
        if found is None:
            raise UsageError(f"there is no C compiler {wanted!r} on this machine")
        return found
    return next((path for name in COMPILERS if (path := shutil.which(name))), None)


def build(compiler: str, folder: Path, prefix: str, library: str) -> tuple[str, ...]:
    """Compile the library and the self-test; return the flags. Raises UsageError with the compiler's first error."""
    native = _runs([compiler, "-march=native", "-fsyntax-only", "-x", "c", os.devnull], folder)
    flags = (*FLAGS, *(["-march=native"] if native else []))
    usage = (
        ["-fstack-usage"] if _runs([compiler, "-fstack-usage", "-fsyntax-only", "-x", "c", os.devnull], folder) else []
    )
    common = [compiler, *flags, *WARNINGS, "-I."]
    _compile([*common, "-fPIC", *usage, "-c", f"{prefix}.c", "-o", f"{prefix}.o"], folder)
    parts = [f"{prefix}.o", *([weights] if (folder / (weights := f"{prefix}_weights.S")).exists() else [])]
    _compile([*common, "-shared", *parts, "-o", library, "-lm"], folder)
    _compile([*common, "-DMEASURE", f"{prefix}_test.c", *parts, "-o", f"{prefix}_test", "-lm"], folder)
    (folder / f"{prefix}.o").unlink()
    return flags


def _runs(command: Sequence[str], folder: Path) -> bool:
    return subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0


def _compile(command: Sequence[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        lines = (
            [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or ["no message"]
        )
        raise UsageError(f"{command[0]} does not compile the policy's C: {lines[0][:300]}")


def prove(
    contract: Contract, compiler: str, folder: Path, prefix: str, library: str, compute: Compute, golden: Arrays
) -> Proof:
    """Compile what is in `folder` and compare it with the graph. Raises ParityError, saying what differs."""
    flags = build(compiler, folder, prefix, library)
    test = subprocess.run([folder / f"{prefix}_test"], capture_output=True, text=True, errors="replace", check=False)
    if test.returncode != 0:
        first = (test.stdout.splitlines() or [f"exit code {test.returncode}"])[0]
        raise ParityError(f"the compiled policy does not reproduce the golden vectors: {first}")
    median, late, longest = (
        float(each) / 1e3 for each in re.findall(r"nanoseconds: (\d+) (\d+) (\d+)", test.stdout)[0]
    )
    loaded = CompiledLibrary(folder / library, prefix, acting_contract(contract))
    refused, max_abs, max_rel = _compare_all(contract, loaded, compute, golden)
    return Proof(
        compiler=_version(compiler),
        flags=flags,
        golden_vectors=len(next(iter(golden.values()))),
        observations=STEPS * ROWS,
        refused=refused,
        max_abs=max_abs,
        max_rel=max_rel,
        step_us={"median": median, "p99": late, "longest": longest},
        stack_bytes=_stack(folder),
        state_bytes=loaded.state_size,
        code_bytes=(folder / library).stat().st_size,
    )


def _version(compiler: str) -> str:
    done = subprocess.run([compiler, "--version"], capture_output=True, text=True, errors="replace", check=False)
    return (done.stdout.splitlines() or [compiler])[0]


def _stack(folder: Path) -> int | None:
    """Return the stack of the step and of the deepest calls: of nodes, of a kernel from there, and then of libm's."""
    sizes = {}
    for file in folder.glob("*.su"):
        for line in file.read_text(errors="replace").splitlines():
            place, size, *_ = line.split("\t")
            sizes[place.rsplit(":", 1)[-1]] = int(size)
        file.unlink()
    act = [size for name, size in sizes.items() if name.endswith("_act")]
    nodes = [size for name, size in sizes.items() if name.startswith("nodes_")]
    kernels = [size for name, size in sizes.items() if name in ("dense", "tanh_of", "sigmoid_of")]
    return act[0] + max(nodes, default=0) + max(kernels, default=0) if act else None


def _compare_all(
    contract: Contract, library: CompiledLibrary, compute: Compute, golden: Arrays
) -> tuple[int, float, float]:
    """Return (rows refused by both, largest difference, largest share of the allowed one)."""
    rng = np.random.default_rng(1)
    state = {f"state_in.{each.name}": each.initial_value(ROWS) for each in contract.state}
    refused, max_abs, max_rel = 0, 0.0, 0.0
    for step, observed in enumerate(sample_inputs(contract, golden, STEPS)):
        restart = rng.random(ROWS) < 0.05
        feed = {**observed, **state}
        expected = compute(feed)
        codes, got = library.step(feed)
        bad_here, bad_there = is_refused(codes), must_not_leave(contract, expected)
        moved: list[Arrays] = []
        worst: dict[str, float] = {}
        both = ~bad_here & ~bad_there
        for attempt in range(2):
            allowed = allowed_differences(contract, expected, moved)
            shares = {name: _share(got[name], expected[name], limit) for name, limit in allowed.items()}
            both = ~bad_here & ~bad_there
            worst = {name: float(share[both].max(initial=0.0)) for name, share in shares.items()}
            if all(share <= 1.0 for share in worst.values()) and (bad_here == bad_there).all():
                break
            if attempt == 0:
                moved = [compute({**feed, **_moved(observed, rng)}) for _ in range(MOVED)]
                unsure = np.any([bad_there != must_not_leave(contract, each) for each in moved], axis=0)
                bad_there = np.where(unsure, bad_here, bad_there)
                continue
            _fail(step, shares, worst, got, expected, allowed, bad_here, bad_there, both)
        refused += int((bad_here & bad_there).sum())
        for name in worst:
            with np.errstate(invalid="ignore"):
                difference = np.abs(got[name][both].astype(np.float64) - expected[name][both].astype(np.float64))
            max_abs, max_rel = (
                max(max_abs, float(np.nan_to_num(difference).max(initial=0.0))),
                max(max_rel, worst[name]),
            )
        state = {}
        for each in contract.state:
            after, start = expected[f"state_out.{each.name}"], each.initial_value(ROWS)
            fresh = restart | bad_there | ~np.isfinite(after.reshape(ROWS, -1)).all(axis=1)
            state[f"state_in.{each.name}"] = np.where(fresh.reshape(-1, *[1] * len(each.shape)), start, after)
    return refused, max_abs, max_rel


def _share(got: NDArray[Any], expected: NDArray[Any], allowed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each row's largest difference as a share of the allowed one."""
    a, b = got.astype(np.float64).reshape(len(got), -1), expected.astype(np.float64).reshape(len(got), -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        same = (a == b) | (np.isnan(a) & np.isnan(b))
        share = np.where(same, 0.0, np.abs(a - b) / allowed.reshape(len(got), -1))
    largest: NDArray[np.float64] = np.nan_to_num(share, nan=np.inf).max(axis=1, initial=0.0)
    return largest


def must_not_leave(contract: Contract, outputs: Arrays) -> NDArray[np.bool_]:
    """Return the rows whose action the runtime refuses; rounding beyond the bounds is clipped in the others."""
    rows = len(next(iter(outputs.values())))
    refused = np.zeros(rows, np.bool_)
    for name, leaf in leaf_specs(contract.action_space, "action").items():
        check = ActionCheck(contract.name, name, leaf)
        outputs[name] = np.array(outputs[name])  # onnxruntime's own is read-only
        for row in range(rows):
            try:
                check.check(outputs[name][row : row + 1].reshape(1, *leaf.shape))
            except ActionError:
                refused[row] = True
    return refused


def _moved(observed: Arrays, rng: np.random.Generator) -> Arrays:
    """Return the observations with every floating-point number moved by its last bit in single precision."""
    moved = {}
    for name, array in observed.items():
        towards = np.where(rng.random(array.shape) < 0.5, np.float32(np.inf), np.float32(-np.inf))
        single = np.nextafter(array.astype(np.float32), towards) if array.dtype.kind == "f" else array
        largest = np.finfo(np.float32).max
        moved[name] = np.clip(single, -largest, largest).astype(array.dtype) if array.dtype.kind == "f" else array
    return moved


def _fail(
    step: int, shares: Arrays, worst: Mapping[str, float], got: Arrays, expected: Arrays, allowed: Arrays,
    here: NDArray[np.bool_], there: NDArray[np.bool_], both: NDArray[np.bool_],
) -> None:  # fmt: skip
    if (here != there).any():
        row = int(np.flatnonzero(here != there)[0])
        raise ParityError(
            f"observation {step * ROWS + row}: the compiled policy {'refuses' if here[row] else 'gives'} an action "
            f"that onnxruntime {'gives' if here[row] else 'may not give'}"
        )
    name = max(worst, key=lambda each: worst[each])
    row = int(np.where(both, shares[name], -1.0).argmax())
    a, b, limit = (side[name][row].astype(np.float64).ravel() for side in (got, expected, allowed))
    with np.errstate(invalid="ignore", divide="ignore"):
        element = int(np.nan_to_num(np.abs(a - b) / limit).argmax())
    raise ParityError(
        f"observation {step * ROWS + row}: output '{name}', element {element}: the compiled policy gives "
        f"{a[element]:.9g}, onnxruntime {b[element]:.9g} (allowed difference {limit[element]:.2g})"
    )
