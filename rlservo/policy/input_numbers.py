"""Callers' numbers as arrays: range checks, the slack at bounds, and errors for values that are not numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import LeafSpec, element_label
from rlservo.errors import RequestError, RlservoError

NUMBER_KINDS = "fiub"  # numpy dtype kinds: float, int, unsigned, bool (a flag such as in_collision is 0 or 1)
LISTED = 8  # names listed in a message before "and N more"
RELATIVE_SLACK = 1e-5  # of the bound, or of 1 if that is larger


def rounding_slack(low: NDArray[Any], high: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[np.float64]:
    """Return the distance by which float32 rounding may move a value of [low, high] outside; 0 for integers."""
    if dtype.kind != "f":
        return np.zeros(low.shape)
    slack: NDArray[np.float64] = RELATIVE_SLACK * np.maximum(1.0, np.minimum(np.abs(low), np.abs(high)))
    return slack


def first_element(space: LeafSpec, bad: NDArray[np.bool_]) -> tuple[str, tuple[int, ...]]:
    """Return (label, index) of the first element for which `bad` `[batch, *shape]` is true."""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    flat = int(np.ravel_multi_index(index[1:], space.shape)) if space.shape else 0
    return element_label(space, flat), index


def to_array(given: Any) -> NDArray[Any]:
    """Return numbers from nested lists as an array; integers stay exact if one dtype holds all of them.

    Numpy turns an integer of 2**63 or more into a float if smaller ones are present. Raises numpy's error for lists of
    unequal length.
    """
    array = np.asarray(given)
    if (
        array.dtype == np.float64
        and array.size
        and not isinstance(given, np.ndarray)
        and np.max(np.abs(array)) >= 2**53
    ):
        leaves = np.asarray(given, object)
        if all(isinstance(leaf, int) and leaf >= 0 for leaf in leaves.flat):
            return leaves.astype(np.uint64)
    return array


def find_unfit(array: NDArray[Any], dtype: np.dtype[Any]) -> tuple[NDArray[np.bool_], str] | None:
    """Return (mask of the numbers that an integer or bool `dtype` cannot hold, reason); None if it holds all of them.

    A float so large that it stands for several integers is unfit: the client may have meant another one.
    """
    if array.dtype.kind == "b":  # every dtype holds 0 and 1, and numpy compares flags with no integer of 2**63 or more
        return None
    info = np.iinfo(dtype) if dtype.kind in "iu" else None
    low, high = (int(info.min), int(info.max)) if info is not None else (0, 1)
    is_float, name = array.dtype.kind == "f", array.dtype.name
    digits = np.finfo(array.dtype).nmant + 1 if is_float else 0
    if is_float:
        array = array.astype(np.float64)  # float16 cannot represent the bounds
    unfit = np.asarray((array < low) | (array > high))  # exact for integers; large floats are checked below
    if is_float:
        unfit |= ~np.isfinite(array) | (array != np.floor(array))
    if unfit.any():
        return unfit, f"not an integer in {low}..{high} ({dtype})"
    if is_float and (unfit := np.asarray(np.abs(array) >= 2.0**digits)).any():
        return unfit, f"a {name} of 2**{digits} or more, which stands for several integers"
    return None


def parse_array(
    given: Any, dtype: str | np.dtype[Any], what: str, kind: type[RlservoError] = RequestError
) -> NDArray[Any]:
    """Return a caller's numbers as an array, infinite if they are too large for it. Raises `kind`."""
    try:
        array = to_array(given)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise kind(f"{what} cannot be read: its lists differ in length") from error
    if array.dtype.kind not in NUMBER_KINDS:
        found = first_non_number(given, ())
        value = describe(found[1]) if found is not None else f"of dtype {array.dtype}"
        raise kind(f"{what} cannot be read: it holds {value}, not numbers")
    target = np.dtype(dtype)
    unfit = find_unfit(array, target) if target.kind in "iub" else None
    if unfit is not None:
        raise kind(f"{what} cannot be read: {array[unfit[0]].flat[0]} is {unfit[1]}")
    with np.errstate(over="ignore"):
        return array.astype(target, copy=False)


def first_non_number(value: Any, where: tuple[int, ...]) -> tuple[tuple[int, ...], Any] | None:
    """Return the path and value of the first leaf that an array of numbers cannot hold."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        if len(where) > 32:  # numpy itself stops at 64 axes
            return where, value
        types = set(map(type, value))  # for a long list in a fraction of a loop's time
        if types <= {bool, float} or (types <= {bool, int} and min(value) >= -(2**63) and max(value) < 2**64):
            return None
        for index, item in enumerate(value):
            found = first_non_number(item, (*where, index))
            if found is not None:
                return found
        return None
    if isinstance(value, bool | float | np.number | np.bool_):
        return None
    if isinstance(value, int) and -(2**63) <= value < 2**64:
        return None
    return where, value


def describe_unequal(lists: Sequence[Any]) -> str:
    """Describe the list that differs from the first one."""

    def form(value: Any) -> tuple[int, ...] | None:
        try:
            return tuple(np.shape(value))
        except (ValueError, TypeError, OverflowError, RecursionError):
            return None

    first = form(lists[0])
    for index, one in enumerate(lists):
        found = form(one)
        if found is None or found != first:
            shape = "has lists of different lengths" if found is None else f"has shape {found}"
            return f"its parts differ in length: observation {index} of the batch {shape}, but the first has {first}"
    return "its lists differ in length"


def describe(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, str):
        return f"the string {value[:32]!r}{'...' if len(value) > 32 else ''}"
    if isinstance(value, Mapping):
        return "a map"
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return "an integer with more than 64 bits"
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def list_names(names: list[str]) -> str:
    shown = ", ".join(repr(name[:64]) for name in names[:LISTED])
    return shown if len(names) <= LISTED else f"{shown} and {len(names) - LISTED} more"
