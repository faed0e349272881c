"""Distance of an arm behind its setpoint, and the bound beyond which the setpoint waits."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from rlservo.robots.arm_interface import Vector
from rlservo.robots.limits import MotionLimiter

KEPT_S = 1.0  # [s] of setpoints; a state is not acted on when it is older than a tenth of that
WAIT_S = 0.5  # [s] for which an arm that was behind is held at least
PATIENCE_S = 1.0  # [s] of such waiting, after which the arm does not follow
FORGIVEN = 0.05  # [s/s], of it while the arm follows


class FollowingBound(NamedTuple):
    """Distance of a joint from its setpoint that is normal: at rest [rad], and as a lag [s] at its velocity limit."""

    at_rest: float
    lag_s: float


class Following:
    """The recent setpoints, with which the arm's place is compared: each state with the setpoint of its own time.

    A servo closes a gap at its own pace, which no limit of ours slows down: a lag of T behind a joint's velocity limit
    is closed at less than that velocity from rest. So the setpoint waits for an arm that falls further behind.
    """

    def __init__(self, bound: FollowingBound) -> None:
        self._bound = bound
        self._setpoints: deque[tuple[float, Vector]] = deque()
        self._waited_s, self._wait_left_s = 0.0, 0.0
        self.behind: Vector = np.zeros(6)  # [rad], the most of this waiting, else of the newest state

    @property
    def is_lost(self) -> bool:
        """Whether the arm was too far behind for too long."""
        return self._waited_s > PATIENCE_S

    def restart(self) -> None:
        """Forget the setpoints: a person has led the arm."""
        self._setpoints.clear()

    def must_wait(self, now_s: float, limiter: MotionLimiter, seen_s: float, seen: Vector, dt: float) -> bool:
        """Note the present setpoint; return whether the next must go back to where the arm was seen."""
        self._setpoints.append((now_s, limiter.position))
        most = self._bound.at_rest + self._bound.lag_s * limiter.velocity_limits
        while len(self._setpoints) > 1 and self._setpoints[1][0] <= min(seen_s, now_s - KEPT_S):
            self._setpoints.popleft()
        then = next((one for at_s, one in reversed(self._setpoints) if at_s <= seen_s), self._setpoints[0][1])
        behind = np.abs(then - seen)
        self.behind = np.maximum(behind, self.behind) if self._wait_left_s > 0.0 else behind
        if (behind > most).any():
            self._wait_left_s = max(self._wait_left_s, WAIT_S)
        elif (behind > 0.5 * most).any() and self._wait_left_s > 0.0:
            self._wait_left_s = max(self._wait_left_s, dt)
        is_waiting = self._wait_left_s > 0.0
        self._wait_left_s = max(0.0, self._wait_left_s - dt)
        self._waited_s = max(0.0, self._waited_s + (dt if is_waiting else -FORGIVEN * dt))
        return is_waiting
