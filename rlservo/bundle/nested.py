"""Nested actions: between the space's own form (dicts and tuples) and the tensors `action.<path>`.

A Dict is a map with exactly its keys, a Tuple a list of exactly its length. A batch has a batch axis on every leaf, as
Gymnasium's vector environments give it; for a Dict, a list of single observations is also a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rlservo.bundle.spaces import LeafSpec, SpaceSpec
from rlservo.errors import RequestError


def build_action(space: SpaceSpec, leaves: Mapping[str, Any], path: str = "action") -> Any:
    """Return the action in the space's own form: dicts and tuples of its leaves, which come by tensor name."""
    if space.kind == "dict":
        return {key: build_action(child, leaves, f"{path}.{key}") for key, child in space.spaces.items()}
    if space.kind == "tuple":
        return tuple(build_action(child, leaves, f"{path}.{index}") for index, child in enumerate(space.spaces))
    return leaves[path]


def action_leaves(space: SpaceSpec, action: Any, path: str = "action") -> dict[str, Any]:
    """Return a nested action's leaves by tensor name: `build_action`, undone.

    Raises RequestError if it is not of the space's form.
    """
    leaves: dict[str, Any] = {}
    convert_leaves(space, action, lambda _spec, leaf, name: leaves.update({name: leaf}), path)
    return leaves


def convert_leaves(
    space: SpaceSpec, action: Any, convert: Callable[[LeafSpec, Any, str], Any], path: str = "action"
) -> Any:
    """Return an action in the space's own form, with `convert` of each leaf's spec, value and tensor name.

    Raises RequestError if it is not of the space's form.
    """
    if space.kind == "dict":
        if not isinstance(action, Mapping) or set(action) != set(space.spaces):
            raise RequestError(f"{path} must be a map with the keys {', '.join(sorted(space.spaces))}")
        return {key: convert_leaves(each, action[key], convert, f"{path}.{key}") for key, each in space.spaces.items()}
    if space.kind == "tuple":
        if not isinstance(action, list | tuple) or len(action) != len(space.spaces):
            raise RequestError(f"{path} must be a list of {len(space.spaces)} parts")
        return tuple(convert_leaves(each, action[i], convert, f"{path}.{i}") for i, each in enumerate(space.spaces))
    return convert(space, action, path)
