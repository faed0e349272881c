"""Bounds and clips of a policy that no sample reached: no comparison of actions shows whether they are right."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.export.graph.observation_preprocessing import FilterNode
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.recipe.recipe import Recipe, leaf_transform
from rlservo.export.recipe.runners import Inputs, Outputs


def unreached(
    graph: PolicyGraph, recipe: Recipe, inputs: Sequence[Inputs], answers: Sequence[Outputs], labels: Sequence[str]
) -> list[str]:
    """Return a phrase for each kind of bound with the elements that never reached it.

    `inputs` are the graph's, `answers` the framework's own; `labels` name the action's elements.
    """
    return [*_clips(graph, inputs), *_bounds(recipe, inputs, answers, labels)]


def _clips(graph: PolicyGraph, inputs: Sequence[Inputs]) -> Iterator[str]:
    """Yield the observation filters whose clip some element never reached, on either side."""
    filters = [node for node in graph.steps if isinstance(node, FilterNode) and node.clip is not None]
    reached: dict[FilterNode, Any] = {}

    def watch(node: FilterNode, _arguments: Any, obs: Any) -> None:
        leaf = obs if node.leaf == "obs" else obs[node.leaf.removeprefix("obs.")]
        clip = float(node.clip or 0.0)
        sides = torch.stack([(leaf <= -clip).any(dim=0), (leaf >= clip).any(dim=0)])
        reached[node] = sides | reached.get(node, sides)

    hooks = [node.register_forward_hook(watch) for node in filters]
    try:
        with torch.no_grad():
            for batch in inputs if filters else ():
                graph(*(torch.from_numpy(batch[name].copy()) for name in graph.input_names))
    finally:
        for hook in hooks:
            hook.remove()
    for node, sides in reached.items():
        if missing := int((~sides).any(dim=0).sum()):
            yield f"{node.leaf}: the filter's clip at {node.clip:g} ({missing} of {sides[0].numel()} elements)"


def _bounds(
    recipe: Recipe, inputs: Sequence[Inputs], answers: Sequence[Outputs], labels: Sequence[str]
) -> Iterator[str]:
    """Yield the action's bounds that the framework's own actions never reached."""
    for name, space in recipe.action_leaves.items():
        if not isinstance(space, Box):
            continue
        actions = np.concatenate([answer[name] for answer in answers])
        slack: Any = 0.0
        if recipe.present is not None:
            positions = recipe.present.positions(np.concatenate([batch["obs"] for batch in inputs]))
            actions, slack = actions - positions, 1e-6 * np.abs(positions)  # of the sum's rounding
        for side, bound, is_low in _limits(recipe, space):
            hit = (actions <= bound + slack if is_low else actions >= bound - slack).any(axis=0)
            missing = np.flatnonzero(np.isfinite(bound) & ~hit).tolist()
            if missing:
                which = [str(labels[index] if name == "action" and index < len(labels) else index) for index in missing]
                shown = ", ".join(which[:8]) + (f" and {len(which) - 8} more" if len(which) > 8 else "")
                yield f"{name}: {side} of {shown}"


def _limits(recipe: Recipe, space: Box) -> Iterator[tuple[str, NDArray[Any], bool]]:
    """Yield (name, value for each element, whether it is the lower one) of what clips an action."""
    transform = leaf_transform(space, recipe.transform)
    if transform == "clip" or (transform == "unsquash" and recipe.mode != "tanh_mean"):
        yield "the lower bound", space.low, True
        yield "the upper bound", space.high, False
    if recipe.affine is not None and recipe.affine.limit is not None:
        ends = np.sort([recipe.affine.apply(np.full(space.shape, side, np.float32)) for side in (-np.inf, np.inf)], 0)
        yield "the clip below", ends[0], True
        yield "the clip above", ends[1], False
    if recipe.present is not None:
        yield "the relative action's lower bound", recipe.present.low, True
        yield "the relative action's upper bound", recipe.present.high, False
