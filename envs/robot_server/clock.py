"""Clock of a robot server: a cycle ends at once (`fast`), or when its real time is over (`real`).

Either way the same calls give the same trajectory. In real time the clock waits up to half a second for a client that
does not keep pace; after that, time continues without it, as on the robot.
"""

from __future__ import annotations

import time

GRACE_S = 0.5  # [s]; the MiR100's own command timeout
MAX_CATCH_UP_S = 60.0  # [s] of simulation; after a longer silence the rest is not simulated


class Clock:
    """Pace for one robot. Not thread-safe: the service calls it under its lock, except `wait`."""

    def __init__(self, kind: str, cycle_s: float) -> None:
        self._real = kind == "real"
        self._cycle_s = cycle_s
        self._due: float | None = None  # when the last cycle ends

    def count_missed_cycles(self) -> int:
        """Return the number of cycles that passed without a command, and count them as passed."""
        if not self._real or self._due is None:
            return 0
        delay_s = time.monotonic() - self._due
        if delay_s <= GRACE_S:
            return 0
        cycles = int(delay_s / self._cycle_s)
        self._due += cycles * self._cycle_s
        return min(cycles, round(MAX_CATCH_UP_S / self._cycle_s))

    def count_cycles(self, cycles: int) -> float | None:
        """Count cycles that were simulated just now. Return the moment to `wait` for before answering."""
        if not self._real:
            return None
        now = time.monotonic()
        # A client that needs less than a cycle between calls keeps the rate exactly.
        on_time = self._due is not None and now - self._due <= self._cycle_s
        began = self._due if on_time and self._due is not None else now
        self._due = began + cycles * self._cycle_s
        return self._due

    @staticmethod
    def wait(due: float | None) -> None:
        """Sleep until a moment that `count_cycles` returned."""
        if due is not None:
            time.sleep(max(0.0, due - time.monotonic()))
