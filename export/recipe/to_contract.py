"""Translation of Gymnasium's spaces, and a policy's state, into the contract's terms."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from numpy.typing import NDArray

from rlservo.bundle.contract import StateSpec
from rlservo.bundle.spaces import (
    BoxSpec,
    DictSpec,
    DiscreteSpec,
    Element,
    MultiBinarySpec,
    MultiDiscreteSpec,
    SpaceSpec,
    TupleSpec,
)
from rlservo.export.recipe.recipe import StateLeaf
from rlservo.export.recipe.trees import space_leaves


def space_spec(
    space: Any,
    elements: Sequence[Element] | Mapping[str, Sequence[Element]] = (),
    *,
    action: bool = False,
    unread: Collection[str] = (),
    name: str = "obs",
) -> SpaceSpec:
    """Return the contract's form of `space`; `elements` are those of its leaves, by tensor name if it is nested.

    A Dict's key whose leaves are all `unread` (by input name) is only mentioned; a Tuple keeps its length. An
    action's Discrete loses its `start`: the contract says what goes to `env.step`, and RLlib sends 0 .. n - 1.
    """
    if isinstance(space, Dict):
        paths = {key: f"{name}.{key}" for key in sorted(space.spaces)}
        ignored = [key for key, path in paths.items() if all(leaf in unread for leaf in space_leaves(space[key], path))]
        kept = {
            key: space_spec(space[key], elements, action=action, unread=unread, name=path)
            for key, path in paths.items()
            if key not in ignored
        }
        return DictSpec(spaces=kept, ignored=tuple(ignored))
    if isinstance(space, Tuple):
        inside = enumerate(space.spaces)
        return TupleSpec(
            spaces=tuple(
                space_spec(child, elements, action=action, unread=unread, name=f"{name}.{i}") for i, child in inside
            )
        )
    named = tuple(elements.get(name, ()) if isinstance(elements, Mapping) else elements)
    if isinstance(space, Discrete):
        return DiscreteSpec(n=int(space.n), start=0 if action else int(space.start), dtype="int64", elements=named)
    shape = tuple(int(size) for size in space.shape)
    if isinstance(space, MultiDiscrete):
        start = np.zeros(shape) if action else np.broadcast_to(np.asarray(space.start), shape)
        return MultiDiscreteSpec(
            shape=shape,
            nvec=tuple(int(n) for n in space.nvec.ravel()),
            start=tuple(int(first) for first in start.ravel()),
            dtype="int64" if action else str(space.dtype),
            elements=named,
        )
    if isinstance(space, MultiBinary):
        return MultiBinarySpec(shape=shape, dtype="int64" if action else str(space.dtype), elements=named)
    assert isinstance(space, Box)
    return BoxSpec(shape=shape, dtype=str(space.dtype), low=_bound(space.low), high=_bound(space.high), elements=named)


def state_spec(leaf: StateLeaf) -> StateSpec:
    """Return the contract's form of one part of a policy's state."""
    flat = leaf.initial.ravel().tolist()
    return StateSpec(
        name=leaf.name,
        dtype=str(leaf.initial.dtype),
        shape=tuple(leaf.initial.shape),
        initial=float(flat[0]) if len(set(flat)) == 1 else tuple(float(value) for value in flat),
        kind=leaf.kind,
    )


def _bound(values: NDArray[Any]) -> float | tuple[float | None, ...] | None:
    """Return one number if all elements share it, None for infinity."""
    flat = [float(value) if np.isfinite(value) else None for value in values.ravel()]
    return flat[0] if len(set(flat)) == 1 else tuple(flat)
