"""Comparison of a policy's conventions with those of the robot or environment that it drives.

Both are lists of elements. What the two say differently is a contradiction. What a policy leaves open is missing only
where a wrong guess would move a robot wrongly: the order of a quaternion, the frame of a pose, the kind of a command.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from rlservo.bundle.spaces import Element

IN_A_FRAME = ("position", "quaternion", "direction", "linear velocity", "angular velocity", "gravity")
# SI units and others that a policy may have, as factors to SI.
UNITS = {
    "rad": 1.0, "deg": math.pi / 180.0, "rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0,
    "m": 1.0, "cm": 0.01, "mm": 0.001, "m/s": 1.0, "mm/s": 0.001,
}  # fmt: skip


def parse_elements(described: Any) -> tuple[Element, ...]:
    """Return the elements of one side of a `describe()`. Raises ValueError."""
    try:
        return tuple(Element(**one) for one in described)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"an element's '{where}': {first['msg']}, given {first['input']!r:.80}") from error
    except TypeError as error:
        raise ValueError(f"expected a list of {{'name', 'unit', ...}}, got {described!r:.80}") from error


def contradiction(
    ours: Sequence[Element], theirs: Sequence[Element], *, labels: bool = True
) -> tuple[str, str, str] | None:
    """Return the first contradiction: the element with a verb, our value, and theirs; None if there is none.

    Names count where nothing else tells which joint an element is of. Without `labels` they may differ, and units whose
    factor is not known.
    """
    for index, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
        where = f"element {index} ({other.name})"
        if "quaternion" in (mine.quantity, other.quantity) and mine.axis and other.axis and mine.axis != other.axis:
            first, last = _run(theirs, index)
            return f"elements {first} to {last - 1} are a quaternion", _order(ours, index), _order(theirs, index)
        for verb, here, there in (
            ("is a", _quantity(mine), _quantity(other)),
            ("is of", mine.joint, other.joint),
            ("is part", mine.axis, other.axis),
            ("is in frame", mine.frame, other.frame),
            ("has unit", mine.unit if labels or {mine.unit, other.unit} <= UNITS.keys() else "", other.unit),
            ("has scale", _number(_scale(mine)), _number(_scale(other))),
            ("has offset", _number(mine.offset), _number(other.offset)),
        ):
            if here and there and here != there:
                return f"{where} {verb}", here, there
    for index, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
        known = mine.quantity == "raw" or (mine.joint and other.joint and mine.quantity and other.quantity)
        if labels and mine.name != other.name and not known:
            return f"element {index} is", repr(mine.name), repr(other.name)
    return None


def missing(ours: Sequence[Element], theirs: Sequence[Element], *, is_action: bool) -> tuple[str, str]:
    """Return what the policy leaves open and a robot must know, as a clause, and the option that says it; '' if all.

    `ours` may be empty: a policy whose elements have no names.
    """
    for index, other in enumerate(theirs):
        mine = ours[index] if ours else Element(name="")
        where = f"element {index} ({mine.name or other.name})"
        quantity = other.quantity or mine.quantity
        if is_action and other.quantity and mine.quantity in (None, "raw"):
            return f"which command {where} is; the robot takes a {other.quantity}", "action"
        if quantity == "quaternion" and not mine.axis:
            order = _order(theirs, index)
            return f"the order of the quaternion that {where} is in; the robot's is {order}", "quaternion"
        if quantity in IN_A_FRAME and other.frame and not mine.frame:
            return f"the frame of {where}; the robot's is {other.frame}", "frame"
        if other.joint and not (mine.joint or mine.name):
            return f"the joint of {where}; the robot's is {other.joint}", ""
    return "", ""


def _quantity(element: Element) -> str:
    return "" if element.quantity in (None, "raw") else str(element.quantity)


def _scale(element: Element) -> float | None:
    return UNITS.get(element.unit) if element.scale is None else element.scale


def _number(value: float | None) -> str:
    return "" if value is None else f"{value + 0.0:.4g}"


def _order(elements: Sequence[Element], index: int) -> str:
    first, last = _run(elements, index)
    return ", ".join(element.axis or "?" for element in elements[first:last])


def _run(elements: Sequence[Element], index: int) -> tuple[int, int]:
    """Return the first of the four elements of the quaternion around `index`, and the one after its last."""
    first = index
    while first > 0 and elements[first - 1].quantity == "quaternion":
        first -= 1
    first += (index - first) // 4 * 4
    return first, min(first + 4, len(elements))
