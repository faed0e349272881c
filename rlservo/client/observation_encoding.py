"""Observations encoded for sending: finite numbers, nested like the space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import SpaceSpec
from rlservo.client.replies import is_finite
from rlservo.errors import ObservationError
from rlservo.policy.acting_policy import Observation


def encode_observation(obs: Observation, contract: Contract) -> tuple[Any, tuple[int, ...]]:
    """Return (encoded observation, batch axis as () or (B,)); the server checks shapes and names."""
    space = contract.observation_space
    if not isinstance(obs, np.ndarray) and space.kind != "dict" and isinstance(obs, Mapping):  # by element name
        elements = {str(name): _finite_array(value, f"element {name!r}") for name, value in obs.items()}
        return elements, next((value.shape[:1] for value in elements.values()), ())
    return _encode_part(obs, space, "")


def _encode_part(obs: Any, space: SpaceSpec, path: str) -> tuple[Any, tuple[int, ...]]:
    if space.kind != "dict" and space.kind != "tuple":
        array = _finite_array(obs, f"part obs{path}" if path else "")
        return array, array.shape[:1] if array.ndim == len(space.shape) + 1 else ()
    inside = space.spaces.items() if space.kind == "dict" else enumerate(space.spaces)
    try:
        parts = {key: _encode_part(obs[key], child, f"{path}.{key}") for key, child in inside}
    except (KeyError, IndexError, TypeError) as error:
        raise ObservationError(f"the observation does not have the parts of obs{path}: {error!r}") from error
    plain = {key: part for key, (part, _) in parts.items()}
    batch = next((axis for _, axis in parts.values()), ())
    return (plain if space.kind == "dict" else list(plain.values())), batch


def _finite_array(value: ArrayLike, where: str) -> NDArray[Any]:
    """Return `value` as a contiguous array of finite numbers. Raises ObservationError, which names the element."""
    try:
        array = np.asarray(value, order="C")
    except ValueError as error:
        raise ObservationError(f"the observation is ragged: expected numbers in one shape ({error})") from error
    if array.dtype.kind not in "fiub":
        kind = type(value).__name__ if array.dtype.kind == "O" else array.dtype.name
        raise ObservationError(f"the observation{where and f', {where},'} holds {kind}, expected numbers")
    if not array.dtype.isnative:  # orjson only takes native byte order
        array = array.astype(array.dtype.newbyteorder("="))
    if not is_finite(array):
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        which = where or f"element {first[0] if len(first) == 1 else first}"
        raise ObservationError(
            f"the observation's {which} is {array[first]}: expected a finite number", {"element": list(first)}
        )
    return array
