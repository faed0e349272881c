"""What stands before Ray Serve's own request handling in a replica: a gate, one header and one write.

The gate turns requests away while the replica has more than it takes on (`admission.py`), before Serve spends on them
what an answer costs; it is open in Serve's proxies, which take nothing on.

Serve watches every HTTP request for the client hanging up, so that long work can be cancelled. A policy answers before
anything could be cancelled. The header `x-request-disconnect-disabled` is Serve's switch for that (ray 2.60), worth two
asyncio tasks a request.

uvicorn writes a reply's head and its body one after the other, so the proxy, and then the client, may wake up and read
twice for a reply of 300 bytes. `JoinedWrites` makes it one write.

`RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH=rlservo.serve_app.ingress:middlewares` puts them in place. It is imported by
Serve's proxies as well, so it needs nothing but starlette.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

FULL = b'{"error":"this replica has as many requests as it takes on: try again shortly","code":"over-capacity"}'
TURNED_AWAY = [
    (b"content-type", b"application/json"),
    (b"content-length", b"%d" % len(FULL)),
    (b"retry-after", b"1"),
]
HEADER = (b"x-request-disconnect-disabled", b"?1")


class Gate:
    """Tells whether a request may come in; the replica puts its own rule here."""

    def __init__(self) -> None:
        self.is_open: Callable[[], bool] = _always


def _always() -> bool:
    return True


gate = Gate()

INFORMATIONAL = b"HTTP/1.1 1"  # 100 Continue: the client waits for it before it sends the body


class Ingress:
    """Looks at every HTTP request, and joins the writes of replies to POST; WebSockets pass untouched."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            scope["headers"] = [*scope["headers"], HEADER]
            if scope["method"] == "POST":
                # Everything else is cheap, and health has to be told under load, too.
                if not gate.is_open():
                    await send({"type": "http.response.start", "status": 503, "headers": TURNED_AWAY})
                    await send({"type": "http.response.body", "body": FULL})
                    return
                # uvicorn's own object for this request (0.54); where `send` is something else, nothing is joined.
                cycle = getattr(send, "__self__", None)
                transport = getattr(cycle, "transport", None)
                if transport is not None:
                    cycle.transport = JoinedWrites(transport)  # type: ignore[union-attr]  # it has the attribute
        await self._app(scope, receive, send)


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


def middlewares() -> list[Middleware]:
    """Return what Serve puts around each HTTP server it starts."""
    return [Middleware(Ingress)]
