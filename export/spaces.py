"""Translate Gymnasium's spaces into the contract's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from rlservo.export.bundle import BoxSpec, DiscreteSpec, Element
from rlservo.export.recipe import AnyDiscrete


def space_spec(space: Box | AnyDiscrete, elements: Sequence[Element] = ()) -> BoxSpec | DiscreteSpec:
    """Return the contract's form of `space`.

    A Discrete loses its `start`: the contract says what goes to `env.step`, and RLlib sends 0 .. n - 1.
    """
    if isinstance(space, Discrete):
        return DiscreteSpec(n=int(space.n), start=0, dtype="int64", elements=tuple(elements))
    return BoxSpec(
        shape=tuple(int(size) for size in space.shape),
        dtype=str(space.dtype),
        low=_bound(space.low),
        high=_bound(space.high),
        elements=tuple(elements),
    )


def _bound(values: NDArray[np.floating]) -> float | tuple[float | None, ...] | None:
    """Return one number where all elements share it, None for infinity."""
    flat = [float(value) if np.isfinite(value) else None for value in values.ravel()]
    return flat[0] if len(set(flat)) == 1 else tuple(flat)
