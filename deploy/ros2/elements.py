"""Observation and action elements as fields of ROS messages, for a policy of a robot that is not simulated here.

A place is a line of text, `TOPIC TYPE FIELD`, with ` * FACTOR` and ` + OFFSET` where a unit differs:
`/joint_states sensor_msgs/msg/JointState position[slider_joint]`, `/imu sensor_msgs/msg/Imu angular_velocity.z * 57.3`.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.ros2.address import TOPIC
from rlservo.envs.ros2.link import Link, Publish
from rlservo.envs.ros2.messages import JOINT_STATE, NUMBER, NUMBERS, joint_index, stamp, stamp_of
from rlservo.envs.ros2.rclpy_link import message_fields
from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.spaces import BoxSpec

PLACE = re.compile(rf"({TOPIC}) (\w+/msg/\w+) ([\w.]+)(?:\[([^\]]+)\])?(?: \* (\S+))?(?: \+ (\S+))?")
JOINT_FIELDS = ("position", "velocity", "effort")
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

    @classmethod
    def parse(cls, element: str, text: str) -> Place:
        """Return what a line says. Raises UsageError."""
        match = PLACE.fullmatch(text.strip())
        try:
            if match is None:
                raise ValueError
            topic, kind, path, index, factor, offset = match.groups()
            place = cls(element, topic, kind, tuple(path.split(".")), index, float(factor or 1.0), float(offset or 0.0))
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
    """Return where the observation's and the action's elements are, by their names or as `mapped` says.

    `X_position`, `X_velocity` and `X_effort` are joint X of /joint_states, others `~/observation/NAME`; actions are a
    Float64MultiArray on `~/action`. Raises UsageError for spaces without elements, or a mapping of none.
    """
    sides: list[list[Place]] = []
    known: list[str] = []
    kinds: dict[str, str] = {}
    for side, space in (("observation", contract.observation_space), ("action", contract.action_space)):
        if not isinstance(space, BoxSpec) or len(space.shape) != 1:
            raise UsageError(f"policy {contract.name!r}: the {side} is not a vector: `rlservo ros2` maps only vectors")
        count = space.shape[0]
        names = [one.name for one in space.elements] or [f"element_{index}" for index in range(count)]
        known += [f"{side}.{name}" for name in names]
        sides.append(
            [
                Place.parse(name, mapped.get(f"{side}.{name}") or _default(side, name, index))
                for index, name in enumerate(names)
            ]
        )
    unknown = [name for name in mapped if name not in known]
    if unknown:
        raise UsageError(f"parameter {unknown[0]!r} maps no element: expected one of {', '.join(known)}")
    observed, acted = sides
    for place in (*observed, *acted):
        if (kind := kinds.setdefault(place.topic, place.kind)) != place.kind:
            raise UsageError(f"{place.topic} is mapped as {kind}, and for {place.element!r} as {place.kind}")
    commanded: dict[tuple[str, str], str] = {}
    for place in acted:
        if (other := commanded.setdefault((place.topic, place.field), place.element)) != place.element:
            raise UsageError(f"{other!r} and {place.element!r} are both mapped to {place.field} of {place.topic}")
    return observed, acted


def _default(side: str, name: str, index: int) -> str:
    if side == "action":
        return f"~/action {NUMBERS} data[{index}]"
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

    def act(self, action: NDArray[np.floating[Any]]) -> None:
        """Publish one action."""
        messages: dict[str, dict[str, Any]] = {topic: {} for topic in self._publishers}
        for place, value in zip(self._places, action.tolist(), strict=True):
            number = value * place.factor + place.offset
            *parents, last = place.path
            part = messages[place.topic]
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
        for place in self._places:
            if place.kind.endswith("Stamped") or place.kind == JOINT_STATE:
                messages[place.topic]["header"] = {"stamp": stamp(self._now_s())}
        for topic, values in messages.items():
            self._publishers[topic](values)
