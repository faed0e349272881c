"""Differences between two computations of the same outputs, and how much of them is rounding.

A difference passes when it is at most `RTOL * scale + ATOL`, or two last bits of the number itself. The scale is half
the range of a bounded action element (and ATOL at most LARGEST of it); otherwise the largest number in the same row of
the output, at least 1, because the rounding of a matrix product grows with its terms and not with their sum; but no
more than the largest number of the same action element, which may have another unit than the others. `value`
has one number a row, which may be a small difference of large terms: its scale is the largest value seen over all
observations. A discrete action must be the same, unless the framework's own scores for the two choices are that close.

Far outside the usual range a network takes small differences of huge terms, which depend on the order of addition.
Rounding is therefore also measured (`rounding.py`): a difference passes if it is at most ROUNDING times the policy's
own movement when last bits move, but never above LARGEST of the scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.bundle.scores import scores_name, split_scores
from rlservo.export.proof.references import Reference
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Outputs
from rlservo.export.recipe.to_contract import space_spec

RTOL = 1e-5
ATOL = 1e-6
ROUNDING = 8.0
LARGEST = 1e-2
"""Nothing above this share of the scale passes as rounding."""
MASKED = 1e30
"""A score beyond this stands for 'not allowed' (RLlib's action masks add -3.4e38); it measures nothing."""
LAST_BITS = 2 * float(np.finfo(np.float32).eps)
RULE = (
    "a difference passes up to rtol * scale + atol, or the number's own last two bits; the scale is half the range of "
    "a bounded action (atol at most 1% of it), else the largest number in the output's row (of value: over all "
    "observations), at least 1, but for an action no more than the element's own largest; also up to 8 times what the "
    "policy's own numbers move by when the observation or the weights move by their last bit, at most 1% of the scale"
)
"""Sentence of the contract on the tolerances."""


@dataclass(frozen=True)
class Fault:
    """The first number of an output that differs by more than rounding."""

    output: str
    element: int | None
    row: int
    got: float | int
    expected: float | int
    allowed: float | None = None
    rows: int = 1
    """Number of rows that differ."""


@dataclass(frozen=True)
class Comparison:
    """The largest differences, absolute and relative to the scale, and the first one that is too large."""

    max_abs: float = 0.0
    max_rel: float = 0.0
    fault: Fault | None = None


class Comparer:
    """Compares outputs with those of references."""

    def __init__(
        self,
        recipe: Recipe,
        references: Sequence[Reference],
        measure: Callable[[], list[Outputs]] | None = None,
    ) -> None:
        """`measure` gives what `measure_rounding` does; it is called once, and only if a difference is too large."""
        self._recipe = recipe
        self._references = references
        self._measure = measure
        self._movements: list[Outputs] | None = None
        values = [reference.outputs["value"] for reference in references if "value" in reference.outputs]
        self._largest_value = max(map(_largest, values), default=1.0)
        self._ranges = {
            name: _range([reference.outputs[name] for reference in references])
            for name, space in recipe.action_leaves.items()
            if isinstance(space, Box) and not _is_bounded(space)
        }

    def compare(self, number: int, got: Outputs, rows: slice = slice(None)) -> Comparison:
        """Compare `got` with some rows of the reference `number`."""
        result = Comparison()
        expected = {name: values[rows] for name, values in self._references[number].outputs.items()}
        actions = self._recipe.action_leaves
        for output, values in expected.items():
            space = actions.get(output)
            if space is not None and not isinstance(space, Box):
                fault = self._choices(number, output, got[output], expected, rows)
                result = Comparison(result.max_abs, result.max_rel, fault)
            else:
                one = self._numbers(number, output, got[output], values, rows)
                result = Comparison(max(result.max_abs, one.max_abs), max(result.max_rel, one.max_rel), one.fault)
            if result.fault is not None:
                return result
        return result

    def _numbers(self, number: int, output: str, got: NDArray[Any], expected: NDArray[Any], rows: slice) -> Comparison:
        a, b = got.astype(np.float64), expected.astype(np.float64)
        with np.errstate(invalid="ignore"):
            same = (a == b) | (np.isnan(a) & np.isnan(b))  # overflow in both is not a difference
            difference = np.where(same, 0.0, np.abs(a - b))
        least = self._largest_value if output == "value" else 1.0
        scale = np.broadcast_to(_scale(b, self._recipe.action_leaves.get(output), least), b.shape)
        scale = np.minimum(scale, self._ranges.get(output, np.inf))
        size = np.where(np.isfinite(b), np.abs(b), 0.0)
        allowed = np.maximum(RTOL * scale + np.minimum(ATOL, LARGEST * scale), LAST_BITS * size)
        bad = ~(difference <= allowed)
        if bad.any():
            allowed = np.maximum(allowed, np.minimum(allowed + self._rounding(number, output, rows), LARGEST * scale))
            bad = ~(difference <= allowed)
        fault = None
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            element = int(np.ravel_multi_index(index[1:], b.shape[1:])) if b.ndim > 1 else 0
            differing = len(np.unique(np.argwhere(bad)[:, 0]))
            fault = Fault(output, element, index[0], float(a[index]), float(b[index]), float(allowed[index]), differing)
        relative = difference / np.maximum(np.maximum(scale, size), np.finfo(np.float32).tiny)
        return Comparison(float(difference.max(initial=0.0)), float(relative.max(initial=0.0)), fault)

    def _choices(self, number: int, output: str, got: NDArray[Any], expected: Outputs, rows: slice) -> Fault | None:
        """Compare discrete actions; a tie in their scores excuses a difference, and so do scores that are NaN."""
        if np.array_equal(got, expected[output]):
            return None
        columns = list(zip(_columns(got), _columns(expected[output]), strict=True))
        scored = choice_scores(self._recipe, expected).get(output, [])
        for part, (chosen, wanted) in enumerate(columns):
            for row in np.flatnonzero(chosen != wanted).tolist():
                choice, right = int(chosen[row]), int(wanted[row])
                if not (scored and self._tie(number, scored[part], row, (choice, right), scores_name(expected), rows)):
                    return Fault(output, part if len(columns) > 1 else None, row, choice, right)
        return None

    def _tie(
        self, number: int, scores: NDArray[np.float64], row: int, choices: tuple[int, int], name: str, rows: slice
    ) -> bool:
        """Return whether a row's scores for two choices differ only by rounding, or are NaN."""
        if np.isnan(scores[row]).any():
            return True
        if not all(0 <= choice < scores.shape[1] for choice in choices):
            return False
        apart, width = abs(float(np.diff(scores[row, list(choices)])[0])), float(_tie_width(scores)[row])
        if apart <= width:
            return True
        moved = self._rounding(number, name, rows)
        largest = LARGEST * max(1.0, float(np.abs(scores[row, list(choices)]).max()))
        return apart <= min(width + float(moved[row if len(moved) > 1 else 0].max()), largest)

    def _rounding(self, number: int, output: str, rows: slice) -> NDArray[np.float64]:
        """Return the allowance for each row of an output that the policy's own movement gives."""
        if self._measure is None:
            return np.zeros((1, 1))
        if self._movements is None:
            self._movements = self._measure()
        movement = self._movements[number][output][rows]
        axes = tuple(range(1, movement.ndim))
        return np.asarray(ROUNDING * (movement.max(axis=axes, keepdims=True) if axes else movement))


def _scale(expected: NDArray[np.float64], space: Any, least: float) -> NDArray[np.float64]:
    """Return the scale that rounding is measured against, broadcastable to `expected`."""
    if isinstance(space, Box) and _is_bounded(space):
        return (space.high.astype(np.float64) - space.low.astype(np.float64))[None] / 2
    measured = np.isfinite(expected) & (np.abs(np.nan_to_num(expected)) < MASKED)
    finite = np.where(measured, np.abs(expected), 0.0)
    axes = tuple(range(1, expected.ndim))
    return np.maximum(finite.max(axis=axes, keepdims=True) if axes else finite, least)


def _is_bounded(space: Box) -> bool:
    return bool((space.bounded_below & space.bounded_above).all())


def _range(batches: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """Return each element's largest number `[*shape]`, of which ATOL is at most the share LARGEST."""
    largest = [np.nan_to_num(np.abs(batch.astype(np.float64)), posinf=0.0).max(axis=0) for batch in batches]
    return np.asarray(np.maximum(np.max(largest, axis=0), ATOL / LARGEST), np.float64)


def _largest(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return max(1.0, float(np.abs(finite).max(initial=0.0)))


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
    with np.errstate(invalid="ignore"):  # two forbidden choices
        return np.asarray(best[:, 1] - best[:, 0] <= _tie_width(scores))


def _tie_width(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    measured = np.where(np.abs(np.nan_to_num(scores)) < MASKED, np.abs(np.nan_to_num(scores)), 0.0)
    return np.asarray(RTOL * np.maximum(measured.max(axis=1), 1.0) + ATOL)
