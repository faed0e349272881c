"""Motions of the simulated controller: each gives the joint setpoint's velocity for one control cycle at a time."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Motion(Protocol):
    """The setpoint's motion until it `is_done`."""

    is_done: bool

    def velocity(self, position: Vector, velocity: Vector, dt: float, speed_fraction: float) -> Vector:
        """Return the velocity [rad/s] (6,) for the next `dt` [s] of a setpoint at `position` [rad].

        The program's own time passes at `speed_fraction`.
        """
        ...


class Ramp:
    """speedj and stopj: towards a velocity, with the joint that changes most at `acceleration` [rad/s^2]."""

    def __init__(self, target: Vector, acceleration: float) -> None:
        self.target, self.acceleration, self.is_done = target, max(acceleration, 1e-3), False

    def velocity(self, position: Vector, velocity: Vector, dt: float, speed_fraction: float) -> Vector:
        del position
        change = self.target * speed_fraction - velocity
        largest = float(np.abs(change).max())
        self.is_done = largest <= self.acceleration * dt
        return velocity + change * (1.0 if self.is_done else self.acceleration * dt / largest)


class Servo:
    """servoj: a critically damped follower whose lag behind a moving target is the look-ahead time.

    It runs in the program's time: at a fraction of the speed it makes that fraction of its way in a cycle.
    """

    def __init__(self, target: Vector, lookahead_s: float) -> None:
        self.is_done = False
        self._follower_velocity: Vector | None = None
        self.retarget(target, lookahead_s)

    def retarget(self, target: Vector, lookahead_s: float) -> None:
        """Replace the target [rad] (6,) without losing the follower's velocity."""
        self._target, self._omega = target, 2.0 / max(lookahead_s, 0.01)

    def velocity(self, position: Vector, velocity: Vector, dt: float, speed_fraction: float) -> Vector:
        if speed_fraction <= 0.0:
            return np.zeros_like(velocity)
        before = velocity / speed_fraction if self._follower_velocity is None else self._follower_velocity
        error, omega, passed = position - self._target, self._omega, dt * speed_fraction
        slope, decay = before + omega * error, math.exp(-omega * passed)
        self._follower_velocity = (slope - omega * (error + slope * passed)) * decay
        return ((error + slope * passed) * decay - error) / dt


class MoveJ:
    """movej: all joints arrive together, the leading one on a trapezoid of velocity."""

    def __init__(self, start: Vector, goal: Vector, speed: float, acceleration: float) -> None:
        self._start, self._way = start.copy(), goal - start
        length = max(float(np.abs(self._way).max()), 1e-9)
        self._acceleration = acceleration / length
        self._peak = min(speed / length, math.sqrt(self._acceleration))
        self._ramp_s = self._peak / self._acceleration
        self._total_s = 1.0 / self._peak + self._ramp_s
        self._time_s, self.is_done = 0.0, False

    def velocity(self, position: Vector, velocity: Vector, dt: float, speed_fraction: float) -> Vector:
        del velocity
        self._time_s = min(self._time_s + dt * speed_fraction, self._total_s)
        self.is_done = self._time_s >= self._total_s
        ahead: Vector = self._start + self._way * self._share(self._time_s)
        return (ahead - position) / dt

    def _share(self, time_s: float) -> float:
        left = self._total_s - time_s
        if time_s < self._ramp_s:
            return 0.5 * self._acceleration * time_s**2
        if left < self._ramp_s:
            return 1.0 - 0.5 * self._acceleration * left**2
        return self._peak * (time_s - self._ramp_s / 2)
