"""Rounding of a policy, measured: how far its numbers move when a last bit moves.

The framework is asked again with every observation moved by its last bit, which shows what the policy makes of small
differences. The graph is run with every weight moved by its last bit, which grows with the terms of a sum and their
number, as rounding does, and so shows the rounding of large sums of exact numbers (an image's bytes) too. A wrong graph
does not gain from it: its allowance is that of its own last bits, not of its fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from rlservo.export.proof.parity import GraphLoop
from rlservo.export.proof.references import Reference, record, record_perturbed
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Loop, Outputs, Runner

DRAWS = 4
"""Directions of the weights' last bits that are tried: in one, changes may cancel."""


def measure_rounding(
    start_loop: Callable[[], Loop],
    recipe: Recipe,
    references: Sequence[Reference],
    run: Runner,
    moved_weights: Callable[[int], AbstractContextManager[None]],
) -> list[Outputs]:
    """Return the largest movement of every output number of each reference.

    `run` runs the policy's graph, whose weights are moved while a context of `moved_weights` is open.
    """
    largest = _movement(references, record_perturbed(start_loop, references, recipe))
    batches = [reference.batch for reference in references]

    def start_graph() -> Loop:
        return GraphLoop(run, recipe.state)

    plain = record(start_graph, batches)
    for seed in range(DRAWS):
        with moved_weights(seed):
            moved = _movement(plain, record(start_graph, batches))
        for known, found in zip(largest, moved, strict=True):
            known.update({name: np.maximum(values, found[name]) for name, values in known.items()})
    return largest


def _movement(before: Sequence[Reference], after: Sequence[Reference]) -> list[Outputs]:
    with np.errstate(invalid="ignore"):
        return [
            {
                name: np.nan_to_num(np.abs(moved.outputs[name].astype(np.float64) - values), nan=0.0, posinf=0.0)
                for name, values in plain.outputs.items()
            }
            for plain, moved in zip(before, after, strict=True)
        ]
