"""Coalesce socket writes: a reply's head and body together, under load all replies of one loop turn.

uvicorn writes the two one after the other, so the proxy, and then the client, may wake up and read twice for a reply of
300 bytes. When many ask at the same time, a reply that is written wakes the proxy while the next one is computed, and
it sleeps again: written one after the other at the end of the turn, they are one wake-up. A single caller does not wait
for that: replies are held back only when the turn before had several.

`http_connections.py` gives each connection one, and begins it anew with each request.
"""

from __future__ import annotations

import asyncio
import threading
from typing import Any

from rlservo.serve_app.ray_serve.busy_polling import BusyPolling, Connection

MOST_HELD = 16  # replies: the first of them waits for the last
INFORMATIONAL = b"HTTP/1.1 1"  # 100 Continue: the client waits for it before it sends the body


class Turn:
    """The replies of one turn of an event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.polling = BusyPolling(loop)
        self._replies = 0
        self._several = False  # in the turn before
        self._held: list[tuple[Any, bytes]] = []

    def write(self, connection: Connection, transport: Any, reply: bytes) -> None:
        """Write a connection's reply, now or at the end of the turn."""
        if not self._several:
            transport.write(reply)
        else:
            self._held.append((transport, reply))
            if len(self._held) == MOST_HELD:
                self.flush()
        # After the write: the client waits for it.
        if self._replies == 0:
            self.loop.call_soon(self._end)
        self._replies += 1
        self.polling.note_reply(connection)

    def flush(self) -> None:
        """Write what is held."""
        held, self._held = self._held, []
        for transport, reply in held:
            if not transport.is_closing():
                transport.write(reply)

    def _end(self) -> None:
        self._several, self._replies = self._replies > 1, 0
        self.flush()


class _Latest(threading.local):
    turn: Turn | None = None


_latest = _Latest()


def turn_of(loop: asyncio.AbstractEventLoop) -> Turn:
    """Return what all connections of an event loop share, which runs in this thread."""
    found = _latest.turn
    if found is None or found.loop is not loop:  # the first, or the one before has ended
        found = _latest.turn = Turn(loop)
    return found


class JoinedWrites:
    """A connection's transport for replies: holds the head until the first piece of the body, writes both at once."""

    __slots__ = ("_connection", "_transport", "_turn", "head")

    def __init__(self, connection: Connection, transport: Any, turn: Turn) -> None:
        self._connection, self._transport, self._turn = connection, transport, turn
        self.head: bytes | None = None
        """The reply's head, while it is held: None before it came (set so to begin a reply), empty once written."""

    def write(self, data: bytes) -> None:
        """Write, or hold the head."""
        head = self.head
        if head:
            self.head = b""
            self._turn.write(self._connection, self._transport, head + data)
        elif head is None and not data.startswith(INFORMATIONAL):
            self.head = data
        else:
            if data:
                self._turn.flush()  # what comes before this may be held
            self._transport.write(data)

    def close(self) -> None:
        """Write what is held and close."""
        self._turn.flush()
        if self.head:
            self._transport.write(self.head)
            self.head = b""
        self._transport.close()

    def __getattr__(self, name: str) -> Any:
        """Leave everything else to the transport."""
        return getattr(self._transport, name)
