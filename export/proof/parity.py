"""Parity gate: an exported policy gives the framework's own numbers, or it is not written.

Functions from observations to named outputs are compared; with a state, over whole sequences, each side fed with its
own state.

A difference passes when it is at most `RTOL * max(|reference|, scale) + ATOL`. The scale is half the range of a bounded
action element; otherwise the largest number in the same row of the output, at least 1, because the rounding of a matrix
product grows with its terms and not with their sum. `value` has one number a row, which may be a small difference of
large terms: its scale is the largest value seen over all observations. A discrete action must be the same, unless the
framework's own scores for the two choices are that close.

Far outside the usual range a network takes small differences of huge terms, which depend on the order of addition.
Rounding is therefore also measured on the framework itself: a difference passes if it is at most ROUNDING times the
change in the framework's own numbers when every floating-point observation moves by its last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.export.contract.contract import FormatParity, Parity
from rlservo.export.contract.errors import ParityError, UnsupportedError, first_line
from rlservo.export.contract.scores import scores_name, split_scores
from rlservo.export.recipe.recipe import Recipe, StateLeaf
from rlservo.export.recipe.runners import Inputs, Loop, Outputs, Runner, first_step
from rlservo.export.recipe.samples import BATCH_SIZES, Batch
from rlservo.export.recipe.to_contract import space_spec

RTOL = 1e-5
ATOL = 1e-6
ROUNDING = 8.0
MASKED = 1e30
"""A score beyond this stands for 'not allowed' (RLlib's action masks add -3.4e38); it measures nothing."""
RULE = (
    "a difference passes up to rtol * scale + atol; the scale is half the range of a bounded action, else the largest "
    "number in the output's row (of value: over all observations), at least 1; also up to 8 times what the "
    "checkpoint's own numbers move by when the observation moves by its last bit"
)
"""Sentence of the contract on the tolerances."""


class GraphLoop:
    """An exported graph fed with its own state."""

    def __init__(self, run: Runner, state: Sequence[StateLeaf]) -> None:
        self._run = run
        self._state = {f"state_in.{leaf.name}": leaf.initial for leaf in state}
        self._last: Inputs = {}

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the graph's outputs, its next state among them."""
        outputs = self._run(self.complete(inputs, restart))
        self._last = {name: outputs[name.replace("state_in.", "state_out.", 1)] for name in self._state}
        return outputs

    def complete(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Inputs:
        """Return the inputs with the loop's state."""
        rows = len(restart)
        full = dict(inputs)
        for name, initial in self._state.items():
            start = np.repeat(initial[None], rows, axis=0)
            last = self._last.get(name, start)
            full[name] = np.where(restart.reshape((rows, *[1] * initial.ndim)), start, last).astype(initial.dtype)
        return full


@dataclass(frozen=True)
class Reference:
    """One batch and what the framework computed for it."""

    batch: Batch
    outputs: Outputs
    framework: str = "RLlib"
    """Name of the framework, for messages."""


def record(start_loop: Callable[[], Loop], batches: Sequence[Batch], framework: str = "RLlib") -> list[Reference]:
    """Run the framework on every batch; `start_loop` starts it acting step after step.

    The observations are copied: a connector may write into what it is given. Raises UnsupportedError when its own
    pipeline fails on an observation of the policy's own space.
    """
    try:
        return _record(start_loop, batches, framework)
    except Exception as error:  # the framework's code and the user's raise anything
        raise UnsupportedError(
            f"{framework}'s own pipeline fails on an observation of the policy's space: {first_line(error)}"
        ) from error


def _record(start_loop: Callable[[], Loop], batches: Sequence[Batch], framework: str) -> list[Reference]:
    references: list[Reference] = []
    loop: Loop | None = None
    for batch in batches:
        inputs = _copy(batch.inputs)
        if batch.restart is None:
            outputs = first_step(start_loop(), inputs)
        else:
            if loop is None or len(references[-1].batch) != len(batch):
                loop = start_loop()
            outputs = loop.step(inputs, batch.restart)
        references.append(Reference(batch, outputs, framework))
    return references


def record_perturbed(start_loop: Callable[[], Loop], references: Sequence[Reference]) -> list[Reference]:
    """Return the framework's outputs when every floating-point observation moves up or down by its last bit."""
    rng = np.random.default_rng(0)
    batches = [
        replace(each.batch, inputs={name: _by_last_bit(values, rng) for name, values in each.batch.inputs.items()})
        for each in references
    ]
    return _record(start_loop, batches, references[0].framework)


def _by_last_bit(values: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    if values.dtype.kind != "f":
        return values
    single = values.astype(np.float32)  # the network's precision
    towards = np.where(rng.random(values.shape) < 0.5, np.float32(np.inf), np.float32(-np.inf))
    return np.asarray(np.nextafter(single, towards), values.dtype)


def replay(
    references: Sequence[Reference], run: Runner, state: Sequence[StateLeaf]
) -> Iterator[tuple[Inputs, Outputs]]:
    """Run an exported graph on the reference's batches; yield its full inputs and its outputs for each."""
    loop, size = GraphLoop(run, state), 0
    for reference in references:
        inputs, restart = _copy(reference.batch.inputs), reference.batch.restart
        if restart is None:
            yield inputs, run(inputs)
            continue
        if len(restart) != size:
            loop, size = GraphLoop(run, state), len(restart)
        yield loop.complete(inputs, restart), loop.step(inputs, restart)


def prove(
    recipe: Recipe,
    references: Sequence[Reference],
    formats: Mapping[str, Runner],
    labels: Sequence[str] = (),
    reference: str = "",
    perturb: Callable[[], list[Reference]] | None = None,
) -> Parity:
    """Compare every format with the framework's outputs and return the largest differences.

    `labels` name the action's elements for the message; `reference` names the reference for the contract;
    `perturb` gives what `record_perturbed` does; it is called once, only if a difference is too large.

    Raises ParityError at the first output that differs, naming element, sample and difference.
    """
    rounding = _Rounding(references, perturb)
    results = {name: _prove_format(name, recipe, references, run, labels, rounding) for name, run in formats.items()}
    return Parity(
        reference=reference,
        samples=sum(len(reference.batch) for reference in references),
        batch_sizes=BATCH_SIZES,
        rtol=RTOL,
        atol=ATOL,
        rule=RULE,
        formats=results,
    )


class _Rounding:
    """Change in the framework's own numbers when the observations' last bit changes; computed when first needed."""

    def __init__(self, references: Sequence[Reference], perturb: Callable[[], list[Reference]] | None) -> None:
        self._references = references
        self._perturb = perturb
        self._perturbed: list[Reference] | None = None

    def of(self, number: int, output: str) -> NDArray[np.float64]:
        """Return the largest movement in each row of an output, broadcastable to it."""
        if self._perturb is None:
            return np.zeros(())
        if self._perturbed is None:
            self._perturbed = self._perturb()
        before, after = (
            side[number].outputs[output].astype(np.float64) for side in (self._references, self._perturbed)
        )
        with np.errstate(invalid="ignore"):
            movement = np.nan_to_num(np.abs(after - before), nan=0.0, posinf=0.0)
        axes = tuple(range(1, movement.ndim))
        return np.asarray(movement.max(axis=axes, keepdims=True) if axes else movement)


def _prove_format(
    name: str,
    recipe: Recipe,
    references: Sequence[Reference],
    run: Runner,
    labels: Sequence[str],
    rounding: _Rounding,
) -> FormatParity:
    max_abs = max_rel = 0.0
    values = [reference.outputs["value"] for reference in references if "value" in reference.outputs]
    largest_value = max(map(_largest, values), default=1.0)
    actions = recipe.action_leaves
    replayed = replay(references, run, recipe.state)
    for number, reference in enumerate(references):
        where = f"{name}, a batch of {len(reference.batch)} {reference.batch.kind} observations"
        if reference.batch.restart is not None:
            where += f" (step {number} of the sequences)"
        try:
            got = next(replayed)[1]
        except Exception as error:  # a shape baked into the graph ends in onnxruntime's or torch's own exceptions
            raise ParityError(f"{where}: the exported graph does not run: {str(error).splitlines()[0]}") from error
        for output, expected in reference.outputs.items():
            space = actions.get(output)
            _check_form(where, output, got.get(output), expected, space, reference.framework)
            if space is not None and not isinstance(space, Box):
                scores = scores_name(reference.outputs)
                _check_choices(where, output, got[output], reference, recipe, partial(rounding.of, number, scores))
                continue
            least = largest_value if output == "value" else 1.0
            moves = partial(rounding.of, number, output)
            difference, scale = _compare(where, output, got[output], expected, space, reference, labels, least, moves)
            max_abs = max(max_abs, float(difference.max(initial=0.0)))
            max_rel = max(max_rel, float((difference / scale).max(initial=0.0)))
    return FormatParity(max_abs=max_abs, max_rel=max_rel)


def _check_form(
    where: str, output: str, got: NDArray[Any] | None, expected: NDArray[Any], space: Any, framework: str
) -> None:
    if got is None:
        raise ParityError(f"{where}: the exported graph has no output '{output}'")
    if got.shape != expected.shape:
        raise ParityError(f"{where}: output '{output}' has shape {got.shape}, {framework}'s has {expected.shape}")
    if space is not None:
        dtype = np.dtype(space.dtype) if isinstance(space, Box) else np.dtype(np.int64)
        if got.dtype != dtype:
            raise ParityError(f"{where}: the action is {got.dtype}, the action space has {dtype}")


def _compare(
    where: str,
    output: str,
    got: NDArray[Any],
    expected: NDArray[Any],
    space: Any,
    reference: Reference,
    labels: Sequence[str],
    least_scale: float,
    moves: Callable[[], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (difference, scale), both of the output's shape."""
    a, b = got.astype(np.float64), expected.astype(np.float64)
    with np.errstate(invalid="ignore"):
        same = (a == b) | (np.isnan(a) & np.isnan(b))  # overflow in both is not a difference
        difference = np.where(same, 0.0, np.abs(a - b))
    scale = np.maximum(np.where(np.isfinite(b), np.abs(b), 1.0), _scale(b, space, least_scale))
    allowed = RTOL * scale + ATOL
    bad = ~(difference <= allowed)
    if bad.any():
        allowed = allowed + ROUNDING * moves()
        bad = ~(difference <= allowed)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        row, element = index[0], int(np.ravel_multi_index(index[1:], b.shape[1:])) if b.ndim > 1 else 0
        label = f"{element} ({labels[element]})" if output == "action" and element < len(labels) else str(element)
        raise ParityError(
            f"{where}: output '{output}', element {label}, sample {row}: the export gives {a[index]:.9g}, "
            f"{reference.framework} {b[index]:.9g} (allowed difference {allowed[index]:.2g}); "
            f"{len(np.unique(np.argwhere(bad)[:, 0]))} of {len(b)} samples differ",
            {
                "output": output, "element": element, "sample": row, "exported": float(a[index]),
                "reference": float(b[index]), "observation": _row(reference.batch, row),
            },
        )  # fmt: skip
    return difference, scale


def _scale(expected: NDArray[np.float64], space: Any, least: float) -> NDArray[np.float64]:
    """Return the scale that rounding is measured against, broadcastable to `expected`."""
    if isinstance(space, Box) and bool((space.bounded_below & space.bounded_above).all()):
        return (space.high.astype(np.float64) - space.low.astype(np.float64))[None] / 2
    measured = np.isfinite(expected) & (np.abs(np.nan_to_num(expected)) < MASKED)
    finite = np.where(measured, np.abs(expected), 0.0)
    axes = tuple(range(1, expected.ndim))
    return np.maximum(finite.max(axis=axes, keepdims=True) if axes else finite, least)


def _largest(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return max(1.0, float(np.abs(finite).max(initial=0.0)))


def _row(batch: Batch, row: int) -> Any:
    rows = {name: values[row].tolist() for name, values in batch.inputs.items()}
    return rows["obs"] if set(rows) == {"obs"} else rows


def _check_choices(
    where: str,
    output: str,
    got: NDArray[Any],
    reference: Reference,
    recipe: Recipe,
    moves: Callable[[], NDArray[np.float64]],
) -> None:
    """Compare discrete actions; a tie in its scores excuses a difference, and so do scores that are NaN."""
    if np.array_equal(got, reference.outputs[output]):
        return
    columns = _columns(reference.outputs[output])
    scored = choice_scores(recipe, reference.outputs).get(output) or [np.full((len(c), 1), np.inf) for c in columns]
    for part, (exported, wanted, scores) in enumerate(zip(_columns(got), columns, scored, strict=True)):
        width = _tie_width(scores)
        for row in np.flatnonzero(exported != wanted):
            chosen, right = int(exported[row]), int(wanted[row])
            if np.isnan(scores[row]).any():
                continue
            apart = abs(scores[row, chosen] - scores[row, right]) if 0 <= chosen < scores.shape[1] else np.inf
            if not apart <= width[row] and not apart <= width[row] + ROUNDING * _at(moves(), int(row)):
                element = f", element {part}" if len(columns) > 1 else ""
                raise ParityError(
                    f"{where}: output '{output}'{element}, sample {row}: the export chooses {chosen}, "
                    f"{reference.framework} {right}",
                    {"output": output, "sample": int(row), "exported": chosen, "reference": right},
                )


def _at(by_row: NDArray[np.float64], row: int) -> float:
    return float(by_row[row].max()) if by_row.ndim else float(by_row)


def ties(recipe: Recipe, outputs: Outputs) -> NDArray[np.bool_]:
    """Return for each sample whether any discrete choice has two best scores that are the same within tolerance."""
    rows = len(next(iter(outputs.values())))
    tied = np.zeros(rows, np.bool_)
    for parts in choice_scores(recipe, outputs).values():
        for scores in parts:
            tied |= _tied(scores) | np.isnan(scores).any(axis=1)
    return tied


def choice_scores(recipe: Recipe, outputs: Outputs) -> dict[str, list[NDArray[np.float64]]]:
    """Return the scores `[batch, choices]` of every discrete choice, by action leaf and element.

    A module that computes its actions itself gives none.
    """
    if recipe.mode == "given":
        return {}
    scores = outputs[scores_name(outputs)].astype(np.float64)
    return split_scores(scores, space_spec(recipe.action_space, action=True))


def _columns(choices: NDArray[Any]) -> list[NDArray[Any]]:
    return [choices] if choices.ndim == 1 else list(choices.reshape(len(choices), -1).T)


def _tied(scores: NDArray[np.float64]) -> NDArray[np.bool_]:
    if scores.shape[1] < 2:
        return np.zeros(len(scores), np.bool_)
    best = np.sort(scores, axis=1)[:, -2:]
    return np.asarray(best[:, 1] - best[:, 0] <= _tie_width(scores))


def _tie_width(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    measured = np.where(np.abs(np.nan_to_num(scores)) < MASKED, np.abs(np.nan_to_num(scores)), 0.0)
    return np.asarray(RTOL * np.maximum(measured.max(axis=1), 1.0) + ATOL)


def _copy(inputs: Inputs) -> Inputs:
    return {name: values.copy() for name, values in inputs.items()}
