"""Busy polling: after a reply, look for the next request for a moment before the event loop sleeps.

A thread that sleeps costs the next request its way back: on a virtual machine the core itself has stopped, and what
wakes it goes by way of the host (28 us of the 143 that one JSON request took). A client that asks again at once finds
this thread awake. Where nothing comes in that moment, the next replies do without, twice as many after each failure: a
robot's fifty requests a second cost one moment in `MOST_SKIPPED`. Where several clients ask in turn, `joined_writes.py`
does not begin: on busy cores they would pay for each other's moments.
"""

from __future__ import annotations

import asyncio
import time

AWAKE_S = 120e-6
MOST_SKIPPED = 64  # replies


class BusyPolling:
    """Keeps one event loop awake for a moment."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._until = 0.0
        self._paid = False
        self._to_skip = self._skipped = 0

    def begin(self) -> None:
        """Keep awake from now on, unless that has been for nothing lately."""
        if self._skipped < self._to_skip:
            self._skipped += 1
            return
        self._paid = False
        self._until = time.perf_counter() + AWAKE_S
        self._loop.call_soon(self._poll)

    def note_answer(self) -> None:
        """A request has come, and was answered."""
        self._paid = True

    def _poll(self) -> None:
        """Let the loop look at its sockets once more: it does not sleep while something is to be called."""
        if self._paid:
            self._to_skip = 0
        elif time.perf_counter() < self._until:
            self._loop.call_soon(self._poll)
        else:
            self._to_skip, self._skipped = min(2 * self._to_skip + 1, MOST_SKIPPED), 0
