"""Busy polling: after a reply, look for the next request for a moment before the event loop sleeps.

A thread that sleeps costs the next request its way back: on a virtual machine the core itself has stopped, and what
wakes it goes by way of the host (28 us of the 143 that one JSON request took). A client that asks again at once finds
this thread awake. So it is after a turn of the event loop with one reply, to the client of the turn before: of several
clients on busy cores each would pay for the others' moments. HAProxy sends each request over whichever of its
connections was idle for longest, so it says in the request's stamp whose it is. Where the client does not ask in the
moment, the next replies do without, twice as many after each failure: a robot's fifty requests a second cost one moment
in `MOST_SKIPPED` replies.
"""

from __future__ import annotations

import asyncio
import time
from typing import Protocol

AWAKE_S = 160e-6
MOST_SKIPPED = 64  # replies


class Connection(Protocol):
    """What replies are written to."""

    def client_id(self) -> object:
        """Return what tells the client apart from others."""
        ...


class BusyPolling:
    """Keeps an event loop awake for a moment."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._replies = 0  # of this turn
        self._client: object = None  # whom the last turn replied to first
        self._is_same = False
        self._until = 0.0
        self._to_skip = self._skipped = 0

    def note_reply(self, connection: Connection) -> None:
        """Take note of a reply on a connection."""
        if self._replies == 0:
            self._loop.call_soon(self._end_turn)
            client = connection.client_id()
            self._is_same, self._client = client == self._client, client
        self._replies += 1

    def _end_turn(self) -> None:
        is_single, self._replies = self._replies == 1, 0
        if not (is_single and self._is_same):
            return
        if self._skipped < self._to_skip:
            self._skipped += 1
            return
        self._until = time.perf_counter() + AWAKE_S
        self._loop.call_soon(self._poll)

    def _poll(self) -> None:
        """Let the loop look at its sockets once more: it does not sleep while something is to be called."""
        if self._replies and self._is_same:
            self._to_skip //= 2
        elif not self._replies and time.perf_counter() < self._until:
            self._loop.call_soon(self._poll)
        else:
            self._to_skip, self._skipped = min(2 * self._to_skip + 1, MOST_SKIPPED), 0
