"""Sentences on what in an observation is no number, of unequal length, missing or unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

LISTED = 8  # names listed in a message before "and N more"


def first_non_number(value: Any, where: tuple[int, ...]) -> tuple[tuple[int, ...], Any] | None:
    """Return the path and value of the first leaf that is no number an array can hold."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        if len(where) > 32:  # numpy itself stops at 64 axes
            return where, value
        types = set(map(type, value))  # of a long list in a fraction of the time that a loop takes
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
    """Say which of the lists is not like the first one."""

    def form(value: Any) -> tuple[int, ...] | None:
        try:
            return tuple(np.shape(value))
        except (ValueError, TypeError, OverflowError, RecursionError):
            return None

    first = form(lists[0])
    for index, one in enumerate(lists):
        found = form(one)
        if found is None or found != first:
            shape = "has lists that are not of equal length" if found is None else f"is of shape {found}"
            return (
                f"its parts are not of equal length: observation {index} of the batch {shape}, the first is of {first}"
            )
    return "its lists are not of equal length"


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
        return "an integer of more than 64 bits"
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def list_names(names: list[str]) -> str:
    shown = ", ".join(repr(name[:64]) for name in names[:LISTED])
    return shown if len(names) <= LISTED else f"{shown} and {len(names) - LISTED} more"
