"""Checks of the framework's own answers before anything is compared with them.

A graph gives the same numbers for the same observation, whenever it is asked, whatever else is in the batch, and
whichever step of an episode it is. A policy that does not has no graph, and its answers prove nothing: its own changes
would be taken for rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from rlservo.errors import UnsupportedError
from rlservo.export.proof.differences import Comparer
from rlservo.export.proof.references import Reference, record
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop, Outputs, first_step
from rlservo.export.recipe.samples import Batch

ALONE = 4  # samples of a batch that are also computed alone
OUTLIERS = (3.0, 30.0, 1e3, 1e5, 1e7, 1e12, 1e30)  # times the largest number of the others
REORDERED = 12  # batches that are also given with their keys in the opposite order
REPEATED = 1e-6
"""Difference, relative to the largest number, that a processor's order of addition may leave between two runs."""


def check_reference(
    start_loop: Callable[[], Loop], recipe: Recipe, references: Sequence[Reference], comparer: Comparer
) -> None:
    """Raise UnsupportedError unless the framework's answers are repeatable, independent and without hidden memory."""
    check_repeatable(start_loop, references)
    _check_independent(start_loop, recipe, references, comparer)
    if not recipe.state:
        _check_outliers(start_loop, references, comparer)
    _check_order(start_loop, references[:REORDERED], comparer)
    if not recipe.state:
        _check_stateless(start_loop, references, comparer)


def check_repeatable(start_loop: Callable[[], Loop], references: Sequence[Reference]) -> None:
    """Ask the framework the same again. Raises UnsupportedError if its answers are not the same."""
    framework = references[0].framework
    again = record(start_loop, [reference.batch for reference in references], framework)
    for before, after in zip(references, again, strict=True):
        if found := _changed(before.outputs, after.outputs):
            output, row, first, second = found
            raise UnsupportedError(
                f"{framework}'s own '{output}' for the same observations changes from one time to the next (sample "
                f"{row} of {len(before.batch)} {before.batch.kind} observations: {first:.9g}, then {second:.9g}): the "
                "network or a connector counts, reads a clock or draws random numbers, which cannot be exported"
            )


def _changed(before: Outputs, after: Outputs) -> tuple[str, int, float, float] | None:
    """Return (output, row, number, other number) where two runs differ."""
    for name, values in before.items():
        a, b = (np.asarray(side, np.float64).reshape(len(values), -1) for side in (values, after[name]))
        if np.array_equal(a, b, equal_nan=True):
            continue
        with np.errstate(invalid="ignore"):
            finite = np.where(np.isfinite(a), np.abs(a), 0.0).max(axis=1, initial=1.0, keepdims=True)
            bad = ~((np.abs(a - b) <= REPEATED * finite) | (a == b) | (np.isnan(a) & np.isnan(b)))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            return name, int(row), float(a[row, column]), float(b[row, column])
    return None


def _check_independent(
    start_loop: Callable[[], Loop], recipe: Recipe, references: Sequence[Reference], comparer: Comparer
) -> None:
    """Compute some rows of each batch, or of each sequence, alone."""
    framework = references[0].framework
    numbered = list(enumerate(references))
    for _, part in groupby(numbered, key=lambda one: (len(one[1].batch), one[1].batch.restart is None)):
        together = list(part)
        size, in_sequence = len(together[0][1].batch), together[0][1].batch.restart is not None
        if size == 1 or (in_sequence and not recipe.state):
            continue
        rows = np.unique(np.linspace(0, size - 1, min(ALONE, size)).astype(int))
        for row in (rows[-1:] if in_sequence else rows).tolist():
            alone = record(start_loop, [reference.batch.row(row) for _, reference in together], framework)
            for (number, reference), single in zip(together, alone, strict=True):
                fault = comparer.compare(number, single.outputs, slice(row, row + 1)).fault
                if fault is not None:
                    raise UnsupportedError(
                        f"{framework}'s own '{fault.output}' for sample {row} of {size} {reference.batch.kind} "
                        f"observations changes when it is computed alone ({fault.expected:.9g} in the batch, "
                        f"{fault.got:.9g} alone): the network's result "
                        "depends on the other observations of the batch, which cannot be exported"
                    )


def _check_outliers(start_loop: Callable[[], Loop], references: Sequence[Reference], comparer: Comparer) -> None:
    """Compute some rows beside one that is far outside of what any sample is."""
    number, reference = next(each for each in enumerate(references) if len(each[1].batch) > ALONE)
    rows = slice(0, ALONE)
    for factor in OUTLIERS:
        inputs = {name: values[: ALONE + 1].copy() for name, values in reference.batch.inputs.items()}
        floats = [values for values in inputs.values() if values.dtype.kind == "f"]
        for values in floats:
            far = factor * max(1.0, float(np.nan_to_num(np.abs(values[rows])).max(initial=0.0)))
            values[ALONE] = min(far, float(np.finfo(values.dtype).max) / 2)
        if not floats:
            return
        try:
            (beside,) = record(start_loop, [Batch(reference.batch.kind, inputs)], reference.framework)
        except Exception:  # the user's own code refuses such numbers
            continue
        outputs = {name: values[rows] for name, values in beside.outputs.items()}
        if (fault := comparer.compare(number, outputs, rows).fault) is not None:
            raise UnsupportedError(
                f"{reference.framework}'s own '{fault.output}' for an observation changes beside another one that is "
                f"{factor:g} times as large (from {fault.expected:.9g} to {fault.got:.9g}): the network's result "
                "depends on the other observations of the batch, which cannot be exported"
            )


def _check_order(start_loop: Callable[[], Loop], references: Sequence[Reference], comparer: Comparer) -> None:
    """Give the parts of nested observations in the opposite order."""
    if len(references[0].batch.inputs) == 1:
        return
    batches = [
        replace(reference.batch, inputs=dict(reversed(reference.batch.inputs.items()))) for reference in references
    ]
    framework = references[0].framework
    for number, reordered in enumerate(record(start_loop, batches, framework)):
        fault = comparer.compare(number, reordered.outputs).fault
        if fault is not None:
            raise UnsupportedError(
                f"{framework}'s own '{fault.output}' for the same observation changes from {fault.expected:.9g} to "
                f"{fault.got:.9g} when its keys come in the opposite order: the network or a connector takes the "
                "environment's order, which the checkpoint does not hold; read the parts by their names"
            )


def _check_stateless(start_loop: Callable[[], Loop], references: Sequence[Reference], comparer: Comparer) -> None:
    """Compute each step of the sequences as an episode's first one."""
    steps = [
        (number, reference, reference.batch.restart)
        for number, reference in enumerate(references)
        if reference.batch.restart is not None
    ]
    batches = [reference.batch for _, reference, _ in steps]
    rows = len(batches[0])
    names = batches[0].inputs
    outputs = first_step(start_loop(), {name: np.concatenate([one.inputs[name] for one in batches]) for name in names})
    since = np.zeros(rows, int)
    for step, (number, reference, restart) in enumerate(steps):
        since = np.where(restart, 0, since + 1)
        first = {name: values[step * rows : (step + 1) * rows] for name, values in outputs.items()}
        fault = comparer.compare(number, first).fault
        if fault is not None:
            raise UnsupportedError(
                f"{reference.framework}'s own '{fault.output}' for the same observation is {fault.got:.9g} at an "
                f"episode's start and {fault.expected:.9g} {since[fault.row]} steps later: the network or a connector "
                "remembers earlier steps, and no state of it is in the export"
            )
