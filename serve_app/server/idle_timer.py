"""Timer that cancels a task in which nothing has happened for a while."""

from __future__ import annotations

import asyncio


class IdleTimer:
    """Cancels the task that made it: one callback per period instead of one timer per wait."""

    def __init__(self, seconds: float) -> None:
        """Start the clock for the current task."""
        self._seconds = seconds
        self._task = asyncio.current_task()
        self._loop = asyncio.get_running_loop()
        self._touched = self._loop.time()
        self._handle = self._loop.call_later(seconds, self._check)
        self.expired = False

    def touch(self) -> None:
        """Begin the period again."""
        self._touched = self._loop.time()

    def stop(self) -> None:
        """Never cancel the task."""
        self._handle.cancel()

    def _check(self) -> None:
        left = self._touched + self._seconds - self._loop.time()
        if left > 0:
            self._handle = self._loop.call_later(left, self._check)
        elif self._task is not None:
            self.expired = True
            self._task.cancel()
