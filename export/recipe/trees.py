"""Nested observations, actions and states as named leaves: `obs`, or `obs.<path>` for Dict and Tuple spaces.

A tree is a leaf, a dict of trees or a tuple of trees. Leaves are listed in sorted order of their keys, as dm-tree has
them and RLlib therefore flattens them, whatever order the space was written in. A tree's own dicts keep the space's
order, in which Gymnasium's vector environments give them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from gymnasium import spaces

from rlservo.errors import UnsupportedError

Tree: TypeAlias = Any
"""A leaf, a dict of trees or a tuple of trees."""


def children(space: Any) -> dict[Any, Any] | None:
    """Return the sub-spaces of a Dict or Tuple by key or index, in RLlib's order; None for any other space."""
    if isinstance(space, spaces.Dict):
        if not all(isinstance(key, str) for key in space.spaces):
            raise UnsupportedError(f"{space} has keys that are not strings: a graph's inputs need names")
        return {key: space.spaces[key] for key in sorted(space.spaces)}
    if isinstance(space, spaces.Tuple):
        return dict(enumerate(space.spaces))
    return None


def is_nested(space: Any) -> bool:
    """Return whether the space has several arrays."""
    return isinstance(space, spaces.Dict | spaces.Tuple)


def space_leaves(space: Any, name: str) -> dict[str, Any]:
    """Return every leaf space by its name, `name` itself or `name.<path>`, in RLlib's order.

    Raises UnsupportedError when two leaves would have the same name ('a.b' beside 'a' that holds 'b').
    """
    named: dict[str, Any] = {}
    inside = children(space)
    if inside is None:
        return {name: space}
    for key, child in inside.items():
        for path, leaf in space_leaves(child, f"{name}.{key}").items():
            if path in named:
                raise UnsupportedError(f"two parts of {space} would both be called '{path}': rename one of them")
            named[path] = leaf
    return named


def tree_leaves(tree: Tree) -> list[Any]:
    """Return the leaves in RLlib's order."""
    if isinstance(tree, Mapping):
        return [leaf for key in sorted(tree) for leaf in tree_leaves(tree[key])]
    if isinstance(tree, tuple):
        return [leaf for child in tree for leaf in tree_leaves(child)]
    return [tree]


def named_leaves(tree: Tree, name: str) -> dict[str, Any]:
    """Return the leaves by name, as `space_leaves` names them."""
    if isinstance(tree, Mapping):
        return {k: v for key in sorted(tree) for k, v in named_leaves(tree[key], f"{name}.{key}").items()}
    if isinstance(tree, tuple):
        return {k: v for index, child in enumerate(tree) for k, v in named_leaves(child, f"{name}.{index}").items()}
    return {name: tree}


def build(space: Any, leaves: Sequence[Any]) -> Tree:
    """Return the tree of `space` with `leaves`, which come in RLlib's order, in its places."""
    rest = list(leaves)
    tree = _take(space, rest)
    assert not rest, "more leaves than the space has"
    return tree


def build_in_order(space: Any, named: Mapping[str, Any], name: str = "obs") -> Tree:
    """Return the tree of `space` with the leaves `named`, in whose order the keys of its dicts come."""
    inside = children(space)
    if inside is None:
        return named[name]
    places = {path: place for place, path in enumerate(named)}
    first = {key: min((places[path] for path in space_leaves(child, f"{name}.{key}")), default=0)
             for key, child in inside.items()}  # fmt: skip
    built = {key: build_in_order(inside[key], named, f"{name}.{key}") for key in sorted(first, key=first.__getitem__)}
    return built if isinstance(space, spaces.Dict) else tuple(built[index] for index in inside)


def build_like(tree: Tree, leaves: Sequence[Any]) -> Tree:
    """Return a tree of the shape of `tree` with other leaves."""
    rest = list(leaves)
    return _take_like(tree, rest)


def map_tree(function: Callable[[Any], Any], tree: Tree) -> Tree:
    """Return the tree with `function` applied to every leaf; dicts and tuples are new ones."""
    if isinstance(tree, Mapping):
        return {key: map_tree(function, child) for key, child in tree.items()}
    if isinstance(tree, tuple):
        return tuple(map_tree(function, child) for child in tree)
    return function(tree)


def _take(space: Any, rest: list[Any]) -> Tree:
    inside = children(space)
    if inside is None:
        return rest.pop(0)
    built = {key: _take(child, rest) for key, child in inside.items()}
    return {key: built[key] for key in space.spaces} if isinstance(space, spaces.Dict) else tuple(built.values())


def _take_like(tree: Tree, rest: list[Any]) -> Tree:
    if isinstance(tree, Mapping):
        built = {key: _take_like(tree[key], rest) for key in sorted(tree)}
        return {key: built[key] for key in tree}
    if isinstance(tree, tuple):
        return tuple(_take_like(child, rest) for child in tree)
    return rest.pop(0)
