"""The observations an export is proven on: likely ones, wide ones, and extremes that make every clip engage.

It draws numbers from a recipe's observation space and filter; it runs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.recipe import Recipe

BATCH_SIZES = (1, 2, 257)
UNBOUNDED = 1e6  # a bound beyond this (CartPole's 3.4e38) says nothing of the values that occur
WIDE = 10.0  # standard deviations
EXTREME = 1e3


@dataclass(frozen=True)
class Batch:
    """Observations `[batch, *obs_shape]` in the space's dtype, and what kind they are."""

    kind: str
    obs: NDArray[Any]


def draw_batches(recipe: Recipe, seed: int) -> list[Batch]:
    """Return batches of every kind and every size in BATCH_SIZES; the same seed draws the same."""
    rng = np.random.default_rng(seed)
    one, two, many = BATCH_SIZES
    sizes = [many, *[one] * 4, *[two] * 2]
    kinds = {"likely": _likely, "wide": _wide, "extreme": _extreme}
    return [
        Batch(kind, draw(recipe, rng, size).astype(recipe.observation_space.dtype))
        for kind, draw in kinds.items()
        for size in sizes
    ]


def _likely(recipe: Recipe, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Uniform in the space where it is bounded, else as the filter has seen them (without one: standard normal)."""
    low, high, bounded = _bounds(recipe)
    centre, spread = _centre_and_spread(recipe)
    shape = (size, *low.shape)
    uniform = rng.uniform(np.where(bounded, low, 0.0), np.where(bounded, high, 1.0), shape)
    return np.where(bounded, uniform, centre + spread * rng.standard_normal(shape))


def _wide(recipe: Recipe, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Normal about the centre, ten standard deviations wide: about a third of the elements reach the filter's clip."""
    centre, spread = _centre_and_spread(recipe)
    return centre + WIDE * spread * rng.standard_normal((size, *centre.shape))


def _extreme(recipe: Recipe, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Corners of the space, with some elements at zero and some a thousand times too large."""
    low, high, bounded = _bounds(recipe)
    centre, spread = _centre_and_spread(recipe)
    shape = (size, *low.shape)
    corner = np.where(rng.random(shape) < 0.5, np.where(bounded, low, centre), np.where(bounded, high, centre))
    huge = rng.choice([-1.0, 1.0], shape) * EXTREME * np.maximum(spread, 1.0)
    dice = rng.random(shape)
    return np.where(dice < 0.1, 0.0, np.where(dice < 0.3, huge, corner))


def _bounds(recipe: Recipe) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    space = recipe.observation_space
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return low, high, (np.abs(low) < UNBOUNDED) & (np.abs(high) < UNBOUNDED)


def _centre_and_spread(recipe: Recipe) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    shape = recipe.observation_space.shape
    if recipe.filter is None:
        return np.zeros(shape), np.ones(shape)
    return recipe.filter.mean.reshape(shape), recipe.filter.std.astype(np.float64).reshape(shape)
