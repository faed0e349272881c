"""Last check of an action before it leaves for a robot: finite, and inside the action space."""

from __future__ import annotations

from operator import ge, le
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import LeafSpec
from rlservo.errors import ActionError
from rlservo.policy.input_numbers import first_element, rounding_slack

SMALL_ACTION = 32  # elements up to which a Python loop checks bounds faster than numpy


class ActionCheck:
    """Checks the actions of one leaf, `action` or `action.<path>`."""

    def __init__(self, policy: str, name: str, space: LeafSpec) -> None:
        self._policy = policy
        self._name = name
        self._space = space
        self._dtype = np.dtype(space.dtype)
        low, high = space.bounds()
        if self._dtype.kind == "f":  # the largest finite number stands for unbounded, so infinity is outside too
            largest = float(np.finfo(self._dtype).max)
            low, high = np.maximum(low, -largest), np.minimum(high, largest)
        self._low, self._high = low, high
        self._small_bounds: tuple[list[float], list[float]] | None = None
        if space.size <= SMALL_ACTION:
            self._small_bounds = (low.ravel().tolist(), high.ravel().tolist())

    def check(self, action: NDArray[Any]) -> None:
        """Raise ActionError unless `action` `[batch, *shape]` is in the space; rounding errors are clipped in place."""
        if self._small_bounds is not None and len(action) == 1:
            values = action.ravel().tolist()
            low, high = self._small_bounds
            if all(map(le, low, values)) and all(map(ge, high, values)):  # written so that not-a-number fails
                return
        elif ((action >= self._low) & (action <= self._high)).all():
            return
        self._clip_or_refuse(action)

    def _clip_or_refuse(self, action: NDArray[Any]) -> None:
        slack = rounding_slack(
            self._low, self._high, self._dtype
        )  # unsquash may leave values outside the space: they are clipped
        bad = ~((action >= self._low - slack) & (action <= self._high + slack))
        if bad.any():
            label, index = first_element(self._space, bad)
            low, high = self._low[index[1:]], self._high[index[1:]]
            value = action[index]
            why = f"not in [{low:g}, {high:g}]" if np.isfinite(value) else "not a finite number"
            of = "" if self._name == "action" else f" of {self._name}"
            raise ActionError(
                f"policy '{self._policy}' computed an action that must not reach a robot: "
                f"element {label}{of} is {value}, {why}",
                {"policy": self._policy, "index": list(index), "value": str(value)},
            )
        np.clip(action, self._low.astype(self._dtype), self._high.astype(self._dtype), out=action)
