"""Observation and action spaces that are exported; others are refused by the name of the leaf."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from rlservo.errors import UnsupportedError
from rlservo.export.recipe.recipe import Flatten, ObservationStep, Preprocess, Transform, leaf_transform
from rlservo.export.recipe.trees import space_leaves

DTYPES = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
ONLY_CAST = ("float16", "uint16", "uint32", "uint64")
"""torch can make float32 of them, and little else."""


def check_spaces(
    observation_space: Any, action_space: Any, steps: tuple[ObservationStep, ...], *, integer_actions: bool = False
) -> None:
    """Raise UnsupportedError unless every leaf of both spaces is of a kind that is exported.

    `steps` are the observation's preprocessing. `integer_actions` allows Boxes of integers as actions, for which only
    RLlib's old stack has a distribution.
    """
    is_cast = bool(steps) and isinstance(steps[0], Flatten | Preprocess)
    known = (*DTYPES, *ONLY_CAST) if is_cast else DTYPES
    for name, space in space_leaves(observation_space, "obs").items():
        if not isinstance(space, Box | Discrete | MultiDiscrete | MultiBinary):
            raise UnsupportedError(f"{name}: the observation space {space} is not exported: it has no fixed shape")
        if isinstance(space, Box) and str(space.dtype) not in known:
            remedy = (
                "; behind FlattenObservations as the first connector it is" if str(space.dtype) in ONLY_CAST else ""
            )
            raise UnsupportedError(
                f"{name}: {space} is not exported: torch has no {space.dtype} tensors to compute with{remedy}"
            )
    for name, space in space_leaves(action_space, "action").items():
        if not isinstance(space, Box | Discrete | MultiDiscrete):
            raise UnsupportedError(
                f"{name}: the action space {space} is not exported: RLlib has no action distribution for it"
            )
        whole = integer_actions and np.dtype(space.dtype).kind in "iu"
        if isinstance(space, Box) and space.dtype not in (np.float32, np.float64) and not whole:
            raise UnsupportedError(f"{name}: the action space {space} is not exported: only float Boxes are")
        if isinstance(space, MultiDiscrete) and space.nvec.ndim != 1:
            raise UnsupportedError(f"{name}: the action space {space} is not exported: only one-dimensional ones are")


def check_unsquashing(action_space: Any, transform: Transform) -> None:
    """Raise UnsupportedError if RLlib's own unsquashing overflows: for 1 it computes `2 * (high - low)`."""
    for name, space in space_leaves(action_space, "action").items():
        if not isinstance(space, Box) or leaf_transform(space, transform) != "unsquash":
            continue
        with np.errstate(over="ignore"):
            fits = np.isfinite(space.high - space.low + (space.high - space.low)).all()
        if not fits:
            raise UnsupportedError(
                f"{name}: RLlib's own unsquashing to the bounds of {space} overflows, so that it sends the largest "
                "number whatever the policy says: give the environment real bounds or infinite ones, and train again"
            )
