"""Layout of `action_dist_inputs` and `q_values`: the numbers of each part of an action."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import DiscreteSpec, LeafSpec, MultiDiscreteSpec, SpaceSpec, leaf_specs

ACTION_DIST_INPUTS = "action_dist_inputs"
"""The graph's output of distribution parameters."""
Q_VALUES = "q_values"
"""The same for a policy with Q-values instead (DQN)."""


def scores_name(outputs: Container[str]) -> str:
    """Return the graph's output by which actions are chosen."""
    return Q_VALUES if Q_VALUES in outputs else ACTION_DIST_INPUTS


def parameter_count(leaf: LeafSpec) -> int:
    """Return the number of distribution parameters of one action leaf: a mean and a scale each, or a score a choice."""
    if isinstance(leaf, DiscreteSpec):
        return leaf.n
    return sum(leaf.nvec) if isinstance(leaf, MultiDiscreteSpec) else 2 * leaf.size


def split_parameters(parameters: NDArray[Any], space: SpaceSpec) -> Iterator[tuple[str, LeafSpec, NDArray[Any]]]:
    """Yield (tensor name, leaf, its `[batch, n]`) for each leaf of an action space."""
    begin = 0
    for name, leaf in leaf_specs(space, "action").items():
        yield name, leaf, parameters[:, begin : begin + parameter_count(leaf)]
        begin += parameter_count(leaf)


def split_scores(scores: NDArray[Any], space: SpaceSpec) -> dict[str, list[NDArray[Any]]]:
    """Return each discrete leaf's scores `[batch, choices]`, one array an element, by tensor name."""
    found: dict[str, list[NDArray[Any]]] = {}
    for name, leaf, part in split_parameters(scores, space):
        if isinstance(leaf, DiscreteSpec):
            found[name] = [part]
        elif isinstance(leaf, MultiDiscreteSpec):
            found[name] = np.split(part, np.cumsum(leaf.nvec)[:-1], axis=-1)
    return found
