"""Limit on the step of each element of an action.

A network may answer a small change of its observation with a large change of its action, which a gearbox may not
survive. The caller remembers the last action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.spaces import BoxSpec, LeafSpec
from rlservo.errors import ActionError, RequestError, UsageError
from rlservo.policy.input_numbers import first_element, parse_array, rounding_slack
from rlservo.policy.options import PolicyOptions

ROUNDING = 1e-6  # relative to the step: rounding that float32 may add to an allowed step


class StepLimit:
    """The limits of one policy, by leaf of its action space (`action` or `action.<path>`)."""

    def __init__(self, policy: str, leaves: Mapping[str, LeafSpec], options: PolicyOptions) -> None:
        """Raise UsageError if the options do not fit the action space."""
        self._policy = policy
        self._leaves = leaves
        self._refuses = options.beyond_action_step == "refuse"
        given = options.max_action_step
        by_leaf = given if isinstance(given, dict) else {"action": given} if given is not None else {}
        self._steps = {name: self._parse_steps(name, steps) for name, steps in by_leaf.items()}

    def __bool__(self) -> bool:
        return bool(self._steps)

    def parse_last_action(self, last: Mapping[str, Any], rows: int, *, batch: bool) -> dict[str, NDArray[Any]]:
        """Return a caller's last action, by leaf, as `[batch, *shape]`.

        Raises RequestError unless it is an action of the space: a limit cannot be applied to anything else.
        """
        found: dict[str, NDArray[Any]] = {}
        for name, space in self._leaves.items():
            expected = (rows, *space.shape) if batch else space.shape
            array = parse_array(last[name], space.dtype, f"last_action of policy '{self._policy}'")
            if not space.shape and array.shape == (*expected, 1):  # the form that RLlib and the graph give it
                array = array.reshape(expected)
            low, high = space.bounds()
            slack = rounding_slack(low, high, array.dtype)
            if array.shape != expected:
                raise RequestError(
                    f"policy '{self._policy}' expects {name} of last_action of shape {expected}, got {array.shape}"
                )
            if not (np.isfinite(array) & (array >= low - slack) & (array <= high + slack)).all():
                raise RequestError(f"last_action of policy '{self._policy}': {name} is not in the action space")
            if array.dtype.kind == "f":
                array = np.clip(array, low, high).astype(space.dtype)
            found[name] = array.reshape(rows, *space.shape)
        return found

    def apply(
        self, action: dict[str, NDArray[Any]], last: Mapping[str, NDArray[Any]]
    ) -> tuple[dict[str, NDArray[Any]], tuple[str, ...]]:
        """Return (the action within its limits, a sentence for each leaf that was limited).

        Raises ActionError if the options refuse such a step instead.
        """
        notices: list[str] = []
        limited = dict(action)
        for name, steps in self._steps.items():
            before = last[name].reshape(action[name].shape)
            step = action[name].astype(np.float64) - before
            beyond = np.abs(step) > steps * (1 + ROUNDING)
            if not beyond.any():
                continue
            space = self._leaves[name]
            label, index = first_element(space, beyond)
            of = "" if name == "action" else f" of {name}"
            sentence = (
                f"element {label}{of} of the action would step by {step[index]:.6g}, at most "
                f"{np.broadcast_to(steps, space.shape)[index[1:]]:g} is allowed"
            )
            if self._refuses:
                raise ActionError(f"policy '{self._policy}': {sentence}", {"policy": self._policy})
            notices.append(f"{sentence}: limited")
            limited[name] = (before + np.clip(step, -steps, steps)).astype(action[name].dtype)
        return limited, tuple(notices)

    def _parse_steps(self, name: str, steps: Any) -> NDArray[np.float64]:
        space = self._leaves.get(name)
        if space is None:
            raise UsageError(
                f"max_action_step of policy '{self._policy}' names {name!r}: its action has {', '.join(self._leaves)}"
            )
        if not isinstance(space, BoxSpec) or np.dtype(space.dtype).kind != "f":
            raise UsageError(f"max_action_step of policy '{self._policy}': {name} is a choice, which has no step size")
        values = [np.inf if one is None else one for one in steps] if isinstance(steps, tuple) else [steps] * space.size
        if len(values) != space.size:
            raise UsageError(
                f"max_action_step of policy '{self._policy}' has {len(values)} numbers for {space.size} elements"
            )
        return np.array(values, np.float64).reshape(space.shape)
