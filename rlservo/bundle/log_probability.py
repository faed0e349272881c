"""Log-probability of a module's own action: RLlib's distributions over `action_dist_inputs`, in numpy.

A module's own action is its distribution's sample, before RLlib unsquashes or clips it and before a Discrete space's
start is added: a clipped action has no density, and its probability cannot be found from what was sent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Distribution
from rlservo.bundle.scores import split_parameters
from rlservo.bundle.spaces import DiscreteSpec, LeafSpec, MultiDiscreteSpec, SpaceSpec

# RLlib clamps the log of a squashed Gaussian's scale to this range: ray/rllib/utils/numpy.py, ray 2.60.
MIN_LOG_STD = -5.0
MAX_LOG_STD = 2.0
INSIDE = 1.0 - 1e-6  # a squashed action of exactly 1 came from infinity; RLlib moves it inside by as much


def log_probability(
    inputs: NDArray[Any], own: Mapping[str, NDArray[Any]], distribution: Distribution, space: SpaceSpec
) -> NDArray[np.float64]:
    """Return the log-probability (density, for a Box) of each row of `own`, leaves `[batch, *shape]` by tensor name.

    `inputs` is `[batch, distribution_size]`.
    """
    total = np.zeros(len(inputs))
    for name, leaf, part in split_parameters(np.asarray(inputs, np.float64), space):
        total += _leaf(part, np.asarray(own[name]), distribution, leaf)
    return total


def _leaf(
    inputs: NDArray[np.float64], own: NDArray[Any], distribution: Distribution, leaf: LeafSpec
) -> NDArray[np.float64]:
    rows = len(inputs)
    if isinstance(leaf, DiscreteSpec):
        return _chosen(inputs, own.reshape(rows).astype(np.int64))
    if isinstance(leaf, MultiDiscreteSpec):
        parts = np.split(inputs, np.cumsum(leaf.nvec)[:-1], axis=-1)
        choices = own.reshape(rows, -1).astype(np.int64)
        return np.asarray(np.sum([_chosen(part, choices[:, i]) for i, part in enumerate(parts)], axis=0))
    mean, log_std = np.split(inputs, 2, axis=-1)
    value = own.reshape(rows, -1).astype(np.float64)
    jacobian = np.zeros_like(value)
    if distribution.kind == "squashed_gaussian":
        log_std = np.clip(log_std, MIN_LOG_STD, MAX_LOG_STD)
        value = np.arctanh(np.clip(value, -INSIDE, INSIDE))
        jacobian = 2.0 * (math.log(2.0) - value - np.logaddexp(0.0, -2.0 * value))
    scaled = (value - mean) / np.exp(log_std)
    density = -0.5 * scaled**2 - log_std - 0.5 * math.log(2.0 * math.pi) - jacobian
    return np.asarray(density.sum(axis=-1))


def _chosen(logits: NDArray[np.float64], choice: NDArray[np.int64]) -> NDArray[np.float64]:
    shifted = logits - logits.max(axis=-1, keepdims=True)
    total = np.log(np.exp(shifted).sum(axis=-1))
    return np.asarray(np.take_along_axis(shifted, choice[:, None], axis=-1)[:, 0] - total)
