"""Control law of every robot, arm or base: whether it moves or holds, how its speed blends in, and what is counted."""

from __future__ import annotations

from collections import Counter
from enum import IntEnum


class Order(IntEnum):
    """Order to a robot."""

    HOLD = 0
    FOLLOW = 1  # follow setpoints while new ones come
    GO = 2  # move to a pose, slowly
    FREE = 3  # let a person lead it


class Phase(IntEnum):
    """What the robot does now."""

    HOLD = 0
    FOLLOW = 1
    LATE = 2  # holds, because no setpoint has come
    STALE = 3  # holds, because the newest state is too old
    GO = 4
    FREE = 5
    FAULT = 6
    BEHIND = 7  # waits, because the arm is too far behind its setpoint


INTERRUPTED = {
    "stale_observation": Phase.STALE, "late_setpoint": Phase.LATE, "deadman_released": Phase.LATE,
    "following_error": Phase.BEHIND,
}  # fmt: skip


class ControlLaw:
    """The phase, and the policy's share of the speed: it grows from 0 while the robot moves, and falls while not."""

    def __init__(self, *, setpoint_timeout_s: float, blend_s: float, forget_s: float) -> None:
        """Let the share grow to 1 in `blend_s` and fall to 0 in `forget_s` [s]; 0: at once."""
        self.phase, self.blend = Phase.HOLD, 0.0
        self.counts: Counter[str] = Counter()  # of interruptions
        self._setpoint_timeout_s, self._blend_s, self._forget_s = setpoint_timeout_s, blend_s, forget_s
        self._blend_from_s = 0.0

    def decide(
        self, order: Order, *, passed_s: float, blend_from_s: float, setpoint_age_s: float, is_stale: bool, other: str
    ) -> None:
        """Set phase and share for the next command, `passed_s` [s] after the last, and count an interruption once.

        A new `blend_from_s` begins the share again: at 0, or at 1 if it is negative. `other` is one more of INTERRUPTED
        that holds now, or empty.
        """
        if self.phase in (Phase.FOLLOW, Phase.GO):
            self.blend = min(self.blend + (passed_s / self._blend_s if self._blend_s else 1.0), 1.0)
        else:
            self.blend = max(self.blend - (passed_s / self._forget_s if self._forget_s else 1.0), 0.0)
        if blend_from_s != self._blend_from_s:
            self._blend_from_s, self.blend = blend_from_s, float(blend_from_s < 0.0)
        if not self._blend_s:
            self.blend = 1.0
        phase = Phase[order.name]
        if phase in (Phase.FOLLOW, Phase.GO):
            is_late = setpoint_age_s > self._setpoint_timeout_s
            if why := "stale_observation" if is_stale else "late_setpoint" if is_late else other:
                phase = INTERRUPTED[why]
                self.counts[why] += phase != self.phase
        self.phase = phase
