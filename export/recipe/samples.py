"""Sample observations for the proof: likely ones, wide ones, and extremes.

They stay within bounds (`out_of_bounds` decides about others), except where a filter comes first, whose clip must show.
Sequences, in which episodes end and begin at different steps in different rows, show a state, or that there is none.
The numbers come from a recipe's observation space and filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray

from rlservo.bundle.contract import REWARD
from rlservo.export.recipe.recipe import ObservationFilter, Recipe
from rlservo.export.recipe.runners import Inputs

BATCH_SIZES = (1, 2, 257)
UNBOUNDED = 1e6  # a bound beyond this (CartPole's 3.4e38) does not describe the values that occur
WIDE = 10.0  # standard deviations
EXTREME = 1e3
FAR, FAR_KIND = (-6.0, 4.0), "far"
"""Exponents, and the kind, of further samples for a user's own steps, which are written twice: numpy and torch."""
SEQUENCE_STEPS = {1: 12, 2: 100, 257: 5}  # a step costs the framework milliseconds, a row of it a tenth of one
LARGE = 4096  # elements of an observation: such a network takes 0.1 s for a step, and TorchScript as much again
LARGE_SEQUENCE_STEPS = {1: 12, 2: 24, 257: 2}
CANDIDATES, LARGE_CANDIDATES = 8192, 192
CANDIDATE_STEPS = 16
"""Observations among which an action's extremes are looked for; steps of their sequences, if there is a state."""
STATELESS_STEPS = 32
"""Steps of the sequence for a policy without a state."""
RESTARTS = (0, 7, 8)  # steps at which every row begins an episode; the first row's last one has no other end
NEW_EPISODE = 0.05  # probability that another row begins one at any other step


@dataclass(frozen=True)
class Batch:
    """Observations by input name in the space's dtypes, and their kind.

    In a sequence, `restart` marks the rows that begin an episode; the other rows continue from the batch before. None:
    the batch stands alone. `reward` is the last action's reward, of a policy that has no input for it.
    """

    kind: str
    inputs: Inputs
    restart: NDArray[np.bool_] | None = None
    reward: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(next(iter(self.inputs.values())))

    @property
    def obs(self) -> NDArray[Any]:
        """The observation of a policy that has only one input."""
        (only,) = self.inputs.values()
        return only

    def row(self, index: int) -> Batch:
        """Return one row as a batch of its own."""
        one = slice(index, index + 1)
        return Batch(
            self.kind,
            {name: values[one] for name, values in self.inputs.items()},
            None if self.restart is None else self.restart[one],
            None if self.reward is None else self.reward[one],
        )


def draw_batches(recipe: Recipe, seed: int) -> list[Batch]:
    """Return batches of every kind and every size in BATCH_SIZES, then a sequence; the same seed draws the same.

    For a policy with a state all are sequences of SEQUENCE_STEPS batches of one size; of images, shorter ones.
    """
    rng = np.random.default_rng(seed)
    one, two, many = BATCH_SIZES
    far = [FAR_KIND] if recipe.user_steps else []
    if recipe.state:
        kinds = {size: _kinds(rng, _steps(recipe, size)) + (far if size == many else []) for size in BATCH_SIZES}
        return [batch for size in BATCH_SIZES for batch in _sequence(recipe, rng, size, kinds[size])]
    sizes = [many, *[one] * 4, *[two] * 2]
    batches = [Batch(kind, _observations(recipe, kind, rng, size)) for kind in KINDS for size in sizes]
    batches += [Batch(kind, _observations(recipe, kind, rng, many)) for kind in far]
    return [*batches, *_sequence(recipe, rng, two, _kinds(rng, STATELESS_STEPS))]


def _steps(recipe: Recipe, size: int) -> int:
    return (SEQUENCE_STEPS if _elements(recipe) <= LARGE else LARGE_SEQUENCE_STEPS)[size]


def _elements(recipe: Recipe) -> int:
    return sum(math.prod(leaf.shape) for leaf in recipe.observation_leaves.values())


def draw_candidates(recipe: Recipe, seed: int) -> list[Batch]:
    """Return one batch of many observations of every kind; for a policy with a state a sequence of many rows."""
    rng = np.random.default_rng(seed)
    count = CANDIDATES if _elements(recipe) <= LARGE else LARGE_CANDIDATES
    if recipe.state:
        order = rng.permutation([*DRAWS] * (CANDIDATE_STEPS // len(DRAWS)))
        return list(_sequence(recipe, rng, count // CANDIDATE_STEPS, order.tolist()))
    kinds = [_observations(recipe, kind, rng, count // len(DRAWS)) for kind in DRAWS]
    return [Batch("reaching", {name: np.concatenate([kind[name] for kind in kinds]) for name in kinds[0]})]


def draw_pair(recipe: Recipe) -> Inputs:
    """Return two likely observations."""
    return _observations(recipe, "likely", np.random.default_rng(0), 2)


def _kinds(rng: np.random.Generator, steps: int) -> list[str]:
    rare = (steps + 5) // 10
    kinds: list[str] = rng.permutation(["wide"] * rare + ["extreme"] * rare + ["likely"] * (steps - 2 * rare)).tolist()
    return kinds


def _sequence(recipe: Recipe, rng: np.random.Generator, size: int, kinds: Sequence[str]) -> Iterator[Batch]:
    for step, kind in enumerate(kinds):
        inputs = _observations(recipe, kind, rng, size)
        restart = (rng.random(size) < NEW_EPISODE) & (np.arange(size) > 0)
        if step in RESTARTS:
            restart[:] = True
        reward = np.where(restart, 0.0, rng.standard_normal(size)).astype(np.float32)
        if recipe.needs_reward:
            inputs[REWARD] = reward
        yield Batch(kind, inputs, restart, None if recipe.needs_reward else reward)


def _observations(recipe: Recipe, kind: str, rng: np.random.Generator, size: int) -> Inputs:
    first = recipe.first_filters
    return {
        name: _draw(kind, _Leaf(space, first.get(name, recipe.filter), name in first), rng, size)
        for name, space in recipe.observation_leaves.items()
    }


@dataclass(frozen=True)
class _Leaf:
    space: Any
    filter: ObservationFilter | None
    filtered_first: bool


def _draw(kind: str, leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[Any]:
    space = leaf.space
    if isinstance(space, Discrete):
        return np.asarray(rng.integers(space.start, space.start + space.n, size), np.int64)
    if isinstance(space, MultiDiscrete):
        low = np.asarray(space.start)
        return np.asarray(rng.integers(low, low + space.nvec, (size, *space.shape)), space.dtype)
    if isinstance(space, MultiBinary):
        return rng.integers(0, 2, (size, *space.shape)).astype(space.dtype)
    assert isinstance(space, Box)
    if np.dtype(space.dtype).kind in "iu":
        return _integers(kind, space, rng, size)
    if np.dtype(space.dtype).kind == "b":
        return np.asarray(rng.random((size, *space.shape)) < 0.5)
    largest = float(np.finfo(space.dtype).max)  # float16's is 65504
    return np.clip((_far if kind == FAR_KIND else DRAWS[kind])(leaf, rng, size), -largest, largest).astype(space.dtype)


def _integers(kind: str, space: Box, rng: np.random.Generator, size: int) -> NDArray[Any]:
    """Whole numbers of the space: anywhere in it, or (extremes) only its bounds."""
    low = np.maximum(space.low.astype(np.float64), -UNBOUNDED).astype(np.int64)
    high = np.minimum(space.high.astype(np.float64), UNBOUNDED).astype(np.int64)
    shape = (size, *space.shape)
    if kind == "extreme":
        return np.where(rng.random(shape) < 0.5, low, high).astype(space.dtype)
    return rng.integers(low, high, shape, endpoint=True).astype(space.dtype)


def _likely(leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Uniform if the space is bounded, else distributed as the filter has seen them (without one: standard normal)."""
    low, high, bounded = _bounds(leaf)
    centre, spread = _centre_and_spread(leaf)
    shape = (size, *low.shape)
    uniform = rng.uniform(np.where(bounded, low, 0.0), np.where(bounded, high, 1.0), shape)
    return np.where(bounded, uniform, centre + spread * rng.standard_normal(shape))


def _wide(leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Normal about the centre, ten standard deviations wide: about a third of the elements reach the filter's clip."""
    centre, spread = _centre_and_spread(leaf)
    drawn = centre + WIDE * spread * rng.standard_normal((size, *centre.shape))
    return drawn if leaf.filtered_first else _within(leaf, drawn)


def _extreme(leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Corners of the space; in half of the rows some elements at 0.0 or -0.0 and, if unbounded, some at a thousand."""
    low, high, bounded = _bounds(leaf)
    centre, spread = _centre_and_spread(leaf)
    shape = (size, *low.shape)
    corner = np.where(rng.random(shape) < 0.5, np.where(bounded, low, centre), np.where(bounded, high, centre))
    huge = rng.choice([-1.0, 1.0], shape) * EXTREME * np.maximum(spread, 1.0)
    dice = rng.random(shape)
    zero = np.copysign(0.0, huge)  # angles and divisions distinguish the two zeros
    spoiled = np.where(dice < 0.1, zero, np.where(dice < 0.3, huge, corner))
    rows = rng.random((size, *[1] * low.ndim)) < 0.5
    return _within(leaf, np.where(rows, spoiled, corner))


def _of_any_size(leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Normal about the centre, each row of another size, from a hundredth to a thousand standard deviations."""
    centre, spread = _centre_and_spread(leaf)
    sizes = 10.0 ** rng.uniform(-2.0, 3.0, (size, *[1] * centre.ndim))
    drawn = centre + sizes * spread * rng.standard_normal((size, *centre.shape))
    return drawn if leaf.filtered_first else _within(leaf, drawn)


def _far(leaf: _Leaf, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Numbers of every size: one size for the whole row, or in half of the rows one for each element."""
    shape = (size, *leaf.space.shape)
    row = (size, *[1] * len(leaf.space.shape))
    exponents = np.where(rng.random(row) < 0.5, rng.uniform(*FAR, row), rng.uniform(*FAR, shape))
    return _within(leaf, rng.standard_normal(shape) * 10.0**exponents)


DRAWS: dict[str, Callable[[_Leaf, np.random.Generator, int], NDArray[np.float64]]] = {
    "likely": _likely,
    "wide": _wide,
    "extreme": _extreme,
    "of any size": _of_any_size,
}
KINDS = ("likely", "wide", "extreme")
"""Kinds of the samples that every export is proven on."""


def _bounds(leaf: _Leaf) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    low, high = leaf.space.low.astype(np.float64), leaf.space.high.astype(np.float64)
    return low, high, (np.abs(low) < UNBOUNDED) & (np.abs(high) < UNBOUNDED)


def _within(leaf: _Leaf, values: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high, _ = _bounds(leaf)
    return np.clip(values, low, high)


def _centre_and_spread(leaf: _Leaf) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    shape = leaf.space.shape
    if leaf.filter is None or leaf.filter.mean.size != int(np.prod(shape)):
        return np.zeros(shape), np.ones(shape)
    return leaf.filter.mean.reshape(shape), leaf.filter.std.astype(np.float64).reshape(shape)
