"""One write for a reply's head and body.

uvicorn writes the two one after the other, so the proxy, and then the client, may wake up and read twice for a reply of
300 bytes. It knows uvicorn's own object for a request (0.54); where it finds another, replies are written as before.
"""

from __future__ import annotations

from typing import Any

from starlette.types import Send

INFORMATIONAL = b"HTTP/1.1 1"  # 100 Continue: the client waits for it before it sends the body


def join_writes(send: Send) -> None:
    """Make the reply behind `send` one write. Not for HEAD: there is no body for its head to wait for."""
    cycle = getattr(send, "__self__", None)
    transport = getattr(cycle, "transport", None)
    if transport is not None:
        cycle.transport = JoinedWrites(transport)  # type: ignore[union-attr]  # it has the attribute


class JoinedWrites:
    """One reply's transport: holds the head back until the first piece of the body, and writes both at once."""

    __slots__ = ("_head", "_transport")

    def __init__(self, transport: Any) -> None:
        self._transport = transport
        self._head: bytes | None = None  # None before the head, empty after it

    def write(self, data: bytes) -> None:
        """Write, or hold the head."""
        head = self._head
        if head:
            self._head = b""
            self._transport.write(head + data)
        elif head is None and not data.startswith(INFORMATIONAL):
            self._head = data
        else:
            self._transport.write(data)

    def close(self) -> None:
        """Write what is held and close: the application failed between head and body."""
        if self._head:
            self._transport.write(self._head)
            self._head = b""
        self._transport.close()

    def __getattr__(self, name: str) -> Any:
        """Leave everything else to the transport."""
        return getattr(self._transport, name)
