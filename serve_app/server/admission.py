"""Admission control: turn requests away at once when a replica cannot answer them in time.

A decision runs in the event loop from its first line to its last (or pauses for the rest of its turn:
`micro_batching.py`). So requests do not wait for each other in a queue of ours: they wait as tasks that the loop has
made and not yet run. All that arrived while the loop was busy run in one turn of it, a *burst*. Its length is the
queue, its beginning when each of them had arrived at the latest. That is known for the price of one callback per burst.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rlservo.export.contract.errors import DeadlineError, OverloadedError
from rlservo.serve_app.server.request_age import Age

HURRY_S = 0.05  # [s] for a body when too many are half sent


class Admission:
    """Counts what one event loop has before it."""

    def __init__(self, *, max_queued: int, max_queue_ms: float, max_incoming: int, max_streams: int) -> None:
        """Set the limits: of a burst, of the wait in it, of bodies half sent, of streams."""
        self._max_queued = max_queued
        self._max_queue_s = max_queue_ms / 1e3
        self.age = Age(self._max_queue_s)
        self._max_incoming = max_incoming
        self._max_streams = max_streams
        self._burst = 0
        self._burst_began = 0.0
        self.incoming = 0
        self.streams = 0
        self.longest = 0  # the longest burst so far
        self.turned_away = 0  # before anybody looked at them

    def enter(self, waited: float | None = None) -> float:
        """Return when this request had arrived at the latest (`time.perf_counter`).

        `waited` is how long it did before, where that is known. Raises OverloadedError or LateError.
        """
        self.age.check(waited)
        now = time.perf_counter()
        if self._burst == 0:
            self._burst_began = now
            asyncio.get_running_loop().call_soon(self._end_burst)
        self._burst += 1
        if self._burst > self._max_queued:
            raise OverloadedError(f"more than {self._max_queued} requests are waiting in this replica: try again")
        if now - self._burst_began > self._max_queue_s:
            raise OverloadedError(
                f"requests wait longer than {self._max_queue_s * 1e3:g} ms in this replica: try again shortly"
            )
        return self._burst_began

    def is_open(self) -> bool:
        """Whether one more request would be admitted; if not, it counts as turned away."""
        if self._burst < self._max_queued:
            return True
        self.turned_away += 1
        return False

    def _end_burst(self) -> None:
        self.longest = max(self.longest, self._burst)
        self._burst = 0

    @contextmanager
    def reading(self, timeout_s: float) -> Iterator[float]:
        """Count a request whose body may still be on its way, and give the seconds it has.

        Where too many are, one whose body is not there already has to hurry. Raises OverloadedError when it did not.
        """
        full = self.incoming >= self._max_incoming
        self.incoming += 1
        try:
            yield min(timeout_s, HURRY_S) if full else timeout_s
        except DeadlineError:
            if not full:
                raise
            raise OverloadedError(
                f"{self._max_incoming} requests are still being sent to this replica: try again shortly"
            ) from None
        finally:
            self.incoming -= 1

    @contextmanager
    def streaming(self) -> Iterator[None]:
        """Count an open stream. Raises OverloadedError."""
        if self.streams >= self._max_streams:
            raise OverloadedError(f"{self.streams} streams are open in this replica: close one, or try again shortly")
        self.streams += 1
        try:
            yield
        finally:
            self.streams -= 1


class IdleTimer:
    """Cancels a task that has not been touched for a while: one callback per period instead of one timer per wait."""

    def __init__(self, seconds: float) -> None:
        """Start the clock for the current task."""
        self._seconds = seconds
        self._task = asyncio.current_task()
        self._loop = asyncio.get_running_loop()
        self._touched = self._loop.time()
        self._handle = self._loop.call_later(seconds, self._look)
        self.expired = False

    def touch(self) -> None:
        """Say that something has happened."""
        self._touched = self._loop.time()

    def stop(self) -> None:
        """Forget about it."""
        self._handle.cancel()

    def _look(self) -> None:
        left = self._touched + self._seconds - self._loop.time()
        if left > 0:
            self._handle = self._loop.call_later(left, self._look)
        elif self._task is not None:
            self.expired = True
            self._task.cancel()
