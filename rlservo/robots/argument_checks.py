"""Checks of actions, resets and options: each refusal is a sentence that names the element.

robo-gym raises a bare InvalidActionError or InvalidStateError; these name the wrong element and by how much it is
wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray


class _Named(TypedDict):
    name: str
    unit: str


class ElementInfo(_Named, total=False):
    """One element of an observation or an action: name, unit ('1': dimensionless) and, where known, conventions.

    The contract's `Element` has the same fields, and describes them.
    """

    quantity: str
    joint: str
    axis: str
    frame: str
    scale: float
    offset: float


class EnvDescription(TypedDict):
    """Result of `Env.describe(**constructor_arguments)`, which builds no environment.

    The exporter writes it into the policy's contract; any environment may offer the same classmethod.
    """

    observation: list[ElementInfo]
    action: list[ElementInfo]
    control_rate_hz: float


class InvalidActionError(ValueError):
    """The action does not fit the action space."""


class InvalidResetError(ValueError):
    """A reset option is not possible."""


def check_action(action: ArrayLike, space: gym.spaces.Box, elements: Sequence[ElementInfo]) -> NDArray[np.float32]:
    """Return the action as float32, or raise InvalidActionError naming the element and its excess."""
    try:
        array = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InvalidActionError(f"the action is not an array of numbers: {error}") from error
    if array.shape != space.shape:
        names = ", ".join(element["name"] for element in elements)
        raise InvalidActionError(f"the action has shape {array.shape}, expected {space.shape}: {names}")
    # One comparison covers NaN as well: NaN is neither above low nor below high.
    inside = (array >= space.low) & (array <= space.high)
    if not inside.all():
        raise InvalidActionError(_outside(array, space, elements, int(np.argmin(inside))))
    return array


def _outside(array: NDArray[np.float32], space: gym.spaces.Box, elements: Sequence[ElementInfo], index: int) -> str:
    value, low, high = float(array[index]), float(space.low[index]), float(space.high[index])
    which = f"action element {index} ({elements[index]['name']}) is {value:g}"
    if not np.isfinite(value):
        return f"{which}: expected a finite number in [{low:g}, {high:g}]"
    excess = value - high if value > high else low - value
    return f"{which}, {excess:g} {'above' if value > high else 'below'} its range [{low:g}, {high:g}]"


def as_vector(name: str, value: Any, length: int) -> NDArray[np.float64]:
    """Return a reset option as `length` finite float64 numbers, or raise InvalidResetError."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidResetError(f"reset option {name!r} is not a list of numbers: {error}") from error
    if array.shape != (length,):
        raise InvalidResetError(f"reset option {name!r} has shape {array.shape}, expected ({length},)")
    if not np.isfinite(array).all():
        raise InvalidResetError(f"reset option {name!r}, element {int(np.argmin(np.isfinite(array)))} is not finite")
    return array


def parse_target(text: str, forms: Mapping[str, tuple[str, ...]]) -> tuple[str, NDArray[np.float64]]:
    """Return the frame and the numbers of a target 'FRAME:N,N,...'.

    `forms` has the numbers' names that each frame may have. Raises ValueError.
    """
    frame, _, rest = text.partition(":")
    try:
        numbers = np.array([float(part) for part in rest.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) not in [form.count(",") + 1 for form in forms.get(frame, ())] or not np.isfinite(numbers).all():
        names = ", ".join(f"{name}:{form}" for name, several in forms.items() for form in several)
        raise ValueError(f"target {text!r}: expected one of {names} [m, rad]")
    return frame, numbers


def check_option_names(options: dict[str, Any], names: Sequence[str]) -> None:
    """Raise InvalidResetError on a reset option that does not exist."""
    for name in options:
        if name not in names:
            raise InvalidResetError(f"reset option {name!r} does not exist: expected one of {', '.join(names)}")
