"""Detection of a blocked event loop: a stopped process, a long computation, a starved machine.

What is read right after that has waited for an unknown time, up to all of it.
"""

from __future__ import annotations

import asyncio
import logging
import time

logger = logging.getLogger(__name__)

TICK_S = 0.05
SETTLE_S = 0.1  # of a loop that turns again, in which it reads what had waited


class LoopClock:
    """Ticks in the event loop, and remembers when it did so late."""

    def __init__(self, limit_s: float) -> None:
        """Take a tick that is later than `limit_s` for a loop that stood still."""
        self._limit_s = limit_s
        self._loop: asyncio.AbstractEventLoop | None = None
        self.next_tick = float("inf")
        """When it is due, by `time.perf_counter`; the clock does not run yet."""
        self.unknown_until = 0.0
        """Until then it is unknown how long what is read had waited."""

    def start(self) -> None:
        """Tick in the running event loop from now on."""
        self._loop = asyncio.get_running_loop()
        self.next_tick = time.perf_counter()
        self._tick()

    def _tick(self) -> None:
        now = time.perf_counter()
        behind = now - self.next_tick
        if behind > self._limit_s:
            logger.warning("the event loop was blocked for %.1f s: requests that waited meanwhile are refused", behind)
            self.unknown_until = now + SETTLE_S
        elif now < self.unknown_until and behind > TICK_S:  # still reading
            self.unknown_until = now + SETTLE_S
        self.next_tick = now + TICK_S
        assert self._loop is not None
        self._loop.call_later(TICK_S, self._tick)
