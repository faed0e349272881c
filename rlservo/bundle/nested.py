"""Nested actions: between the space's own form (dicts and tuples) and the tensors `action.<path>`.

A Dict is a map with exactly its keys, a Tuple a list of exactly its length. A batch has a batch axis on every leaf, as
Gymnasium's vector environments give it; for a Dict, a list of single observations is also a batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlservo.bundle.spaces import DictSpec, SpaceSpec, TupleSpec
from rlservo.errors import RequestError


def build_action(space: SpaceSpec, leaves: Mapping[str, Any], path: str = "action") -> Any:
    """Return the action in the space's own form: dicts and tuples of its leaves, which come by tensor name."""
    if isinstance(space, DictSpec):
        return {key: build_action(child, leaves, f"{path}.{key}") for key, child in space.spaces.items()}
    if isinstance(space, TupleSpec):
        return tuple(build_action(child, leaves, f"{path}.{index}") for index, child in enumerate(space.spaces))
    return leaves[path]


def action_leaves(space: SpaceSpec, action: Any, path: str = "action") -> dict[str, Any]:
    """Return a nested action's leaves by tensor name: `build_action`, undone.

    Raises RequestError if it is not of the space's form.
    """
    if isinstance(space, DictSpec):
        if not isinstance(action, Mapping) or set(action) != set(space.spaces):
            raise RequestError(f"{path} must be a map with the keys {', '.join(sorted(space.spaces))}")
        parts = [action_leaves(child, action[key], f"{path}.{key}") for key, child in space.spaces.items()]
    elif isinstance(space, TupleSpec):
        if not isinstance(action, list | tuple) or len(action) != len(space.spaces):
            raise RequestError(f"{path} must be a list of {len(space.spaces)} parts")
        parts = [action_leaves(child, action[i], f"{path}.{i}") for i, child in enumerate(space.spaces)]
    else:
        return {path: action}
    return {name: leaf for part in parts for name, leaf in part.items()}
