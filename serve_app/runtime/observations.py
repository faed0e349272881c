"""Observations of callers as arrays for the graph, checked: shape, dtype, finite numbers, names.

An observation arrives as an array, as nested lists out of JSON, or as a map from element name to value, alone or as a
batch. `LeafParser` turns each into `[batch, ...]` of the graph's dtype. Strict where a robot could be hurt:
shape, dtype, non-finite numbers and names are errors, never guesses.

What happens to a Box observation outside the space's bounds is the policy's options' affair: RLlib's own pipeline
computes an action for it, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import ge, itemgetter, le
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import ObservationError, first_line
from rlservo.export.contract.spaces import BoxSpec, DictSpec, LeafSpec, SpaceSpec, TupleSpec, iter_elements, leaf_specs
from rlservo.serve_app.runtime.drift import EVERY, Drift
from rlservo.serve_app.runtime.options import DEFAULT_OPTIONS, PolicyOptions

NUMBER_KINDS = "fiub"  # numpy dtype kinds: float, int, unsigned, bool (a flag such as in_collision is 0 or 1)
SMALL = 128  # elements up to which Python's own sum is faster than numpy's isfinite(...).all()
BOUND_SLACK = 1e-5  # relative to the bound: what rounding to float32 may put outside of it
MOST_NOTICES = 16  # of a list of observations: its reply carries them
LISTED = 8  # names listed in a message before "and N more"


class LeafParser:
    """Parses one array of a policy's observations: the whole of it, or the leaf `name` of a nested one."""

    def __init__(
        self,
        policy: str,
        space: LeafSpec,
        name: str = "obs",
        *,
        options: PolicyOptions = DEFAULT_OPTIONS,
        drift: Drift | None = None,
    ) -> None:
        """`drift` gets one in `EVERY` of the arrays that passed the checks, before it is clipped."""
        self._policy = policy
        self._name = name
        self._space = space
        self._shape = space.shape
        self._one = (1, *self._shape)
        self._ndim = len(self._shape)
        self._dtype = np.dtype(space.dtype)
        self._is_float = self._dtype.kind == "f"
        # Of a choice that does not exist RLlib makes an error or a one-hot of nothing; a Box may be left.
        self._choices = None if isinstance(space, BoxSpec) else space.bounds()
        self._out_of_bounds = options.out_of_bounds
        self._bounded = isinstance(space, BoxSpec) and self._take_bounds(space)
        self._names = tuple(element.name for element in space.elements)
        self._drift = drift
        self._until_drift = 1  # observations until the next one that is counted in
        self._named = bool(self._names) and len(set(self._names)) == len(self._names)

    def parse(self, obs: Any) -> tuple[NDArray[Any], bool, str]:
        """Return (`[batch, *shape]` of the graph's dtype, whether `obs` was a batch, notice).

        The notice is a sentence on what is out of bounds and used all the same, mostly empty. Raises ObservationError.
        """
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
            # One not-a-number or infinity makes the sum one. A sum that merely overflows is looked at again.
            if values is None or not math.isfinite(sum(values)):
                self._check_finite(array)
        elif self._choices is not None:
            self._check_range(array, *self._choices)
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

    def _take_bounds(self, space: BoxSpec) -> bool:
        """Remember the bounds with their slack; return whether there is anything to check."""
        low, high = space.bounds()
        if self._dtype.kind in "iu":  # integers round nothing, and an image's 0..255 is its dtype's own range
            info = np.iinfo(self._dtype)
            checked = bool((low > info.min).any() or (high < info.max).any())
            slack: Any = 0.0
        else:
            checked = bool(np.isfinite(low).any() or np.isfinite(high).any())
            slack = BOUND_SLACK * np.maximum(1.0, np.minimum(np.abs(low), np.abs(high)))
        self._low, self._high = low, high
        self._loosest = (low - slack, high + slack)
        # The elements that have a bound, for the one observation that a control loop sends at a time.
        bounded = np.flatnonzero(np.isfinite(low.ravel()) | np.isfinite(high.ravel())).tolist()
        self._lows: list[float] = self._loosest[0].ravel()[bounded].tolist()
        self._highs: list[float] = self._loosest[1].ravel()[bounded].tolist()
        # itemgetter of a single index gives no tuple; repeating it does no harm, since map stops at the shortest.
        self._pick: Callable[[list[float]], Sequence[float]] = itemgetter(*bounded, *bounded[:1]) if bounded else tuple
        return checked and self._out_of_bounds != "accept"

    def _keep_bounds(self, array: NDArray[Any]) -> tuple[NDArray[Any], str]:
        """Do with what is outside the bounds as the options say; return (the array to use, notice)."""
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
            return np.clip(array, self._low, self._high).astype(self._dtype), f"{notice}: clipped"
        return array, notice

    # How each form becomes an array.

    def _from_nested(self, obs: Any) -> NDArray[Any]:
        try:
            array = np.asarray(obs)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            self._refuse(_unequal(obs) if isinstance(obs, list | tuple) else first_line(error))
        if array.dtype.kind not in NUMBER_KINDS:
            self._refuse_values(obs, array)
        return array

    def _from_names(self, obs: Mapping[str, Any]) -> NDArray[Any]:
        if not self._named:
            self._refuse("it is a map from names to values, but the policy's contract names no elements: send a list")
        try:
            values = [obs[name] for name in self._names]
        except KeyError:
            self._refuse_names(obs)
        if len(obs) != len(values):
            self._refuse_names(obs)
        for name, value in zip(self._names, values, strict=True):
            if isinstance(value, str | bytes | Mapping) or value is None:
                self._refuse(f"element '{name}' is {_describe(value)}, not a number")
        try:
            array = np.asarray(values)
        except (ValueError, TypeError, OverflowError, RecursionError):
            self._refuse("its named values are not all single numbers, or all lists of one length (a batch)")
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
        if array.dtype.kind == "f":
            with np.errstate(invalid="ignore"):
                whole = np.asarray(np.isfinite(array) & (array == np.floor(array)))
            if not whole.all():
                self._refuse_element(array, ~whole, f"not a whole number (the space is {self._dtype})")
        info = np.iinfo(self._dtype) if self._dtype.kind in "iu" else None
        low, high = (int(info.min), int(info.max)) if info is not None else (0, 1)
        # Compared as float64 or int64: numpy would otherwise wrap 300 to 44 in uint8 without a word.
        outside = (array < low) | (array > high)
        if outside.any():
            self._refuse_element(array, outside, f"outside {low}..{high}, the range of {self._dtype}")
        return array.astype(self._dtype)

    # What is checked, and the sentences.

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
            where = tuple(int(i) for i in np.argwhere(outside)[0])[1:]
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
        """The array is of strings or objects: name the first element that is no number."""
        path = _first_non_number(obs, ())
        if path is None:
            self._refuse(f"it holds {array.dtype} values, not numbers")
        where, value = path
        index = where[-1] if where else None
        label = ", ".join(map(str, where))
        if self._ndim == 1 and isinstance(index, int) and index < len(self._names):
            label += f" ({self._names[index]})"
        what = f"element {label}" if where else "it"
        raise ObservationError(
            f"policy '{self._policy}' cannot read {self._name}: {what} is {_describe(value)}, not a number",
            {"policy": self._policy, "index": list(where)},
        )

    def _refuse_names(self, obs: Mapping[str, Any]) -> NoReturn:
        missing = [name for name in self._names if name not in obs]
        unknown = [str(name) for name in obs if name not in self._names]
        parts = [f"missing {_listed(missing)}"] if missing else []
        parts += [f"unknown {_listed(unknown)}"] if unknown else []
        raise ObservationError(
            f"policy '{self._policy}' expects {len(self._names)} named elements: {'; '.join(parts)}",
            {"policy": self._policy, "missing": missing[:100], "unknown": [name[:64] for name in unknown[:100]]},
        )

    def _refuse_element(self, array: NDArray[Any], bad: NDArray[np.bool_], why: str) -> NoReturn:
        """Name the first element of the batch `array` where `bad` is true."""
        label, index = self._first(array, bad)
        value = array[index]
        raise ObservationError(
            f"policy '{self._policy}' cannot use {self._name}: element {label} is {value}, {why}",
            {"policy": self._policy, "index": list(index), "value": str(value)},
        )

    def _first(self, array: NDArray[Any], bad: NDArray[np.bool_]) -> tuple[str, tuple[int, ...]]:
        """Return (what the first bad element is called, where it is in the batch)."""
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        flat = int(np.ravel_multi_index(index[1:], self._shape)) if self._shape else 0
        label = dict(iter_elements(self._space))[flat]
        return f"{label} of observation {index[0]}" if len(array) > 1 else label, index

    def _refuse(self, why: str) -> NoReturn:
        raise ObservationError(
            f"policy '{self._policy}' cannot read {self._name}: {why} (expected numbers of shape {self._shape})",
            {"policy": self._policy, "expected_shape": list(self._shape)},
        )


def _first_non_number(value: Any, where: tuple[int, ...]) -> tuple[tuple[int, ...], Any] | None:
    """Return the path and value of the first leaf that is no number an array can hold."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        if len(where) > 32:  # numpy itself stops at 64 axes
            return where, value
        for index, item in enumerate(value):
            found = _first_non_number(item, (*where, index))
            if found is not None:
                return found
        return None
    if isinstance(value, bool | float | np.number | np.bool_):
        return None
    if isinstance(value, int) and -(2**63) <= value < 2**64:
        return None
    return where, value


def _unequal(lists: Sequence[Any]) -> str:
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


def _describe(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, str):
        return f"the string {value[:32]!r}{'...' if len(value) > 32 else ''}"
    if isinstance(value, Mapping):
        return "a map"
    if isinstance(value, int):
        return "an integer of more than 64 bits"
    return f"a {type(value).__name__}"


def _listed(names: list[str]) -> str:
    shown = ", ".join(repr(name[:64]) for name in names[:LISTED])
    return shown if len(names) <= LISTED else f"{shown} and {len(names) - LISTED} more"


class Observed(NamedTuple):
    """A checked observation."""

    arrays: dict[str, NDArray[Any]]  # `[batch, ...]` by the graph's input names
    batch: bool  # whether it was given as a batch
    notices: tuple[str, ...]  # sentences on what is out of bounds and used all the same


class ObservationParser:
    """Parses observations of any space for one policy."""

    def __init__(
        self,
        policy: str,
        space: SpaceSpec,
        *,
        options: PolicyOptions = DEFAULT_OPTIONS,
        drift: Drift | None = None,
    ) -> None:
        """`drift` is of a space that is a single array."""
        self._policy = policy
        self._space = space
        self.leaves = {
            name: LeafParser(policy, leaf, name, options=options, drift=drift)
            for name, leaf in leaf_specs(space, "obs").items()
        }

    def parse(self, obs: Any) -> Observed:
        """Raise ObservationError, which names the path of what does not fit."""
        if isinstance(self._space, DictSpec) and isinstance(obs, list | tuple) and obs and isinstance(obs[0], Mapping):
            return self._parse_list(obs)
        leaves: dict[str, Any] = {}
        self._collect(self._space, obs, "obs", leaves)
        arrays: dict[str, NDArray[Any]] = {}
        sizes: dict[str, int | None] = {}
        notices: tuple[str, ...] = ()
        for name, parser in self.leaves.items():
            arrays[name], batch, notice = parser.parse(leaves[name])
            sizes[name] = len(arrays[name]) if batch else None
            if notice:
                notices += (notice,)
        if len(set(sizes.values())) > 1:
            told = ", ".join(
                f"{name} {'one' if size is None else f'a batch of {size}'}" for name, size in sizes.items()
            )
            self._refuse("obs", f"its parts are not of one batch ({told})")
        return Observed(arrays, next(iter(sizes.values())) is not None, notices)

    def _parse_list(self, observations: Sequence[Any]) -> Observed:
        rows: list[Observed] = []
        for index, one in enumerate(observations):
            try:
                row = self.parse(one)
            except ObservationError as error:
                raise ObservationError(f"observation {index}: {error.message}", error.details) from error
            if row.batch:
                self._refuse("obs", f"observation {index} of the list is a batch itself")
            rows.append(row)
        arrays = {name: np.concatenate([row.arrays[name] for row in rows]) for name in self.leaves}
        return Observed(arrays, True, tuple(notice for row in rows for notice in row.notices)[:MOST_NOTICES])

    def _collect(self, space: SpaceSpec, value: Any, path: str, leaves: dict[str, Any]) -> None:
        if isinstance(space, DictSpec):
            if not isinstance(value, Mapping):
                self._refuse(
                    path, f"expected a map with the keys {', '.join(sorted(space.spaces))}, got {_kind(value)}"
                )
            missing = sorted(set(space.spaces) - set(value))
            unknown = sorted(str(key) for key in value if key not in space.spaces)
            if missing or unknown:
                parts = [f"missing {', '.join(missing)}"] if missing else []
                parts += [f"unknown {', '.join(name[:64] for name in unknown[:8])}"] if unknown else []
                self._refuse(path, "; ".join(parts))
            for key, child in space.spaces.items():
                self._collect(child, value[key], f"{path}.{key}", leaves)
        elif isinstance(space, TupleSpec):
            if not isinstance(value, list | tuple) or len(value) != len(space.spaces):
                got = f"{len(value)} of them" if isinstance(value, list | tuple) else _kind(value)
                self._refuse(path, f"expected a list of its {len(space.spaces)} parts, got {got}")
            for index, child in enumerate(space.spaces):
                self._collect(child, value[index], f"{path}.{index}", leaves)
        else:
            leaves[path] = value

    def _refuse(self, path: str, why: str) -> NoReturn:
        raise ObservationError(f"policy '{self._policy}' cannot read {path}: {why}", {"policy": self._policy})


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return {"dict": "a map", "list": "a list", "str": "a string"}.get(type(value).__name__, f"a {type(value).__name__}")
