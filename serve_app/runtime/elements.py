"""Elements of a space's arrays: their labels, the slack at their bounds, and callers' numbers read as them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import RequestError
from rlservo.export.contract.spaces import LeafSpec, iter_elements

RELATIVE_SLACK = 1e-5  # of the bound, or of 1 where that is larger


def rounding_slack(low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.float64]:
    """Return by how much a value in [low, high] may lie outside after rounding to float32."""
    slack: NDArray[np.float64] = RELATIVE_SLACK * np.maximum(1.0, np.minimum(np.abs(low), np.abs(high)))
    return slack


def first_element(space: LeafSpec, bad: NDArray[np.bool_]) -> tuple[str, tuple[int, ...]]:
    """Return (label, index) of the first element for which `bad` `[batch, *shape]` is true."""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    flat = int(np.ravel_multi_index(index[1:], space.shape)) if space.shape else 0
    return dict(iter_elements(space))[flat], index


def parse_array(given: Any, dtype: str, what: str) -> NDArray[Any]:
    """Return a caller's numbers as an array, infinite where they are too large for it. Raises RequestError."""
    try:
        with np.errstate(over="ignore"):
            return np.asarray(given, dtype)
    except (ValueError, TypeError, OverflowError) as error:
        raise RequestError(f"{what} cannot be read: {error}") from error
