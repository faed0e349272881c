"""Differences that a compiled policy may have from its graph: the rule by which the exporter proved that graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.scores import scores_name, split_scores
from rlservo.bundle.spaces import BoxSpec, leaf_specs

ROUNDING = 8.0
"""Multiple of the change by last bits that is rounding: enough for sums of 64 terms (reasons: `moved_weights`)."""
MASKED = 1e30
"""A number beyond this stands for 'not allowed'; it measures nothing."""

Arrays = Mapping[str, NDArray[Any]]


def allowed_differences(
    contract: Contract, outputs: Arrays, moved: Sequence[Arrays] = ()
) -> dict[str, NDArray[np.float64]]:
    """Return how far each number of an action or next state may be from `outputs`, the graph's own.

    A float may differ by the contract's tolerance of its scale: half the range of a bounded action, else the largest
    number in its row. A choice must be equal, unless another one's score ties with its own, or scores are NaN: then it
    may be any of those. `moved` is what the graph computes when the observation and all weights move by their last bit,
    several times: ROUNDING times the largest change is also allowed.
    """
    rtol, atol = contract.parity.rtol, contract.parity.atol
    leaves = leaf_specs(contract.action_space, "action")
    allowed: dict[str, NDArray[np.float64]] = {}
    for name in (*leaves, *(f"state_out.{state.name}" for state in contract.state)):
        values, leaf = outputs[name], leaves.get(name)
        if values.dtype.kind != "f":
            allowed[name] = _ties(contract, name, outputs, moved)
            continue
        flat = np.nan_to_num(np.abs(values.reshape(len(values), -1).astype(np.float64)), nan=0.0, posinf=0.0)
        scale = np.maximum(np.where(flat < MASKED, flat, 0.0).max(axis=1, keepdims=True), 1.0)
        if isinstance(leaf, BoxSpec):
            low, high = (bound.ravel() for bound in leaf.bounds())
            if np.isfinite(low).all() and np.isfinite(high).all():
                scale = ((high - low) / 2)[None]
        limit = usual = rtol * np.maximum(flat, scale) + atol
        for each in moved:
            limit = np.maximum(limit, usual + ROUNDING * _movement(values, each[name]).max(axis=1, keepdims=True))
        allowed[name] = limit.reshape(values.shape)
    return allowed


def _movement(before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):
        movement = np.abs(after.astype(np.float64) - before.astype(np.float64)).reshape(len(before), -1)
    return np.nan_to_num(movement, nan=0.0, posinf=0.0)


def _ties(contract: Contract, name: str, outputs: Arrays, moved: Sequence[Arrays]) -> NDArray[np.float64]:
    chosen = outputs[name]
    none = np.zeros(chosen.shape)
    scored = outputs.get(scores_name(outputs))
    leaf = leaf_specs(contract.action_space, "action").get(name)
    parts = split_scores(scored, contract.action_space).get(name) if scored is not None and scored.ndim == 2 else None
    if parts is None or leaf is None:
        return none
    index = (chosen - leaf.bounds()[0].astype(chosen.dtype)).reshape(len(chosen), -1)
    distance = none.reshape(len(chosen), -1)
    rows = np.arange(len(chosen))
    for column, scores in enumerate(parts):
        measured = np.where(np.isfinite(scores) & (np.abs(scores) < MASKED), np.abs(scores), 0.0)
        width = contract.parity.rtol * np.maximum(measured.max(axis=1), 1.0) + contract.parity.atol
        if moved and scored is not None:
            changes = [_movement(scored, each[scores_name(outputs)]).max(axis=1) for each in moved]
            width = width + ROUNDING * np.max(changes, axis=0)
        own = index[:, column].astype(np.int64)
        inside = (own >= 0) & (own < scores.shape[1])
        best = scores[rows, np.where(inside, own, 0)]
        with np.errstate(invalid="ignore"):
            tied = (np.abs(scores - best[:, None]) <= width[:, None]) | np.isnan(scores).any(axis=1, keepdims=True)
        apart = np.abs(np.arange(scores.shape[1])[None] - own[:, None])
        distance[:, column] = np.where(inside, (apart * tied).max(axis=1), 0)
    return distance.reshape(chosen.shape)
