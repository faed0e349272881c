"""The gate: an exported policy gives RLlib's own numbers, or it is not written.

It compares functions from observations to named outputs and does not know what is behind them.

A difference passes when it is at most `RTOL * max(|reference|, scale) + ATOL`. The scale is half the range of a
bounded action element; elsewhere the largest number in the same row of the output, at least 1, because the rounding
of a matrix product grows with its terms and not with their sum. `value` has one number a row, which may be a small
difference of large terms: its scale is the largest value seen over all observations. A discrete action must be the
same, unless RLlib's own scores for the two choices are that close.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from rlservo.export.bundle import FormatParity, Parity
from rlservo.export.errors import ParityError
from rlservo.export.recipe import Recipe
from rlservo.export.samples import BATCH_SIZES, Batch

RTOL = 1e-5
ATOL = 1e-6
REFERENCES: dict[str, str] = {
    "new": "RLlib's own env-to-module connectors, inference forward and module-to-env connectors, restored from the "
    "checkpoint, observation filter frozen, exploration off",
    "old": "RLlib's own agent connectors, compute_actions_from_input_dict and action connectors (old API stack), "
    "restored from the checkpoint, observation filter frozen, exploration off",
}
"""What an export is compared with, by API stack."""

Outputs: TypeAlias = dict[str, NDArray[Any]]
Runner: TypeAlias = Callable[[NDArray[Any]], Outputs]
"""Raw observations `[batch, *obs_shape]` to every output by name."""


@dataclass(frozen=True)
class Recorded:
    """One batch and what RLlib computed for it."""

    batch: Batch
    outputs: Outputs


def record(reference: Runner, batches: Sequence[Batch]) -> list[Recorded]:
    """Run RLlib on every batch. The observations are copied: a connector may write into what it is given."""
    return [Recorded(batch, reference(batch.obs.copy())) for batch in batches]


def prove(
    recipe: Recipe,
    recorded: Sequence[Recorded],
    formats: Mapping[str, Runner],
    labels: Sequence[str] = (),
    api_stack: str = "new",
) -> Parity:
    """Compare every format with what was recorded and return the largest differences.

    `labels` name the action's elements for the message, `api_stack` is whose pipeline was recorded. Raises ParityError
    at the first output that differs, saying which element of which sample by how much.
    """
    results = {name: _prove_format(name, recipe, recorded, run, labels) for name, run in formats.items()}
    return Parity(
        reference=REFERENCES[api_stack],
        samples=sum(len(one.batch.obs) for one in recorded),
        batch_sizes=BATCH_SIZES,
        rtol=RTOL,
        atol=ATOL,
        formats=results,
    )


def _prove_format(
    name: str, recipe: Recipe, recorded: Sequence[Recorded], run: Runner, labels: Sequence[str]
) -> FormatParity:
    max_abs = max_rel = 0.0
    largest_value = max((_largest(one.outputs["value"]) for one in recorded if "value" in one.outputs), default=1.0)
    for one in recorded:
        where = f"{name}, a batch of {len(one.batch.obs)} {one.batch.kind} observations"
        try:
            got = run(one.batch.obs.copy())
        except Exception as error:  # a shape baked into the graph ends in onnxruntime's or torch's own exceptions
            raise ParityError(f"{where}: the exported graph does not run: {str(error).splitlines()[0]}") from error
        for output, expected in one.outputs.items():
            _check_form(where, output, got.get(output), expected, recipe)
            if output == "action" and isinstance(recipe.action_space, Discrete):
                _check_choices(where, got[output], one)
                continue
            least = largest_value if output == "value" else 1.0
            difference, scale = _compare(where, output, got[output], expected, recipe, one, labels, least)
            max_abs = max(max_abs, float(difference.max(initial=0.0)))
            max_rel = max(max_rel, float((difference / scale).max(initial=0.0)))
    return FormatParity(max_abs=max_abs, max_rel=max_rel)


def _check_form(where: str, output: str, got: NDArray[Any] | None, expected: NDArray[Any], recipe: Recipe) -> None:
    if got is None:
        raise ParityError(f"{where}: the exported graph has no output '{output}'")
    if got.shape != expected.shape:
        raise ParityError(f"{where}: output '{output}' has shape {got.shape}, RLlib's has {expected.shape}")
    if output == "action":
        dtype = np.dtype(recipe.action_space.dtype) if isinstance(recipe.action_space, Box) else np.dtype(np.int64)
        if got.dtype != dtype:
            raise ParityError(f"{where}: the action is {got.dtype}, the action space wants {dtype}")


def _compare(
    where: str,
    output: str,
    got: NDArray[Any],
    expected: NDArray[Any],
    recipe: Recipe,
    one: Recorded,
    labels: Sequence[str],
    least_scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (difference, scale), both of the output's shape."""
    a, b = got.astype(np.float64), expected.astype(np.float64)
    with np.errstate(invalid="ignore"):
        same = (a == b) | (np.isnan(a) & np.isnan(b))  # overflow in both is no difference
        difference = np.where(same, 0.0, np.abs(a - b))
    scale = np.maximum(np.where(np.isfinite(b), np.abs(b), 1.0), _scale(output, b, recipe, least_scale))
    allowed = RTOL * scale + ATOL
    bad = ~(difference <= allowed)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        row, element = index[0], int(np.ravel_multi_index(index[1:], b.shape[1:])) if b.ndim > 1 else 0
        label = f"{element} ({labels[element]})" if output == "action" and element < len(labels) else str(element)
        raise ParityError(
            f"{where}: output '{output}', element {label}, sample {row}: the export gives {a[index]:.9g}, RLlib "
            f"{b[index]:.9g} (allowed difference {allowed[index]:.2g}); {len(np.unique(np.argwhere(bad)[:, 0]))} of "
            f"{len(b)} samples differ",
            {
                "output": output, "element": element, "sample": row, "exported": float(a[index]),
                "reference": float(b[index]), "observation": one.batch.obs[row].tolist(),
            },
        )  # fmt: skip
    return difference, scale


def _scale(output: str, expected: NDArray[np.float64], recipe: Recipe, least: float) -> NDArray[np.float64]:
    """Return the size of number that rounding is measured against, broadcastable to `expected`."""
    space = recipe.action_space
    if output == "action" and isinstance(space, Box) and bool((space.bounded_below & space.bounded_above).all()):
        return (space.high.astype(np.float64) - space.low.astype(np.float64))[None] / 2
    finite = np.where(np.isfinite(expected), np.abs(expected), 0.0)
    axes = tuple(range(1, expected.ndim))
    return np.maximum(finite.max(axis=axes, keepdims=True) if axes else finite, least)


def _largest(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return max(1.0, float(np.abs(finite).max(initial=0.0)))


def _check_choices(where: str, got: NDArray[Any], one: Recorded) -> None:
    """Compare discrete actions; a tie in RLlib's scores excuses a difference."""
    expected = one.outputs["action"]
    excused = ties(one.outputs)
    scores = _scores(one.outputs)
    for row in np.flatnonzero(got != expected):
        chosen, wanted = int(got[row]), int(expected[row])
        tied = 0 <= chosen < scores.shape[1] and excused[row]
        if not tied or abs(scores[row, chosen] - scores[row, wanted]) > _tie_width(scores)[row]:
            raise ParityError(
                f"{where}: output 'action', sample {row}: the export chooses {chosen}, RLlib {wanted}",
                {"output": "action", "sample": int(row), "exported": chosen, "reference": wanted},
            )


def ties(outputs: Outputs) -> NDArray[np.bool_]:
    """Return for each sample whether its two best discrete choices score the same within tolerance."""
    scores = _scores(outputs)
    if scores.shape[1] < 2:
        return np.zeros(len(scores), np.bool_)
    best = np.sort(scores, axis=1)[:, -2:]
    return np.asarray(best[:, 1] - best[:, 0] <= _tie_width(scores))


def _scores(outputs: Outputs) -> NDArray[np.float64]:
    return outputs["q_values" if "q_values" in outputs else "action_dist_inputs"].astype(np.float64)


def _tie_width(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(RTOL * np.maximum(np.abs(scores).max(axis=1), 1.0) + ATOL)
