"""Delay of messages whose stamps come from another clock: how much longer than usual one took."""

from __future__ import annotations

import math

CREEP = 0.001  # [s/s], drift between two clocks; a delay that grows faster is the link's


class LinkDelay:
    """The shortest delay of a link so far, with the difference between the clocks in it."""

    def __init__(self) -> None:
        self._usual_s, self._before_s = math.inf, 0.0

    def excess_s(self, stamp_s: float, now_s: float) -> float:
        """Return by how much [s] a message that was made at `stamp_s` and came at `now_s` is later than usual."""
        offset_s = now_s - stamp_s
        self._usual_s = min(offset_s, self._usual_s + CREEP * (now_s - self._before_s))
        self._before_s = now_s
        return offset_s - self._usual_s
