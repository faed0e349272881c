"""Number of observations in a request, before anything is computed of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlservo.export.contract.spaces import DictSpec, SpaceSpec, TupleSpec


def most_rows(obs: Any) -> int:
    """Return how many observations there are at most, whatever the space is: `count_rows` looks closer."""
    most, parts = 0, [obs]
    while parts:
        part = parts.pop()
        if type(part) is dict:
            parts += part.values()
        else:
            most = max(most, _length(part))
            if type(part) in (list, tuple) and part and type(part[0]) in (dict, list, tuple, np.ndarray):
                parts.append(part[0])  # the parts of a Tuple are of one batch
    return most


def count_rows(space: SpaceSpec, obs: Any) -> int:
    """Return how many observations a large `obs` holds; an array as long as the space's own is one."""
    if isinstance(space, DictSpec | TupleSpec):
        if isinstance(space, DictSpec) and type(obs) is list:
            return len(obs)  # of single observations
        inside = space.spaces.items() if isinstance(space, DictSpec) else enumerate(space.spaces)
        parts = obs if type(obs) in (dict, list, tuple) else {}
        found: dict[Any, Any] = dict(parts) if type(parts) is dict else dict(enumerate(parts))
        return max((count_rows(child, found[key]) for key, child in inside if key in found), default=0)
    if type(obs) is dict:  # element names and values
        return max((_length(value) for value in obs.values()), default=0)
    rows = _length(obs)
    return rows if rows != (space.shape or (0,))[0] else 1


def _length(value: Any) -> int:
    if type(value) is np.ndarray:
        return len(value) if value.ndim else 0
    return len(value) if type(value) in (list, tuple) else 0
