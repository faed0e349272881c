"""What stands before Ray Serve's own request handling in a replica: one header, worth two asyncio tasks a request.

Serve watches every HTTP request for the client hanging up, so that long work can be cancelled. A policy answers before
anything could be cancelled. The header `x-request-disconnect-disabled` is Serve's switch for that (ray 2.60), and
`RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH=rlservo.serve_app.ingress:middlewares` sets it on the server's side. It is
imported by Serve's proxies as well, so it needs nothing but starlette. Replies leave in one write (`joined.py`).
"""

from __future__ import annotations

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.serve_app.joined import join_writes

HEADER = (b"x-request-disconnect-disabled", b"?1")


class WithoutDisconnectWatch:
    """Adds the header to every HTTP request; a WebSocket needs its disconnects."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            scope["headers"] = [*scope["headers"], HEADER]
            if scope["method"] == "POST":
                join_writes(send)
        await self._app(scope, receive, send)


def middlewares() -> list[Middleware]:
    """Return what Serve puts around each HTTP server it starts."""
    return [Middleware(WithoutDisconnectWatch)]
