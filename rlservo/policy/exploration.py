"""Exploratory actions: samples of the policy's action distribution, drawn in numpy as RLlib draws them.

The graph gives the distribution's parameters (`action_dist_inputs`); this file has the distributions of RLlib's own
algorithms and the steps that RLlib applies to a sample before `env.step`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.action_transform import to_sent
from rlservo.bundle.contract import Distribution
from rlservo.bundle.log_probability import MAX_LOG_STD, MIN_LOG_STD
from rlservo.bundle.scores import parameter_count, split_parameters
from rlservo.bundle.spaces import (
    BoxSpec,
    DictSpec,
    DiscreteSpec,
    LeafSpec,
    MultiDiscreteSpec,
    SpaceSpec,
    TupleSpec,
    leaf_specs,
)


@dataclass(frozen=True, slots=True)
class Draw:
    """An exploratory action, with its origin for a recording."""

    action: dict[str, NDArray[Any]]
    """By tensor name, `[batch, *shape]`, ready for the environment."""
    own: dict[str, NDArray[Any]]
    """The module's own action: the sample before unsquashing, clipping and adding the space's start."""
    inputs: NDArray[Any]
    """`action_dist_inputs`, `[batch, distribution_size]`."""


def distribution_size(distribution: Distribution, space: SpaceSpec) -> int:
    """Return the number of values per action in `action_dist_inputs`; 0 if distribution and space do not match."""
    leaves = leaf_specs(space, "action").values()
    kinds = {_leaf_kind(leaf, distribution) for leaf in leaves}
    nested = isinstance(space, DictSpec | TupleSpec)
    if nested != (distribution.kind == "multi") or (not nested and kinds != {distribution.kind}):
        return 0
    return sum(parameter_count(leaf) for leaf in leaves)


def sample_action(
    inputs: NDArray[np.floating], distribution: Distribution, space: LeafSpec, rng: np.random.Generator
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Draw one action per row of `inputs` `[batch, distribution_size]`: (in environment units, the module's own).

    Both are `[batch, *space.shape]`. 'diag_gaussian' rows are [mean, log_std]; 'squashed_gaussian' rows as well, with
    tanh of the sample; 'categorical' rows are logits, sampled by the Gumbel-max trick (Gumbel 1954; Maddison et al.
    2014, arXiv:1411.0030); 'multi_categorical' rows are several such rows side by side.
    """
    rows = inputs.astype(np.float64)
    if isinstance(space, DiscreteSpec):
        chosen = _choose(rows, rng)
        return to_sent(chosen, distribution.transform, space), chosen
    if isinstance(space, MultiDiscreteSpec):
        parts = np.split(rows, np.cumsum(space.nvec)[:-1], axis=-1)
        chosen = np.stack([_choose(part, rng) for part in parts], axis=-1)
        own = chosen.reshape((-1, *space.shape))
        return to_sent(own, distribution.transform, space), own
    assert isinstance(space, BoxSpec), "RLlib has no distribution for other spaces"
    mean, log_std = np.split(rows, 2, axis=-1)
    if distribution.kind == "squashed_gaussian":
        log_std = np.clip(log_std, MIN_LOG_STD, MAX_LOG_STD)
    sample = mean + np.exp(log_std) * rng.standard_normal(mean.shape)
    if distribution.kind == "squashed_gaussian":
        sample = np.tanh(sample)
    sample = sample.reshape((-1, *space.shape))
    return to_sent(sample, distribution.transform, space), sample


def draw_action(
    inputs: NDArray[np.floating], distribution: Distribution, space: SpaceSpec, rng: np.random.Generator
) -> Draw:
    """Draw every leaf of the action, in the leaf's own dtype."""
    action, own = {}, {}
    for name, leaf, part in split_parameters(inputs, space):
        sent, sample = sample_action(part, distribution, leaf, rng)
        action[name], own[name] = sent.astype(leaf.dtype), sample.astype(leaf.dtype)
    return Draw(action, own, inputs)


def _choose(logits: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int64]:
    return np.asarray(np.argmax(logits + rng.gumbel(size=logits.shape), axis=-1), np.int64)


def _leaf_kind(leaf: LeafSpec, distribution: Distribution) -> str:
    if isinstance(leaf, DiscreteSpec):
        return "categorical"
    if isinstance(leaf, MultiDiscreteSpec):
        return "multi_categorical"
    return "squashed_gaussian" if distribution.kind == "squashed_gaussian" else "diag_gaussian"
