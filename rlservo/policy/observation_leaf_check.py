"""Checks of one array of an observation: shape, dtype, finite numbers, names, bounds.

It arrives as an array, as nested lists from JSON, or as a map from element name to value, alone or as a batch. Checks
are strict where a robot could be damaged: a wrong shape, dtype, number or name is an error, never a guess. A Box
observation outside the space's bounds is treated as the policy's options say: RLlib's own pipeline also computes an
action for it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from operator import ge, itemgetter, le
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import BoxSpec, LeafSpec
from rlservo.errors import ObservationError, first_line
from rlservo.policy.drift import EVERY, Drift
from rlservo.policy.input_numbers import (
    NUMBER_KINDS,
    describe,
    describe_unequal,
    find_unfit,
    first_element,
    first_non_number,
    list_names,
    rounding_slack,
    to_array,
)
from rlservo.policy.options import DEFAULT_OPTIONS, PolicyOptions

SMALL = 128  # elements up to which Python's own sum is faster than numpy's isfinite(...).all()
NUMBERS = frozenset({float, int, bool})  # types that `struct` reads exactly
LARGE = 2.0**53  # beyond it floats cannot represent every integer; numpy picks one
PACKED = {"float32": "f", "float64": "d"}


class LeafParser:
    """Parses one array of a policy's observations: the whole observation, or the leaf `name` of a nested one."""

    def __init__(
        self,
        policy: str,
        space: LeafSpec,
        name: str = "obs",
        *,
        options: PolicyOptions = DEFAULT_OPTIONS,
        drift: Drift | None = None,
    ) -> None:
        """`drift` gets one in `EVERY` arrays that pass the checks, before clipping."""
        self._policy = policy
        self._name = name
        self._space = space
        self._shape = space.shape
        self._one = (1, *self._shape)
        self._ndim = len(self._shape)
        self._dtype = np.dtype(space.dtype)
        self._is_float = self._dtype.kind == "f"
        # For a choice that does not exist RLlib raises an error or gives an empty one-hot; a Box may be exceeded.
        self._choices = None if isinstance(space, BoxSpec) else space.bounds()
        self._out_of_bounds = options.out_of_bounds
        self._bounded = isinstance(space, BoxSpec) and self._set_bounds(space)
        self._names = tuple(element.name for element in space.elements)
        self._drift = drift
        self._until_drift = 1  # observations until the next one that `drift` gets
        # The usual observation, a list of numbers, is converted in a fraction of numpy's time.
        packs = self._ndim == 1 and space.size <= SMALL and space.dtype in PACKED
        self._packer = struct.Struct(f"{space.size}{PACKED[space.dtype]}") if packs else None
        self._named = bool(self._names) and len(set(self._names)) == len(self._names)

    def parse(self, obs: Any) -> tuple[NDArray[Any], bool, str]:
        """Return (`[batch, *shape]` of the graph's dtype, whether `obs` was a batch, notice).

        The notice is a sentence about values that are out of bounds and used anyway, usually empty. Raises
        ObservationError.
        """
        numbers = self.pack(obs) if type(obs) is list else None
        array, values, batch = self._read(obs) if numbers is None else (*numbers, False)
        if self._drift is not None:
            self._until_drift -= 1
            if not self._until_drift:
                self._until_drift = EVERY
                self._drift.add(array)
        if self._bounded:
            if values is not None and len(array) == 1:
                checked = self._pick(values)
                if all(map(le, self._lows, checked)) and all(map(ge, self._highs, checked)):
                    return array, batch, ""
            array, notice = self._keep_bounds(array)
            return array, batch, notice
        return array, batch, ""

    def pack(self, obs: list[Any]) -> tuple[NDArray[Any], list[float]] | None:
        """Return (array, its numbers) of a list of finite numbers; None for anything else, which `_read` handles."""
        if self._packer is None or not NUMBERS.issuperset(map(type, obs)):
            return None
        array: NDArray[Any] = np.empty(self._one, self._dtype)
        try:
            self._packer.pack_into(array.data, 0, *obs)
        except (struct.error, OverflowError):  # too many or too few, or too large for a float
            return None
        values: list[float] = array.ravel().tolist()
        return (array, values) if sum(map(abs, values)) < LARGE else None

    def _read(self, obs: Any) -> tuple[NDArray[Any], list[float] | None, bool]:
        """Return (array, its numbers if they are few, whether `obs` was a batch), checked except for its bounds."""
        array: NDArray[Any]
        if type(obs) is np.ndarray:
            array = obs
        elif isinstance(obs, Mapping):
            array = self._from_names(obs)
        else:
            array = self._from_nested(obs)
        if array.shape == self._shape:
            batch = False
            array = array.reshape(self._one)
        elif array.ndim == self._ndim + 1 and array.shape[1:] == self._shape and len(array) > 0:
            batch = True
        else:
            if array.dtype.kind not in NUMBER_KINDS:
                self._refuse_values(array, array)
            self._refuse_shape(array.shape)
        if array.dtype is not self._dtype and array.dtype != self._dtype:
            array = self._cast(array)
        values: list[float] | None = array.ravel().tolist() if array.size <= SMALL else None
        if self._is_float:
            # One not-a-number or infinity makes the sum one. If the sum merely overflows, every element is checked.
            if values is None or not math.isfinite(sum(values)):
                self._check_finite(array)
        elif self._choices is not None:
            self._check_range(array, *self._choices)
        return array, values, batch

    def _set_bounds(self, space: BoxSpec) -> bool:
        """Set the bounds with their slack; return whether any have to be checked."""
        low, high = space.bounds()
        if self._dtype.kind in "iu":  # an image's 0..255 is its dtype's own range
            info = np.iinfo(self._dtype)
            checked = bool((low > info.min).any() or (high < info.max).any())
        else:
            checked = bool(np.isfinite(low).any() or np.isfinite(high).any())
        slack = rounding_slack(low, high, self._dtype)
        self._low, self._high = low, high
        self._loosest = (low - slack, high + slack)
        # The bounded elements, for the single observation that a control loop sends.
        bounded = np.flatnonzero(np.isfinite(low.ravel()) | np.isfinite(high.ravel())).tolist()
        self._lows: list[float] = self._loosest[0].ravel()[bounded].tolist()
        self._highs: list[float] = self._loosest[1].ravel()[bounded].tolist()
        # itemgetter of a single index returns no tuple; repeating it is harmless, since map stops at the shortest.
        self._pick: Callable[[list[float]], Sequence[float]] = itemgetter(*bounded, *bounded[:1]) if bounded else tuple
        return checked and self._out_of_bounds != "accept"

    def _keep_bounds(self, array: NDArray[Any]) -> tuple[NDArray[Any], str]:
        """Handle values outside the bounds as the options require; return (the array to use, notice)."""
        outside = np.asarray((array < self._loosest[0]) | (array > self._loosest[1]))
        if not outside.any():
            return array, ""
        label, index = self._first(array, outside)
        low, high = self._low[index[1:]], self._high[index[1:]]
        if self._out_of_bounds == "refuse":
            self._refuse_element(array, outside, f"outside the observation space's [{low:g}, {high:g}]")
        count = int(np.count_nonzero(outside))
        more = f" and {count - 1} more" if count > 1 else ""
        of = "" if self._name == "obs" else f" of {self._name}"
        notice = f"element {label}{of}{more} outside the observation space's [{low:g}, {high:g}]"
        if self._out_of_bounds == "clip":
            clipped = np.clip(array, self._low, self._high).astype(self._dtype)
            return np.where(outside, clipped, array), f"{notice}: clipped"  # the others keep all their digits
        return array, notice

    def _from_nested(self, obs: Any) -> NDArray[Any]:
        try:
            array = to_array(obs)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            self._refuse(describe_unequal(obs) if isinstance(obs, list | tuple) else first_line(error))
        if array.dtype.kind not in NUMBER_KINDS:
            self._refuse_values(obs, array)
        return array

    def _from_names(self, obs: Mapping[str, Any]) -> NDArray[Any]:
        if not self._named:
            self._refuse("it is a map, but the policy's contract names no elements: send a list")
        try:
            values = [obs[name] for name in self._names]
        except KeyError:
            self._refuse_names(obs)
        if len(obs) != len(values):
            self._refuse_names(obs)
        for name, value in zip(self._names, values, strict=True):
            if isinstance(value, str | bytes | Mapping) or value is None:
                self._refuse(f"element '{name}' is {describe(value)}, not a number")
        try:
            array = to_array(values)
        except (ValueError, TypeError, OverflowError, RecursionError):
            self._refuse("its named values must all be single numbers, or all lists of one length (a batch)")
        if array.dtype.kind not in NUMBER_KINDS:
            self._refuse_values(values, array)
        if array.ndim == 1:
            return array.reshape(self._shape)
        if array.ndim == 2:  # one list per name: a batch
            batch: NDArray[Any] = array.T.reshape((array.shape[1], *self._shape))
            return batch
        return self._refuse("each named value must be a number, or a list of numbers (a batch)")

    def _cast(self, array: NDArray[Any]) -> NDArray[Any]:
        if array.dtype.kind not in NUMBER_KINDS:
            self._refuse_values(array, array)
        if self._is_float:
            with np.errstate(over="ignore", invalid="ignore"):  # the overflow becomes an infinity and is refused below
                cast = array.astype(self._dtype)
            if array.size > SMALL or not math.isfinite(sum(cast.ravel().tolist())):
                self._check_finite(cast, sent=array)
            return cast
        unfit = find_unfit(array, self._dtype)
        if unfit is not None:
            self._refuse_element(array, *unfit)
        return array.astype(self._dtype)

    def _check_finite(self, array: NDArray[Any], *, sent: NDArray[Any] | None = None) -> None:
        finite = np.isfinite(array)
        if finite.all():
            return
        if sent is not None and np.isfinite(sent).all():
            self._refuse_element(sent, ~finite, f"too large for {self._dtype}")
        self._refuse_element(array, ~finite, "not a finite number")

    def _check_range(self, array: NDArray[Any], low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        outside = np.asarray((array < low) | (array > high))
        if outside.any():
            where = first_element(self._space, outside)[1][1:]
            span = f"{int(low[where])}..{int(high[where])}"
            self._refuse_element(array, outside, f"outside the observation space's {span}")

    def _refuse_shape(self, shape: tuple[int, ...]) -> NoReturn:
        message = f"policy '{self._policy}' expects {self._name} of shape {self._shape}, got {shape}"
        if len(shape) == self._ndim + 1 and shape[1:] == self._shape:
            message = f"policy '{self._policy}' got an empty batch: send at least one observation of {self._shape}"
        elif shape == (1, *self._one):
            message += f"; a batch is of shape (B, {', '.join(map(str, self._shape))})"
        raise ObservationError(
            message, {"policy": self._policy, "expected_shape": list(self._shape), "shape": list(shape)}
        )

    def _refuse_values(self, obs: Any, array: NDArray[Any]) -> NoReturn:
        """Raise ObservationError for the first element that is not a number in an array of strings or objects."""
        path = first_non_number(obs, ())
        if path is None:
            self._refuse(f"it holds {array.dtype} values, not numbers")
        where, value = path
        index = where[-1] if where else None
        label = ", ".join(map(str, where))
        if self._ndim == 1 and isinstance(index, int) and index < len(self._names):
            label += f" ({self._names[index]})"
        what = f"element {label}" if where else "it"
        raise ObservationError(
            f"policy '{self._policy}' cannot read {self._name}: {what} is {describe(value)}, not a number",
            {"policy": self._policy, "index": list(where)},
        )

    def _refuse_names(self, obs: Mapping[str, Any]) -> NoReturn:
        known = set(self._names)
        missing = [name for name in self._names if name not in obs]
        unknown = [str(name) for name in obs if name not in known]
        parts = [f"missing {list_names(missing)}"] if missing else []
        parts += [f"unknown {list_names(unknown)}"] if unknown else []
        raise ObservationError(
            f"policy '{self._policy}' expects {len(self._names)} named elements: {'; '.join(parts)}",
            {"policy": self._policy, "missing": missing[:100], "unknown": [name[:64] for name in unknown[:100]]},
        )

    def _refuse_element(self, array: NDArray[Any], bad: NDArray[np.bool_], why: str) -> NoReturn:
        """Raise ObservationError for the first element of the batch `array` where `bad` is true."""
        label, index = self._first(array, bad)
        value = array[index]
        raise ObservationError(
            f"policy '{self._policy}' cannot use {self._name}: element {label} is {value}, {why}",
            {"policy": self._policy, "index": list(index), "value": str(value)},
        )

    def _first(self, array: NDArray[Any], bad: NDArray[np.bool_]) -> tuple[str, tuple[int, ...]]:
        """Return (label of the first bad element, its place in the batch)."""
        label, index = first_element(self._space, bad)
        return f"{label} of observation {index[0]}" if len(array) > 1 else label, index

    def _refuse(self, why: str) -> NoReturn:
        raise ObservationError(
            f"policy '{self._policy}' cannot read {self._name}: {why} (expected numbers of shape {self._shape})",
            {"policy": self._policy, "expected_shape": list(self._shape)},
        )
