"""Mutants of a recipe: every statistic, bound, flag and step of it changed in turn, by `dataclasses.replace`."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from numpy.typing import NDArray

NAMED = {"leaf", "state_name", "name", "kind", "function"}
"""Fields that name a thing or are code."""
MODES = ("mean", "tanh_mean", "argmax", "given")
TRANSFORMS = ("none", "unsquash", "clip")
Mutant = tuple[str, str, Any]
"""Kind, place and change, and the changed object."""


def recipe_mutants(recipe: Any, numbers: int) -> Iterator[Mutant]:
    """Yield all mutants of a recipe; of an array with more than `numbers` numbers that many, evenly spread."""
    yield from _steps(recipe)
    for place, step in enumerate(recipe.steps):
        for kind, what, changed in _fields(step, numbers):
            steps = (*recipe.steps[:place], changed, *recipe.steps[place + 1 :])
            label = f"{type(step).__name__}.{what}"
            yield kind, label, dataclasses.replace(recipe, steps=steps)
    for name, choices in (("mode", MODES), ("transform", TRANSFORMS)):
        for choice in choices:
            if choice != getattr(recipe, name):
                yield name, f"{name}: {choice}", dataclasses.replace(recipe, **{name: choice})
    for kind, field, most in (("bound", "action_space", numbers), ("observation space", "observation_space", 1)):
        for what, space in _spaces(getattr(recipe, field), most):
            yield kind, f"{field}{what}", dataclasses.replace(recipe, **{field: space})
    if recipe.affine is not None:
        for _, what, affine in _fields(recipe.affine, numbers):
            yield "scale and offset", f"affine.{what}", dataclasses.replace(recipe, affine=affine)
        yield "scale and offset", "affine left out", dataclasses.replace(recipe, affine=None)
    for place, leaf in enumerate(recipe.network_state):
        for what, initial in _arrays(leaf.initial, numbers):
            changed = dataclasses.replace(leaf, initial=initial)
            state = (*recipe.network_state[:place], changed, *recipe.network_state[place + 1 :])
            yield "state", f"initial {leaf.name}{what}", dataclasses.replace(recipe, network_state=state)
    if len(recipe.network_state) > 1:
        state = recipe.network_state[::-1]
        yield "state", "the network's state in another order", dataclasses.replace(recipe, network_state=state)


def _steps(recipe: Any) -> Iterator[Mutant]:
    for field in ("steps", "action_steps"):
        steps = getattr(recipe, field)
        for place, step in enumerate(steps):
            name = f"{field}[{place}] ({type(step).__name__})"
            less = (*steps[:place], *steps[place + 1 :])
            yield "line of the recipe", f"{name} left out", dataclasses.replace(recipe, **{field: less})
            twice = (*steps[: place + 1], *steps[place:])
            yield "line of the recipe", f"{name} twice", dataclasses.replace(recipe, **{field: twice})
            if place + 1 < len(steps):
                swapped = (*steps[:place], steps[place + 1], step, *steps[place + 2 :])
                what = f"{name} after the next"
                yield "line of the recipe", what, dataclasses.replace(recipe, **{field: swapped})


def _fields(step: Any, numbers: int) -> Iterator[Mutant]:
    """Yield mutants of one step's fields: arrays by element, numbers, flags, tuples of elements, spaces."""
    for field in dataclasses.fields(step):
        name, value = field.name, getattr(step, field.name)
        kind = "statistic" if isinstance(value, np.ndarray) else "flag"
        if name in NAMED:
            continue
        for what, changed in _values(value, numbers):
            yield kind, f"{name}{what}", dataclasses.replace(step, **{name: changed})
    if hasattr(step, "mean") and hasattr(step, "std") and step.mean.shape == step.std.shape:
        exchanged = {"mean": step.std.astype(step.mean.dtype), "std": step.mean.astype(step.std.dtype)}
        yield "statistic", "mean and std exchanged", dataclasses.replace(step, **exchanged)


def _values(value: Any, numbers: int) -> Iterator[tuple[str, Any]]:
    if isinstance(value, bool):
        yield f": {not value}", not value
    elif isinstance(value, np.ndarray):
        yield from _arrays(value, numbers)
    elif isinstance(value, int):
        yield from ((f": {value + step}", value + step) for step in (-1, 1))
    elif isinstance(value, float):
        yield from ((f": {each:g}", each) for each in (value * 1.01, value * 1.1, value * 2, value / 2, -value))
        yield ": None", None
    elif isinstance(value, tuple) and value and all(isinstance(one, int) for one in value):
        yield " one less", value[:-1]
        yield " reversed", value[::-1]
        yield " each 1 more", tuple(one + 1 for one in value)
    elif isinstance(value, Dict | Tuple | Box | Discrete | MultiDiscrete):
        yield from _spaces(value, numbers)


def _arrays(values: NDArray[Any], numbers: int) -> Iterator[tuple[str, NDArray[Any]]]:
    flat = values.ravel()
    places = sorted({int(place) for place in np.linspace(0, flat.size - 1, min(flat.size, numbers))})
    finite = np.abs(flat[np.isfinite(flat)])
    spread = float(finite.max(initial=0.0)) or 1.0
    for place in places:
        one = flat[place]
        changes = {"1% more": one * 1.01, "the other sign": -one, "zero": one * 0}
        if one == 0 or not np.isfinite(one):
            changes = {"moved": 0.1 * spread} if one == 0 else {"finite": np.sign(one) * spread}
        for what, number in changes.items():
            changed = flat.copy()
            changed[place] = number
            if changed[place] != one:
                yield f"[{place}]: {what} ({one} to {changed[place]})", changed.reshape(values.shape)
        if place + 1 < flat.size and flat[place] != flat[place + 1]:
            changed = flat.copy()
            changed[[place, place + 1]] = flat[[place + 1, place]]
            yield f"[{place}]: swapped with the next", changed.reshape(values.shape)
    if flat.size > 2 and (flat != flat[::-1]).any():
        yield " reversed", flat[::-1].copy().reshape(values.shape)


def _spaces(space: Any, numbers: int) -> Iterator[tuple[str, Any]]:
    """Yield (place and change, space): bounds, starts and numbers of choices."""
    if isinstance(space, Dict | Tuple):
        inside = space.spaces.items() if isinstance(space, Dict) else enumerate(space.spaces)
        for key, child in inside:
            for what, changed in _spaces(child, numbers):
                whole: Any = dict(space.spaces) if isinstance(space, Dict) else list(space.spaces)
                whole[key] = changed
                yield f".{key}{what}", type(space)(whole)
    elif isinstance(space, Box):
        for side in ("low", "high"):
            for what, bounds in _arrays(getattr(space, side), numbers):
                yield f".{side}{what}", _with(space, **{side: bounds.astype(space.dtype)})
    elif isinstance(space, Discrete):
        yield ".n: 1 more", Discrete(int(space.n) + 1, start=int(space.start))
        yield ".start: 1 more", Discrete(int(space.n), start=int(space.start) + 1)
    elif isinstance(space, MultiDiscrete) and len(set(space.nvec.ravel().tolist())) > 1:
        yield ".nvec: reversed", MultiDiscrete(space.nvec.ravel()[::-1].reshape(space.nvec.shape), start=space.start)


def _with(space: Box, **bounds: NDArray[Any]) -> Box:
    """Return a copy of a Box with other bounds, also ones that its constructor would refuse."""
    changed = copy.deepcopy(space)
    for name, values in bounds.items():
        setattr(changed, name, values)
    changed.bounded_below = -np.inf < changed.low
    changed.bounded_above = np.inf > changed.high
    return changed
