"""Observations that bring a policy's actions to their bounds, found by the exported graph.

The samples seldom reach the bounds of a policy that is well within them, and a bound that nobody reaches is not
compared. The graph is fast enough to look for the largest and smallest action among thousands of observations, which
the framework is then asked for too. A graph with a wrong bound finds them as well: it shows there that it is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.export.proof.parity import GraphLoop, does_not_run
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.runners import Inputs, Outputs, Runner
from rlservo.export.recipe.samples import Batch, draw_candidates


def reaching_batches(recipe: Recipe, run: Runner, seed: int) -> list[Batch]:
    """Return the observations, or for a policy with a state the sequences, of each action element's extremes.

    `run` runs the exported graph. Raises ParityError if it does not run on so many observations.
    """
    run = _refusing(run)
    names = [name for name, space in recipe.action_leaves.items() if isinstance(space, Box)]
    if not names:
        return []
    candidates = draw_candidates(recipe, seed)
    if not recipe.state:
        rows = _extremes(np.stack([_actions(recipe, candidates[0].inputs, run(candidates[0].inputs), names)]))
        return [candidates[0].row(row) for _, row in rows]
    loop = GraphLoop(run, recipe.state)
    steps = []
    for batch in candidates:
        assert batch.restart is not None
        steps.append(_actions(recipe, batch.inputs, loop.step(batch.inputs, batch.restart), names))
    last: dict[int, int] = {}
    for step, row in _extremes(np.stack(steps)):
        last[row] = max(step, last.get(row, 0))
    return [batch.row(row) for row, step in last.items() for batch in candidates[: step + 1]]


def _refusing(run: Runner) -> Runner:
    def run_or_refuse(inputs: Inputs) -> Outputs:
        try:
            return run(inputs)
        except Exception as error:  # a shape baked into the graph ends in onnxruntime's own exceptions
            rows = len(next(iter(inputs.values())))
            raise does_not_run(f"onnx, a batch of {rows} observations", error) from error

    return run_or_refuse


def _actions(recipe: Recipe, inputs: Inputs, outputs: Outputs, names: list[str]) -> NDArray[np.float64]:
    """Return the actions, without the present positions that are in them."""
    actions = np.concatenate(
        [outputs[name].reshape(len(outputs[name]), -1).astype(np.float64) for name in names], axis=1
    )
    return actions if recipe.present is None else actions - recipe.present.positions(inputs["obs"])


def _extremes(actions: NDArray[np.float64]) -> Iterator[tuple[int, int]]:
    """Yield (step, row) of each element's smallest and largest number in `[step, row, element]`, each once."""
    flat = np.nan_to_num(actions).reshape(-1, actions.shape[-1])
    found = np.unique(np.concatenate([flat.argmin(axis=0), flat.argmax(axis=0)]))
    for index in found.tolist():
        yield divmod(index, actions.shape[1])
