"""Proof of a compiled policy on this machine: its self-test, and 10,000 further observations beside onnxruntime."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import ActionError, ParityError, UsageError
from rlservo.export.compiled.c_samples import ROWS, sample_inputs
from rlservo.export.compiled.moved_weights import move_by_last_bit
from rlservo.export.compiled.tolerance import allowed_differences
from rlservo.policy.action_check import ActionCheck
from rlservo.policy.compiled_policy import CompiledLibrary, acting_contract, is_refused

STEPS = 100  # of ROWS observations
TIMES = ("median", "p99", "longest", "slowest_observation")
COMPILERS = ("cc", "gcc", "clang")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
FLAGS = ("-std=c99", "-O3")
Arrays = dict[str, NDArray[Any]]
Compute = Callable[[Mapping[str, NDArray[Any]]], Arrays]
"""The graph in onnxruntime: from every input to every output, by name."""


@dataclass(frozen=True)
class Proof:
    """Figures of a proof: what was compared, with which compiler, and the time and stack that it took."""

    compiler: str
    flags: tuple[str, ...]
    golden_vectors: int
    observations: int
    refused: int
    """Observations whose action must not leave, in onnxruntime and in the compiled policy alike."""
    max_abs: float
    max_rel: float
    """Largest difference, as a share of the allowed one."""
    rounding_used: int
    """Observations that differ by more than the contract's tolerance, but no more than rounding explains: the largest
    change of onnxruntime's own numbers in draws of the last bits of all weights and of the observation.
    """
    rounding_most: float
    """The largest of these differences, as a multiple of the contract's tolerance."""
    step_us: Mapping[str, float]
    """Time of 20,000 steps through the golden vectors and through numbers near 0: median, 99% and longest, and the
    median of the slowest observation, so that interruptions do not count.
    """
    stack_bytes: int | None
    """Stack of the deepest call, without libm's; None if the compiler does not report it."""
    state_bytes: int
    """Size of the caller's struct: the state, and scratch memory."""
    code_bytes: int
    """Size of the shared library, weights included."""


def find_compiler(given: str | None) -> str | None:
    """Return the C compiler's path: the one given, that of $CC, or the machine's own; None without one.

    Raises UsageError if the given one, or $CC, does not exist.
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
    known = {flag for flag in ("-march=native", "-fstack-usage")
             if _run([compiler, flag, "-fsyntax-only", "-x", "c", os.devnull], folder).returncode == 0}  # fmt: skip
    flags = (*FLAGS, *known - {"-fstack-usage"})
    common = [compiler, *flags, *WARNINGS, "-I."]
    _compile([*common, "-fPIC", *known - {"-march=native"}, "-c", f"{prefix}.c", "-o", f"{prefix}.o"], folder)
    _compile([*common, "-shared", f"{prefix}.o", "-o", library, "-lm"], folder)
    _compile([*common, "-DMEASURE", f"{prefix}_test.c", f"{prefix}.o", "-o", f"{prefix}_test", "-lm"], folder)
    (folder / f"{prefix}.o").unlink()
    return flags


def _run(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)


def _compile(command: Sequence[str], folder: Path) -> None:
    done = _run(command, folder)
    if done.returncode != 0:
        lines = done.stderr.splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise UsageError(f"{command[0]} does not compile the policy's C: {first[:300]}")


def prove(
    contract: Contract, compiler: str, folder: Path, prefix: str, library: str, compute: Compute,
    moved_graphs: Sequence[Compute], golden: Arrays,
) -> Proof:  # fmt: skip
    """Compile what is in `folder` and compare it with the graph. Raises ParityError that names what differs.

    `moved_graphs` are the graph with other last bits in its weights: they measure rounding.
    """
    flags = build(compiler, folder, prefix, library)
    test = _run([f"./{prefix}_test"], folder)
    if test.returncode != 0:
        first = (test.stdout.splitlines() or [f"exit code {test.returncode}"])[0]
        raise ParityError(f"the compiled policy does not reproduce the golden vectors: {first}")
    times = re.findall(r"nanoseconds: (\d+) (\d+) (\d+) (\d+)", test.stdout)[0]
    loaded = CompiledLibrary(folder / library, prefix, acting_contract(contract))
    return Proof(
        compiler=(_run([compiler, "--version"], folder).stdout.splitlines() or [compiler])[0],
        flags=flags,
        golden_vectors=len(next(iter(golden.values()))),
        observations=STEPS * ROWS,
        step_us={name: float(each) / 1e3 for name, each in zip(TIMES, times, strict=True)},
        stack_bytes=_stack(folder),
        state_bytes=loaded.state_size,
        code_bytes=(folder / library).stat().st_size,
        **_compare_all(contract, loaded, compute, moved_graphs, golden),
    )


def _stack(folder: Path) -> int | None:
    """Return the stack of the step and of the deepest calls: of nodes, of a kernel from there, and then of libm's."""
    sizes = {}
    for file in folder.glob("*.su"):
        for line in file.read_text(errors="replace").splitlines():
            place, size, *_ = line.split("\t")
            sizes[place.rsplit(":", 1)[-1]] = int(size)
        file.unlink()
    act = [size for name, size in sizes.items() if name.endswith("_act")]
    cells = sizes.get("tanh_of", 0) + sizes.get("sigmoid_of", 0) + max(sizes.get("lstm", 0), sizes.get("gru", 0))
    deepest = max(sizes.get("dense", 0), sizes.get("windows", 0), cells)
    return act[0] + deepest if act else None


def _compare_all(
    contract: Contract, library: CompiledLibrary, compute: Compute, moved_graphs: Sequence[Compute], golden: Arrays
) -> dict[str, Any]:
    """Return the figures of the comparison, as `Proof` names them."""
    rng = np.random.default_rng(1)
    initial = {f"state_in.{each.name}": each.initial_value(ROWS) for each in contract.state}
    state, refused, used, most, max_abs, max_rel = dict(initial), 0, 0, 0.0, 0.0, 0.0
    for step, observed in enumerate(sample_inputs(contract, golden, STEPS)):
        feed = {**observed, **state}
        expected = compute(feed)
        codes, got = library.step(feed)
        here, there = is_refused(codes), must_not_leave(contract, expected)
        shares = _shares(contract, got, expected, here | there, [])
        largest = np.max([share.max(axis=1, initial=0.0) for share in shares.values()], axis=0)
        beyond = (largest > 1.0) | (here != there)
        if beyond.any():
            moved = [graph({**feed, **moved_inputs(observed, rng)}) for graph in moved_graphs]
            unsure = np.any([there != must_not_leave(contract, each) for each in moved], axis=0)
            there = np.where(unsure, here, there)
            shares = _shares(contract, got, expected, here | there, moved)
            _check(contract, step * ROWS, shares, got, expected, moved, here, there)
            used, most = used + int(beyond.sum()), max(most, float(largest.max()))
        refused += int((here & there).sum())
        for name, share in shares.items():
            with np.errstate(invalid="ignore"):
                apart = np.abs(got[name].astype(np.float64) - expected[name].astype(np.float64))[~(here | there)]
            max_abs = max(max_abs, float(np.nan_to_num(apart).max(initial=0.0)))
            max_rel = max(max_rel, float(share.max(initial=0.0)))
        restart = there | (rng.random(ROWS) < 0.05)
        for name, start in initial.items():
            after = expected[name.replace("state_in.", "state_out.", 1)]
            fresh = restart | ~np.isfinite(after.reshape(ROWS, -1)).all(axis=1)
            state[name] = np.where(fresh.reshape(-1, *[1] * (start.ndim - 1)), start, after)
    return {"refused": refused, "max_abs": max_abs, "max_rel": max_rel, "rounding_used": used, "rounding_most": most}


def _shares(
    contract: Contract, got: Arrays, expected: Arrays, refused: NDArray[np.bool_], moved: Sequence[Arrays]
) -> Arrays:
    """Return each output's differences as shares of the allowed ones, `[rows, elements]`; 0 for refused rows."""
    found = {}
    for name, allowed in allowed_differences(contract, expected, moved).items():
        a, b, limit = (
            each.astype(np.float64).reshape(len(refused), -1) for each in (got[name], expected[name], allowed)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            same = (a == b) | (np.isnan(a) & np.isnan(b)) | refused[:, None]
            found[name] = np.nan_to_num(np.where(same, 0.0, np.abs(a - b) / limit), nan=np.inf)
    return found


def _check(
    contract: Contract, first: int, shares: Arrays, got: Arrays, expected: Arrays, moved: Sequence[Arrays],
    here: NDArray[np.bool_], there: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Raise ParityError, naming what differs, if a difference is more than rounding."""
    if (here != there).any():
        row = int(np.flatnonzero(here != there)[0])
        raise ParityError(
            f"observation {first + row}: the compiled policy {'refuses' if here[row] else 'gives'} an action that "
            f"onnxruntime {'gives' if here[row] else 'must not give'}"
        )
    name = max(shares, key=lambda each: float(shares[each].max(initial=0.0)))
    if not shares[name].max(initial=0.0) <= 1.0:
        row, element = divmod(int(shares[name].argmax()), shares[name].shape[1])
        sides = (got, expected, allowed_differences(contract, expected, moved))
        a, b, limit = (side[name][row].ravel()[element] for side in sides)
        raise ParityError(
            f"observation {first + row}: output '{name}', element {element}: the compiled policy gives {a:.9g}, "
            f"onnxruntime {b:.9g} (allowed difference {limit:.2g})"
        )


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


def moved_inputs(observed: Arrays, rng: np.random.Generator) -> Arrays:
    """Return the observations with every floating-point number moved by its last bit in single precision."""
    return {name: move_by_last_bit(array, rng) for name, array in observed.items()}
