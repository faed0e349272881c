"""Limits of a real arm's motion, with braking distance: an arm near a limit slows down instead of freezing.

Everything is in closed form, once per cycle of the command stream: from a wanted velocity to the next joint setpoint.
Limits of velocity, tool speed and workspace are applied before that of acceleration, which mixes the old velocity and
the new: both keep those limits, and so does every mixture. Joint positions come last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from rlservo.robots.arm_interface import RobotError, Vector
from rlservo.robots.ur.parameters import JOINTS, POSITION_LIMITS
from rlservo.robots.ur.simulation import URSimulation

# Limited quantities, by element, in the order of the counts.
COUNTED = (
    *(f"{kind}.{joint}" for kind in ("position", "velocity", "acceleration") for joint in JOINTS),
    "tool_speed", *(f"workspace.{axis}" for axis in "xyz"), "late_setpoint", "stale_observation",
    "following_error",
)  # fmt: skip
POSITION, VELOCITY, ACCELERATION = (COUNTED.index(f"{kind}.base") for kind in ("position", "velocity", "acceleration"))
TOOL_SPEED, WORKSPACE, LATE = (COUNTED.index(name) for name in ("tool_speed", "workspace.x", "late_setpoint"))
PASSES = 2  # over the three axes: in a corner, reducing one increases another
FARTHEST = 5.0  # [m] of a wall: no arm reaches half of it
WALL_MARGIN = 0.03  # [m], margin inside the walls, for the curvature that the closed form ignores
SHARE = 0.5  # share of a tool axis' braking ability used for walls: joints have other limits to keep as well


def _is_number(value: object, low: float, high: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _is_row(values: object, farthest: Sequence[float]) -> bool:
    """Return whether these are numbers, none farther from 0 than its limit."""
    if not isinstance(values, (tuple, list)) or len(values) != len(farthest):
        return False
    return all(_is_number(value, -most, most) for value, most in zip(values, farthest, strict=True))


class CheckedLimits:
    """Base of limits, frozen dataclasses: numbers are checked against `RANGES`, names against the fields."""

    RANGES: ClassVar[dict[str, tuple[float, float]]]

    def __post_init__(self) -> None:
        for name, (low, high) in self.RANGES.items():
            value = getattr(self, name)
            if not _is_number(value, low, high):
                raise RobotError(f"limits: {name} is {value!r}: expected a number from {low:g} to {high:g}")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the limits with some values replaced. Raises RobotError for names that do not exist."""
        if not isinstance(values, Mapping):
            kind = type(values).__name__
            raise RobotError(f"limits is a {kind}: expected names with values, such as {{'speed_scale': 0.1}}")
        names = [one.name for one in fields(cls)]  # type: ignore[arg-type]  # its subclasses are dataclasses
        unknown = [name for name in values if name not in names]
        if unknown:
            raise RobotError(
                f"limits: {', '.join(map(str, unknown))} does not exist: expected some of {', '.join(names)}"
            )
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})


@dataclass(frozen=True)
class Limits(CheckedLimits):
    """Limits of the command stream, inside the controller's own safety limits."""

    speed_scale: float = 1.0  # of all velocities below; the speed slider multiplies it
    acceleration: float = 5.0  # [rad/s^2] of every joint, also to stop
    tool_speed: float = 0.5  # [m/s]
    box_low: tuple[float, ...] = (-2.0, -2.0, 0.0)  # [m], tool0 in base_link
    box_high: tuple[float, ...] = (2.0, 2.0, 2.0)  # [m]
    position_low: tuple[float, ...] = tuple(-limit for limit in POSITION_LIMITS)  # [rad]
    position_high: tuple[float, ...] = POSITION_LIMITS  # [rad]
    start_speed: float = 0.3  # [rad/s], on the way to a start pose
    blend_s: float = 1.0  # [s] in which the policy's share of the speed grows from 0 to 1
    watchdog_hz: float = 10.0  # the controller ends the program after 1 / watchdog_hz without a command
    lookahead_s: float = 0.1  # [s], servoj's
    gain: float = 300.0  # servoj's
    rate_hz: float = 0.0  # of the command stream; 0: the robot's own, 125 or 500 Hz

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "speed_scale": (0.001, 1.0), "acceleration": (0.1, 15.0), "tool_speed": (0.01, 3.0),
        "start_speed": (0.01, 1.0), "blend_s": (0.0, 60.0), "watchdog_hz": (1.0, 100.0),
        "lookahead_s": (0.03, 0.2), "gain": (100.0, 2000.0), "rate_hz": (0.0, 500.0),
    }  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit, places, most in (("box", "m", "xyz", FARTHEST), ("position", "rad", JOINTS, POSITION_LIMITS)):
            farthest = np.broadcast_to(most, len(places)).tolist()
            for end in (f"{name}_low", f"{name}_high"):
                values = getattr(self, end)
                if not _is_row(values, farthest):
                    within = f"{len(places)} numbers [{unit}] from {-max(farthest):.3g} to {max(farthest):.3g}"
                    raise RobotError(f"limits: {end} is {values!r}: expected {within}")
            margin = 2.0 * WALL_MARGIN if name == "box" else 0.0
            for place, low, high in zip(
                places, getattr(self, f"{name}_low"), getattr(self, f"{name}_high"), strict=True
            ):
                if not high - low > margin:
                    where = f"{place} is from {low:g} to {high:g} {unit}, {high - low:.3g} {unit} wide"
                    raise RobotError(f"limits: {name}_low and {name}_high: {where}: expected more than {margin:g}")
        if 0.0 < self.rate_hz <= self.watchdog_hz:
            waits = f"the watchdog waits for {self.watchdog_hz:g} commands a second"
            raise RobotError(f"limits: rate_hz is {self.rate_hz:g}, but {waits}: expected more, or a lower watchdog_hz")


def braking_speed(distance: Vector | float, deceleration: Vector | float, dt: float) -> Vector:
    """Return the speed from which `distance` suffices to stop, including one more cycle of `dt` [s]."""
    reach = np.asarray(deceleration) * dt
    return np.sqrt(reach**2 + 2.0 * np.asarray(deceleration) * np.maximum(distance, 0.0)) - reach


@dataclass
class MotionLimiter:
    """The joint setpoint of the command stream: position and velocity, advanced by `step`."""

    limits: Limits
    simulation: URSimulation  # for the tool's place and Jacobian
    velocity_limits: Vector  # [rad/s], (6,)
    longest_dt: float  # [s], of a step
    position: Vector = field(default_factory=lambda: np.zeros(6))
    velocity: Vector = field(default_factory=lambda: np.zeros(6))
    limited: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(len(COUNTED), dtype=np.bool_))

    def __post_init__(self) -> None:
        self._low, self._high = np.array(self.limits.position_low), np.array(self.limits.position_high)
        self._box_low, self._box_high = np.array(self.limits.box_low), np.array(self.limits.box_high)
        self._box_low, self._box_high = self._box_low + WALL_MARGIN, self._box_high - WALL_MARGIN

    def restart(self, position: ArrayLike) -> None:
        """Restart at rest at measured joint positions [rad] (6,)."""
        self.position, self.velocity = np.array(position, dtype=np.float64), np.zeros(6)

    def check_start(self) -> None:
        """Raise RobotError for a joint that is outside its limits: the way back inside is a person's."""
        for joint, at, low, high in zip(JOINTS, self.position, self._low, self._high, strict=True):
            if not low <= at <= high:
                within = f"outside its limits of {low:.3g} to {high:.3g} rad"
                raise RobotError(f"{joint} is at {at:.3g} rad, {within}: move it inside by hand, or widen the limits")

    def goal_within(self, goal: Vector) -> Vector:
        """Return the goal within the position limits, and note the joints that were outside."""
        within: Vector = np.clip(goal, self._low, self._high)
        self.limited[POSITION : POSITION + 6] |= within != goal
        return within

    def velocity_towards(self, goal: Vector, remaining_s: float, dt: float) -> Vector:
        """Return the velocity that reaches `goal` in the remaining time, without overshoot."""
        way = goal - self.position
        if remaining_s > dt:
            want = way / remaining_s
            self.limited[VELOCITY : VELOCITY + 6] |= np.abs(want) > self.velocity_limits * 1.001
        else:  # it is overdue: as fast as allowed
            want = way * min(1.0 / dt, float((self.velocity_limits / np.maximum(np.abs(way), 1e-12)).min()))
        bound = braking_speed(np.abs(way), self.limits.acceleration, dt)
        clipped: Vector = np.clip(want, -bound, bound)
        return clipped

    def step(self, want: Vector, dt: float, scale: float) -> Vector:
        """Advance the setpoint by `dt` [s] towards the velocity `want`, within `scale` of the limits; return it."""
        velocity = want * min(1.0, float((self.velocity_limits / np.maximum(np.abs(want), 1e-12)).min())) * scale
        tool, jacobian = self.simulation.tool_at(self.position)
        velocity = self._within_box(velocity, tool, jacobian)
        most = self.velocity_limits * scale
        velocity = velocity * min(1.0, float((most / np.maximum(np.abs(velocity), 1e-12)).min()))
        velocity = self._within_tool_speed(velocity, jacobian)

        change = velocity - self.velocity
        most_change = self.limits.acceleration * dt
        largest = float(np.abs(change).max())
        if largest > most_change * 1.0001:
            if largest > 2.0 * most_change:
                self.limited[ACCELERATION : ACCELERATION + 6] |= np.abs(change) > 2.0 * most_change
            # This mixture may brake too little for a wall if other joints change more: the wall has precedence.
            mixed = self._within_box(self.velocity + change * (most_change / largest), tool, jacobian)
            velocity = np.clip(mixed, self.velocity - most_change, self.velocity + most_change)
            velocity = np.clip(velocity, np.minimum(-most, self.velocity), np.maximum(most, self.velocity))
        upper = braking_speed(self._high - self.position, self.limits.acceleration, self.longest_dt)
        lower = -braking_speed(self.position - self._low, self.limits.acceleration, self.longest_dt)
        bounded = np.clip(velocity, lower, upper)
        self.limited[POSITION : POSITION + 6] |= np.abs(bounded - velocity) > 1e-9
        if not self._stops_within_box(bounded, tool, jacobian):  # a joint's limit removed the part that kept it inside
            self.limited[WORKSPACE : WORKSPACE + 3] = True
            largest = float(np.abs(self.velocity).max())
            bounded = np.clip(self.velocity * max(0.0, 1.0 - most_change / max(largest, 1e-12)), lower, upper)
        self.velocity = np.clip(bounded, self.velocity - most_change, self.velocity + most_change)
        self.position = self.position + self.velocity * dt
        return self.position

    def _within_box(self, velocity: Vector, tool: Vector, jacobian: Vector) -> Vector:
        """Remove from a velocity the part that would carry the tool through a wall; motion along the wall continues."""
        squares = np.maximum((jacobian**2).sum(axis=1), 1e-6)
        decelerations = SHARE * self.limits.acceleration * squares / np.maximum(np.abs(jacobian).max(axis=1), 1e-3)
        most = braking_speed(self._box_high - tool, decelerations, self.longest_dt)
        least = -braking_speed(tool - self._box_low, decelerations, self.longest_dt)
        for _ in range(PASSES):
            speeds = jacobian @ velocity
            excess = speeds - np.clip(speeds, least, most)
            if not excess.any():
                break
            self.limited[WORKSPACE : WORKSPACE + 3] |= excess != 0.0
            for axis in np.flatnonzero(excess):
                row = jacobian[axis]
                speed = float(row @ velocity)
                allowed = min(max(speed, float(least[axis])), float(most[axis]))
                velocity = velocity + row * ((allowed - speed) / float(squares[axis]))
        return velocity

    def _stops_within_box(self, velocity: Vector, tool: Vector, jacobian: Vector) -> bool:
        """Return whether the tool would stop before each wall ahead, with all joints braking in proportion."""
        speeds = jacobian @ velocity
        way = speeds * (float(np.abs(velocity).max()) / (2.0 * self.limits.acceleration) + self.longest_dt)
        beyond = ((tool + way > self._box_high) & (speeds > 0.0)) | ((tool + way < self._box_low) & (speeds < 0.0))
        return not beyond.any()

    def _within_tool_speed(self, velocity: Vector, jacobian: Vector) -> Vector:
        speed = math.sqrt(float(((jacobian @ velocity) ** 2).sum()))
        most = 0.95 * self.limits.tool_speed
        if speed <= most:
            return velocity
        self.limited[TOOL_SPEED] = True
        return velocity * (most / speed)
