"""Middleware before Ray Serve's request handling: passes requests for actions straight to the application.

Serve spends more on a request than a policy does: contexts, tasks, a request object, statistics, a line for its log. A
request for actions needs none of it. How much a replica takes on is decided by `admission.py`, who may ask by
`api_keys.py`, metrics and the log are ours, and a replica that is told to stop waits for its HTTP server, which waits
for whoever is still being answered (ray 2.60). So the door passes such requests straight to the application, and
everything else to Serve. Streams gain as well: Serve reads a WebSocket in a task of its own.

It turns such requests away, too, while the replica has more than it takes on. In Serve's proxies, and in a replica
whose application runs in another event loop than its HTTP server, the door lets everybody through to Serve.

Serve watches every HTTP request for the client hanging up, so that long work can be cancelled. The header
`x-request-disconnect-disabled` is its switch for that (ray 2.60), worth two asyncio tasks a request. Replies leave in
one write (`joined_writes.py`).

`RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH=rlservo.serve_app.ray_serve.ingress:middlewares` puts it in place. It is
imported by Serve's proxies as well, so it imports little.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import secrets
from collections.abc import Callable
from typing import Protocol

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rlservo.serve_app.ray_serve import closed_endpoints, http_connections, loopback_ports
from rlservo.serve_app.ray_serve.joined_writes import join_writes
from rlservo.serve_app.server.request_checks import mend_headers
from rlservo.serve_app.server.request_log import FIELDS

logger = logging.getLogger(__name__)

FULL = b'{"error":"this replica has as many requests as it takes on: try again shortly","code":"over-capacity"}'
TURNED_AWAY = (
    (b"content-type", b"application/json"),
    (b"content-length", b"%d" % len(FULL)),
    (b"retry-after", b"1"),
)
NOT_FOUND = (
    (b"content-type", b"application/json"),
    (b"content-length", b"%d" % len(closed_endpoints.NOTHING)),
)
NO_WATCH = (b"x-request-disconnect-disabled", b"?1")
REQUEST_ID = b"x-request-id"


class Application(Protocol):
    """Answers the requests that need nothing of what Serve does."""

    def takes(self, scope: Scope) -> bool:
        """Whether this is one of them."""
        ...

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer it."""
        ...


class Door:
    """What this process puts before Serve's handling; the replica sets it up, in a proxy it stays as it is here."""

    def __init__(self) -> None:
        """Leave everything to Serve."""
        self.app: Application | None = None
        self.ahead = False
        self.has_room: Callable[[], bool] = lambda: True
        self._loop: asyncio.AbstractEventLoop | None = None

    def open(self, app: Application, has_room: Callable[[], bool], *, ahead: bool = True) -> None:
        """From now on turn away, of what `app` takes, what there is no room for; let it answer the rest, if `ahead`.

        In this event loop.
        """
        self.app, self.ahead, self.has_room, self._loop = app, ahead, has_room, asyncio.get_running_loop()

    def takes(self, scope: Scope) -> bool:
        """Whether this is for the application to answer."""
        return self.app is not None and asyncio.get_running_loop() is self._loop and self.app.takes(scope)


door = Door()


class Ingress:
    """Looks at every HTTP request and every WebSocket."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        http = scope["type"] == "http"
        taken = door.takes(scope)
        if taken and http and not door.has_room():
            await send({"type": "http.response.start", "status": 503, "headers": list(TURNED_AWAY)})
            await send({"type": "http.response.body", "body": FULL})
            return
        if http and scope["method"] == "POST":
            join_writes(send)
        if taken and door.ahead:
            assert door.app is not None
            request_id = _identify(scope)
            try:
                await door.app.answer(scope, receive, _with_id(request_id, send) if http else send)
            except Exception:  # a bug outside what the application guards; Serve keeps uvicorn from logging it
                logger.exception("a request failed", extra={FIELDS: {"request_id": request_id.decode("latin-1")}})
                raise
            return
        headers = mend_headers(scope["headers"])
        if http:
            if closed_endpoints.is_closed(scope):
                await send({"type": "http.response.start", "status": 404, "headers": list(NOT_FOUND)})
                await send({"type": "http.response.body", "body": closed_endpoints.NOTHING})
                return
            headers = [*headers, NO_WATCH]
        scope["headers"] = headers
        await self._app(scope, receive, send)


def _identify(scope: Scope) -> bytes:
    """Return the request's id, the client's or a new one, which the request then has: what Serve would have done."""
    for name, value in scope["headers"]:
        if name == REQUEST_ID:
            return bytes(value)
    request_id = b"%s-%x" % (PROCESS, next(numbers))
    scope["headers"] = [*scope["headers"], (REQUEST_ID, request_id)]
    return request_id


def _with_id(request_id: bytes, send: Send) -> Send:
    async def send_with_id(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message["headers"], (REQUEST_ID, request_id)]
        await send(message)

    return send_with_id


PROCESS = secrets.token_hex(8).encode()
numbers = itertools.count(1)


def middlewares() -> list[Middleware]:
    """Return what Serve puts around each HTTP server it starts; it calls this before it binds the server's port."""
    http_connections.install()
    closed_endpoints.install()
    if loopback_ports.is_wanted():
        loopback_ports.install()
    return [Middleware(Ingress)]
