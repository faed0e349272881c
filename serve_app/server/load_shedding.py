"""Admission of requests: those that are too late, or too many for one event loop, are refused.

All requests that arrived while the loop was busy run in one turn of it, a *burst*. Its length is the queue; by its
beginning all of them had arrived. Measuring this costs one callback per burst.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import Iterator

from rlservo.errors import LateError, OverloadedError
from rlservo.serve_app.server.settings import ServerSettings

logger = logging.getLogger(__name__)

TICK_S = 0.05
SETTLE_S = 0.1  # for a loop that runs again to read what had waited


class LoadShedding:
    """Refuses requests that are too late, or too many for one event loop."""

    def __init__(self, settings: ServerSettings) -> None:
        """Take the limits: length of a burst, wait before and in it, unfinished bodies, streams."""
        self._max_queued = settings.max_ongoing_requests
        self.max_wait_s = settings.max_queue_ms / 1e3
        self._max_incoming = settings.max_incoming
        self._max_streams = settings.max_streams
        self._next_tick = float("inf")  # by time.perf_counter; infinite until the clock runs
        self._unknown_until = 0.0  # until then it is unknown how long the data being read had waited
        self._burst = 0
        self._burst_began = 0.0
        self.incoming = 0
        self.streams: Counter[str] = Counter()
        """Open streams by policy."""
        self.longest = 0  # the longest burst so far

    def start_clock(self) -> None:
        """Tick in the running event loop from now on, to notice when it was blocked."""
        self._next_tick = time.perf_counter()
        self._tick()

    def _tick(self) -> None:
        """Remember a late tick: data read after it may have waited while the process or the machine stood still."""
        now = time.perf_counter()
        behind = now - self._next_tick
        if behind > self.max_wait_s:
            logger.warning("the event loop was blocked for %.1f s: requests that waited are refused", behind)
            self._unknown_until = now + SETTLE_S
        elif now < self._unknown_until and behind > TICK_S:  # still reading
            self._unknown_until = now + SETTLE_S
        self._next_tick = now + TICK_S
        asyncio.get_running_loop().call_later(TICK_S, self._tick)

    def check_age(self) -> None:
        """Raise LateError for a request that may have waited too long to be read."""
        now = time.perf_counter()
        if now < self._unknown_until or now - self._next_tick > self.max_wait_s:
            raise LateError(
                f"the server was blocked for more than {self.max_wait_s * 1e3:g} ms, so the observation may be stale: "
                "send a newer one"
            )

    def enter(self) -> float:
        """Return the time by which this request had arrived (`time.perf_counter`).

        Raises OverloadedError or LateError.
        """
        self.check_age()
        now = time.perf_counter()
        if self._burst == 0:
            self._burst_began = now
            asyncio.get_running_loop().call_soon(self._end_burst)
        self._burst += 1
        if self._burst > self._max_queued:
            raise OverloadedError(f"more than {self._max_queued} requests are waiting in this replica: try again")
        if now - self._burst_began > self.max_wait_s:
            raise OverloadedError(
                f"requests wait longer than {self.max_wait_s * 1e3:g} ms in this replica: try again shortly"
            )
        return self._burst_began

    def _end_burst(self) -> None:
        self.longest = max(self.longest, self._burst)
        self._burst = 0

    @contextlib.contextmanager
    def reading_body(self) -> Iterator[None]:
        """Count a request whose body has arrived only in part. Raises OverloadedError."""
        if self.incoming >= self._max_incoming:
            raise OverloadedError(f"{self.incoming} requests are still being sent to this server: try again shortly")
        self.incoming += 1
        try:
            yield
        finally:
            self.incoming -= 1

    def open_stream(self, policy: str) -> None:
        """Count an open stream; its end is `streams[policy] -= 1`. Raises OverloadedError."""
        count = sum(self.streams.values())
        if count >= self._max_streams:
            raise OverloadedError(f"{count} streams are open in this replica: close one, or try again shortly")
        self.streams[policy] += 1
