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

from rlservo.serve_app.ray_serve.busy_polling import polling

MOST_HELD = 16  # replies: the first of them waits for the last
INFORMATIONAL = b"HTTP/1.1 1"  # 100 Continue: the client waits for it before it sends the body


class Turn(threading.local):
    """The replies of one turn of this thread's event loop."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._replies = 0
        self._several = False  # in the turn before
        self._held: list[tuple[Any, bytes]] = []

    def write(self, transport: Any, reply: bytes) -> None:
        """Write a reply, now or at the end of the turn."""
        loop = asyncio.get_running_loop()
        if self._loop is not loop:  # the first, or the one before has ended and taken its connections with it
            self._loop, self._replies, self._several, self._held = loop, 0, False, []
        if not self._several:
            transport.write(reply)
        else:
            self._held.append((transport, reply))
            if len(self._held) == MOST_HELD:
                self.flush()
        # After the write: the client waits for it.
        if self._replies == 0:
            loop.call_soon(self._end)
        self._replies += 1
        polling.note_reply(transport)

    def flush(self) -> None:
        """Write what is held."""
        held, self._held = self._held, []
        for transport, reply in held:
            if not transport.is_closing():
                transport.write(reply)

    def _end(self) -> None:
        self._several, self._replies = self._replies > 1, 0
        self.flush()


turn = Turn()


class JoinedWrites:
    """A connection's transport for replies: holds the head until the first piece of the body, writes both at once."""

    __slots__ = ("_transport", "head")

    def __init__(self, transport: Any) -> None:
        self._transport = transport
        self.head: bytes | None = None
        """The reply's head, while it is held: None before it came (set so to begin a reply), empty once written."""

    def write(self, data: bytes) -> None:
        """Write, or hold the head."""
        head = self.head
        if head:
            self.head = b""
            turn.write(self._transport, head + data)
        elif head is None and not data.startswith(INFORMATIONAL):
            self.head = data
        else:
            if data:
                turn.flush()  # what comes before this may be held
            self._transport.write(data)

    def close(self) -> None:
        """Write what is held and close."""
        turn.flush()
        if self.head:
            self._transport.write(self.head)
            self.head = b""
        self._transport.close()

    def __getattr__(self, name: str) -> Any:
        """Leave everything else to the transport."""
        return getattr(self._transport, name)
