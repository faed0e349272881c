"""What stands before Ray Serve's own request handling in a replica: a gate, and one header.

The gate turns requests away while the replica has more than it takes on (`admission.py`), before Serve spends on them
what an answer costs; it is open in Serve's proxies, which take nothing on.

Serve watches every HTTP request for the client hanging up, so that long work can be cancelled. A policy answers before
anything could be cancelled. The header `x-request-disconnect-disabled` is Serve's switch for that (ray 2.60), worth two
asyncio tasks a request. Replies leave in one write (`joined.py`).

`RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH=rlservo.serve_app.ingress:middlewares` puts it in place. It is imported by
Serve's proxies as well, so it needs nothing but starlette.
"""

from __future__ import annotations

from collections.abc import Callable

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.serve_app.joined import join_writes

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


class Ingress:
    """Looks at every HTTP request; WebSockets pass untouched, they need their disconnects."""

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
                join_writes(send)
        await self._app(scope, receive, send)


def middlewares() -> list[Middleware]:
    """Return what Serve puts around each HTTP server it starts."""
    return [Middleware(Ingress)]
