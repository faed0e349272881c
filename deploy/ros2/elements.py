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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.ros2.link import Link, Publish
from rlservo.envs.ros2.messages import JOINT_STATE, NUMBER, NUMBERS, stamp, stamp_of
from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.spaces import BoxSpec

PLACE = re.compile(r"(\S+) (\w+/msg/\w+) ([\w.]+)(?:\[(\w+)\])?(?: \* (\S+))?(?: \+ (\S+))?")
JOINT_FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True)
class Place:
    """A number in a message: `values[...] * factor + offset` is the element."""

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
            return cls(topic, kind, tuple(path.split(".")), index, float(factor or 1.0), float(offset or 0.0))
        except ValueError:
            raise UsageError(
                f"element {element!r} is mapped to {text!r}: expected TOPIC TYPE FIELD, such as '/imu "
                "sensor_msgs/msg/Imu angular_velocity.z * 57.3'"
            ) from None

    def read(self, message: Any) -> float | None:
        """Return the element, None where the message lacks it."""
        value = message
        try:
            for name in self.path:
                value = getattr(value, name)
            if self.index is not None:
                digits = self.index.isdecimal()
                value = value[int(self.index) if digits else list(message.name).index(self.index)]
            number = float(value) * self.factor + self.offset
        except (AttributeError, IndexError, ValueError, TypeError):
            return None
        return number if math.isfinite(number) else None


def places(contract: Contract, mapped: Mapping[str, str]) -> tuple[list[Place], list[Place]]:
    """Return where the observation's and the action's elements are, by their names or as `mapped` says.

    `X_position`, `X_velocity` and `X_effort` are joint X of /joint_states, others `~/observation/NAME`; actions are a
    Float64MultiArray on `~/action`. Raises UsageError for spaces without elements, or a mapping of none.
    """
    sides: list[list[Place]] = []
    known: list[str] = []
    for side, space in (("observation", contract.observation_space), ("action", contract.action_space)):
        if not isinstance(space, BoxSpec) or len(space.shape) != 1:
            raise UsageError(f"policy {contract.name!r}: the {side} is not a vector: `rlservo ros2` maps only vectors")
        count = space.shape[0]
        names = [one.name for one in space.elements] or [str(index) for index in range(count)]
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
    return sides[0], sides[1]


def _default(side: str, name: str, index: int) -> str:
    if side == "action":
        return f"~/action {NUMBERS} data[{index}]"
    joint, _, quantity = name.rpartition("_")
    if joint and quantity in JOINT_FIELDS:
        return f"/joint_states {JOINT_STATE} {quantity}[{joint}]"
    return f"~/observation/{re.sub(r'[^A-Za-z0-9_]', '_', name)} {NUMBER} data"


@dataclass
class _Latest:
    message: Any = None
    received_s: float = 0.0
    age_s: float = 0.0


@dataclass
class ElementInputs:
    """The newest message of each topic, as one observation."""

    link: Link
    places: Sequence[Place]
    max_age_s: float
    _latest: dict[str, _Latest] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for topic, kind in {place.topic: place.kind for place in self.places}.items():
            self._latest[topic] = latest = _Latest()
            self.link.subscribe(topic, kind, self._taker(latest))

    def observe(self) -> tuple[NDArray[np.float32] | None, str]:
        """Return the observation, or None and why there is none that may be acted on."""
        for topic, latest in self._latest.items():
            if latest.message is None:
                return None, f"no message on {topic}"
            age_s = time.monotonic() - latest.received_s + latest.age_s
            if age_s > self.max_age_s:
                return None, f"the newest message on {topic} is {age_s:.2f} s old, more than {self.max_age_s:g} s"
        values = [place.read(self._latest[place.topic].message) for place in self.places]
        for place, value in zip(self.places, values, strict=True):
            if value is None:
                path = ".".join(place.path) + (f"[{place.index}]" if place.index else "")
                return None, f"a message on {place.topic} has no finite {path}"
        return np.array(values, dtype=np.float32), ""

    def _taker(self, latest: _Latest) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            made_s = stamp_of(message)  # without one, it is as old as its arrival
            latest.age_s = 0.0 if made_s is None else abs(self.link.now_s() - made_s)
            latest.received_s, latest.message = time.monotonic(), message

        return take


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
            elif place.index.isdecimal():
                array = part.setdefault(last, [])
                array += [0.0] * (int(place.index) + 1 - len(array))
                array[int(place.index)] = number
            else:  # a JointState: by name
                part.setdefault("name", []).append(place.index)
                part.setdefault(last, []).append(number)
        for place in self._places:
            if place.kind.endswith("Stamped") or place.kind == JOINT_STATE:
                messages[place.topic]["header"] = {"stamp": stamp(self._now_s())}
        for topic, values in messages.items():
            self._publishers[topic](values)
