"""Observation and action elements as fields of ROS messages, for a policy of a robot that is not simulated here.

A place is a line of text, `TOPIC TYPE FIELD`, with ` * FACTOR` and ` + OFFSET` where a unit differs:
`/joint_states sensor_msgs/msg/JointState position[slider_joint]`, `/imu sensor_msgs/msg/Imu angular_velocity.z * 57.3`.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.conventions import contradiction
from rlservo.bundle.spaces import BoxSpec, Element, Quantity
from rlservo.errors import UsageError
from rlservo.robots.ros2.address import TOPIC
from rlservo.robots.ros2.link import Link, Publish
from rlservo.robots.ros2.rclpy_link import message_fields
from rlservo.robots.ros2.ros_messages import (
    JOINT_STATE,
    NUMBER,
    NUMBERS,
    TWIST,
    TWIST_STAMPED,
    joint_index,
    stamp,
    stamp_of,
)

PLACE = re.compile(rf"({TOPIC}) (\w+/msg/\w+) ([\w.]+)(?:\[([^\]]+)\])?(?: \* (\S+))?(?: \+ (\S+))?")
JOINT_FIELDS: dict[str, Quantity] = {
    "position": "joint position", "velocity": "joint velocity", "effort": "joint effort"
}  # fmt: skip
PARTS: dict[str, Quantity] = {
    "linear": "linear velocity", "angular": "angular velocity", "angular_velocity": "angular velocity",
    "position": "position", "orientation": "quaternion",
}  # fmt: skip
"""Fields of ROS's messages with parts x, y, z (w); `linear` and `angular` are those of a twist."""
CONTROLLER = re.compile(rf".*({'|'.join(JOINT_FIELDS)})_controller/commands")
RELATIVE = "relative joint position"
VELOCITIES = ("joint velocity", "linear velocity", "angular velocity")
COMMANDED, READ = "double|float", r"double|float|u?int\d+|boolean"  # types of numbers, as messages name them


@dataclass(frozen=True)
class Place:
    """A number in a message: `values[...] * factor + offset` is the element."""

    element: str
    topic: str
    kind: str
    path: tuple[str, ...]
    index: str | None  # a position, or a joint's name
    factor: float = 1.0
    offset: float = 0.0
    stop: float | None = None  # the number that is sent when nothing is to move

    @classmethod
    def parse(cls, element: str, text: str) -> Place:
        """Return what a line says. Raises UsageError."""
        match = PLACE.fullmatch(text.strip())
        try:
            if match is None:
                raise ValueError
            topic, kind, path, index, factor, offset = match.groups()
            scale, shift, stop = (
                float(factor or 1.0),
                float(offset or 0.0),
                0.0 if kind in (TWIST, TWIST_STAMPED) else None,
            )
            place = cls(element, topic, kind, tuple(path.split(".")), index, scale, shift, stop)
            if not (math.isfinite(place.factor) and math.isfinite(place.offset)):
                raise ValueError
        except ValueError:
            raise UsageError(
                f"element {element!r} is mapped to {text!r}: expected TOPIC TYPE FIELD, such as '/imu "
                "sensor_msgs/msg/Imu angular_velocity.z * 57.3'"
            ) from None
        return place

    @property
    def field(self) -> str:
        """The field as it is written."""
        return ".".join(self.path) + (f"[{self.index}]" if self.index else "")

    def carries(self, topic: str, *, is_command: bool) -> Element:
        """Return what the field is, as an element; `topic` is the resolved one.

        ROS has SI units (REP 103), and w last in a quaternion, where each part is named.
        """
        scale, offset = self.factor, self.offset
        if not is_command:  # the element is value * factor + offset
            scale, offset = 1.0 / self.factor if self.factor else math.inf, -self.offset / (self.factor or 1.0)
        known: dict[str, Any] = {"scale": scale, "offset": offset}
        *parents, axis = self.path
        part = parents[-1] if parents else ""
        if self.kind == JOINT_STATE and axis in JOINT_FIELDS:
            known["quantity"] = JOINT_FIELDS[axis]
            known["joint"] = "" if self.index is None or self.index.isdecimal() else self.index
        elif match := CONTROLLER.fullmatch(topic):
            known["quantity"] = JOINT_FIELDS[match[1]]
        elif part in PARTS and axis in "xyzw" and not (part in ("linear", "angular") and "accel" in self.kind.lower()):
            known |= {"quantity": PARTS[part], "axis": axis}
        else:
            known = {}
        return Element(name=self.element, **known)

    def check(self, numbers: str) -> None:
        """Raise UsageError if the field is none of the types `numbers`, RobotError if the type is not installed."""
        kind = self.kind.replace("/msg/", "/")
        for name in self.path:
            fields = message_fields(kind) if re.fullmatch(r"\w+/\w+", kind) else {}
            kind = fields.get(name, "no field")
        array = rf"sequence<(?:{numbers})(?:, \d+)?>|(?:{numbers})\[\d+\]"
        if not re.fullmatch(array if self.index else numbers, kind):
            raise UsageError(
                f"element {self.element!r} is mapped to {self.field} of {self.kind}, where {'.'.join(self.path)} is "
                f"{kind}: expected {'an array' if self.index else 'one'} of {numbers.replace('|', ', ')}"
            )

    def read(self, message: Any) -> float | None:
        """Return the element, None where the message lacks it."""
        value = message
        try:
            for name in self.path:
                value = getattr(value, name)
            if self.index is not None:
                value = value[int(self.index) if self.index.isdecimal() else joint_index(message, self.index)]
            return float(value) * self.factor + self.offset
        except (AttributeError, IndexError, ValueError, TypeError):
            return None


def places(contract: Contract, mapped: Mapping[str, str]) -> tuple[list[Place], list[Place]]:
    """Return where the observation's and the action's elements are, by their names or as `mapped` says; `stop.NAME`
    is the number of an action's element that stops it, 0 for velocities.

    A position, velocity or effort of a joint, and `X_position`, `X_velocity` and `X_effort`, are joint X of
    /joint_states, others `~/observation/NAME`; actions are a Float64MultiArray on `~/action`. Raises UsageError for
    spaces without elements, or a mapping of none.
    """
    sides: list[list[Place]] = []
    known: list[str] = []
    kinds: dict[str, str] = {}
    for side, space in (("observation", contract.observation_space), ("action", contract.action_space)):
        if not isinstance(space, BoxSpec) or len(space.shape) != 1:
            raise UsageError(f"policy {contract.name!r}: the {side} is not a vector: `rlservo ros2` maps only vectors")
        count = space.shape[0]
        elements = space.elements or tuple(Element(name=f"element_{index}") for index in range(count))
        known += [f"{side}.{element.name}" for element in elements]
        sides.append(
            [
                Place.parse(element.name, mapped.get(f"{side}.{element.name}") or _default(side, element, index))
                for index, element in enumerate(elements)
            ]
        )
    observed, acted = sides
    known += [f"stop.{place.element}" for place in acted]
    unknown = [name for name in mapped if name not in known]
    if unknown:
        raise UsageError(f"parameter {unknown[0]!r} maps no element: expected one of {', '.join(known)}")
    for element, place in zip(contract.action_space.elements, acted, strict=False):
        if element.quantity in VELOCITIES:  # the action that is no velocity, as a message has it
            still = -(element.offset or 0.0) / (element.scale or 1.0)
            acted[acted.index(place)] = replace(place, stop=still * place.factor + place.offset + 0.0)
    acted = [_with_stop(place, mapped.get(f"stop.{place.element}")) for place in acted]
    for place in (*observed, *acted):
        if (kind := kinds.setdefault(place.topic, place.kind)) != place.kind:
            raise UsageError(
                f"{place.topic} is mapped as both {kind} and {place.kind} (for {place.element!r}): expected one type"
            )
    commanded: dict[tuple[str, str], str] = {}
    for place in acted:
        if (other := commanded.setdefault((place.topic, place.field), place.element)) != place.element:
            raise UsageError(f"{other!r} and {place.element!r} are both mapped to {place.field} of {place.topic}")
    return observed, acted


def check_conventions(
    contract: Contract, observed: Sequence[Place], acted: Sequence[Place], resolve: Callable[[str], str]
) -> None:
    """Raise UsageError if a field is not what the policy says of its element, or the policy does not name a command."""
    for side, space, mapped in (
        ("observation", contract.observation_space, observed), ("action", contract.action_space, acted),
    ):  # fmt: skip
        elements = space.elements or tuple(Element(name=place.element) for place in mapped)
        for element, place in zip(elements, mapped, strict=True):
            carried = place.carries(resolve(place.topic), is_command=side == "action")
            if side == "action" and element.quantity in (None, "raw"):
                raise UsageError(
                    f"policy {contract.name!r} does not say which command its action {element.name!r} is: export it "
                    "again with --convention action=absolute, relative, velocity or effort"
                )
            if side == "action" and element.quantity == RELATIVE:
                element = _target(element)
            if found := contradiction([element], [carried]):
                what = found[0].partition(") ")[2] or "is the quaternion's part"
                raise UsageError(
                    f"policy {contract.name!r}: {side} element {element.name!r} {what} {found[1]}, but {place.topic} "
                    f"{place.field} {what} {found[2]}"
                )


def _target(element: Element) -> Element:
    """Return the absolute position [rad] that a relative one becomes."""
    return element.model_copy(update={"quantity": "joint position", "unit": "rad", "scale": 1.0, "offset": 0.0})


@dataclass(frozen=True)
class PresentPositions:
    """Makes joint targets of relative positions: target = present position + action * scale + offset."""

    sources: Sequence[tuple[int, int, Place, float, float]]
    """Of each relative element: its index, that of the observed position, its place, scale and offset."""

    @classmethod
    def of(cls, contract: Contract, observed: Sequence[Place]) -> PresentPositions:
        """Find the joints' positions in the observation. Raises UsageError for a joint that is not observed."""
        sources: list[tuple[int, int, Place, float, float]] = []
        for index, element in enumerate(contract.action_space.elements):
            if element.quantity != RELATIVE:
                continue
            found = [
                (number, place)
                for number, place in enumerate(observed)
                if (place.kind, place.path, place.index) == (JOINT_STATE, ("position",), element.joint)
            ]
            if not found or not found[0][1].factor:
                raise UsageError(
                    f"policy {contract.name!r}: action element {element.name!r} is relative to the position of joint "
                    f"{element.joint or 'unknown'!r}, which no observation element is mapped to: map one to position"
                    f"[{element.joint or 'JOINT'}] of /joint_states"
                )
            sources.append((index, *found[0], 1.0 if element.scale is None else element.scale, element.offset or 0.0))
        return cls(sources)

    def targets(self, action: NDArray[Any], observation: NDArray[Any]) -> NDArray[Any]:
        """Return the action with targets [rad] in place of relative positions."""
        changed = np.array(action, np.float64)
        for index, number, place, scale, offset in self.sources:
            present = (float(observation[number]) - place.offset) / place.factor
            changed[index] = present + float(action[index]) * scale + offset
        return changed


def _with_stop(place: Place, text: str | None) -> Place:
    try:
        stop = place.stop if text is None else float(text)
    except ValueError:
        stop = math.nan
    if stop is not None and not math.isfinite(stop):
        raise UsageError(f"parameter 'stop.{place.element}' is {text!r}: expected a finite number")
    return replace(place, stop=stop)


def _default(side: str, element: Element, index: int) -> str:
    if side == "action":
        return f"~/action {NUMBERS} data[{index}]"
    name = element.name
    for known, kind in JOINT_FIELDS.items():
        if element.quantity == kind and element.joint and element.scale:
            offset = -(element.offset or 0.0) / element.scale
            return f"/joint_states {JOINT_STATE} {known}[{element.joint}] * {1.0 / element.scale!r} + {offset!r}"
    joint, _, quantity = name.rpartition("_")
    if joint and quantity in JOINT_FIELDS:
        return f"/joint_states {JOINT_STATE} {quantity}[{joint}]"
    return f"~/observation/{re.sub(r'[^A-Za-z0-9_]', '_', name)} {NUMBER} data"


@dataclass
class ElementInputs:
    """The newest value of each element, as one observation.

    A topic may have several publishers, each with some of the joints.
    """

    link: Link
    places: Sequence[Place]
    max_age_s: float
    _latest: dict[Place, tuple[float, float]] = field(default_factory=dict)  # value, and when made by time.monotonic()

    def __post_init__(self) -> None:
        for topic, kind in {place.topic: place.kind for place in self.places}.items():
            self.link.subscribe(topic, kind, partial(self._take, topic))

    def observe(self) -> tuple[NDArray[np.float32] | None, str]:
        """Return the observation, or None and why there is none that may be acted on."""
        values = []
        for place in self.places:
            if place not in self._latest:
                return None, f"no message on {place.topic} with {place.field}"
            value, made_s = self._latest[place]
            if (age_s := time.monotonic() - made_s) > self.max_age_s:
                newest = f"the newest message on {place.topic} with {place.field}"
                return None, f"{newest} is {age_s:.2f} s old, more than {self.max_age_s:g} s"
            if not math.isfinite(value):
                return None, f"a message on {place.topic} has no finite {place.field}"
            values.append(value)
        return np.array(values, dtype=np.float32), ""

    def _take(self, topic: str, message: Any) -> None:
        stamp_s, now_s = stamp_of(message), self.link.now_s()  # without one, it is as old as its arrival
        made_s = time.monotonic() - (0.0 if stamp_s is None else abs(now_s - stamp_s))
        for place in self.places:
            if place.topic == topic and (value := place.read(message)) is not None:
                self._latest[place] = value, made_s


class ElementOutputs:
    """Actions as messages: elements of one topic make one message."""

    def __init__(self, places: Sequence[Place], publishers: Mapping[str, Publish], now_s: Callable[[], float]) -> None:
        self._places, self._publishers, self._now_s = places, publishers, now_s
        self._must_stop = False  # whether something was sent since the last stop

    def act(self, action: NDArray[np.floating[Any]]) -> None:
        """Publish one action."""
        self._must_stop = True
        numbers = zip(self._places, action.tolist(), strict=True)
        self._send([(place, value * place.factor + place.offset) for place, value in numbers])

    def stop(self) -> None:
        """Publish once the numbers that stop the elements; a topic is left alone if one of its elements has none."""
        if self._must_stop:
            self._must_stop = False
            unknown = {place.topic for place in self._places if place.stop is None}
            self._send([(place, place.stop or 0.0) for place in self._places if place.topic not in unknown])

    def _send(self, numbers: Sequence[tuple[Place, float]]) -> None:
        messages: dict[str, dict[str, Any]] = {}
        for place, number in numbers:
            *parents, last = place.path
            part = messages.setdefault(place.topic, {})
            for name in parents:
                part = part.setdefault(name, {})
            if place.index is None:
                part[last] = number
                continue
            if place.index.isdecimal():
                at = int(place.index)
            else:  # a JointState: by name
                names = part.setdefault("name", [])
                names += [place.index] * (place.index not in names)
                at = names.index(place.index)
            array = part.setdefault(last, [])
            array += [0.0] * (at + 1 - len(array))
            array[at] = number
        for place, _ in numbers:
            if place.kind.endswith("Stamped") or place.kind == JOINT_STATE:
                messages[place.topic]["header"] = {"stamp": stamp(self._now_s())}
        for topic, values in messages.items():
            self._publishers[topic](values)
