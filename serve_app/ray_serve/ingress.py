"""Middleware before Ray Serve's request handling: passes requests for actions straight to the application.

Serve spends more on a request than a policy does: contexts, tasks, a request object, statistics, a line for its log. A
request for actions needs none of it. How much a replica takes on is decided by `request_path.py`, who may ask by
`access_checks.py`, metrics and the log are ours, and a replica that is told to stop waits for its HTTP server, which
waits for whoever is still being answered (ray 2.60). So such requests go straight to the application, and everything
else to Serve. Streams gain as well: Serve reads a WebSocket in a task of its own.

Such requests are refused, too, while the replica has more than it takes on. In Serve's proxies, and in a replica whose
application runs in another event loop than its HTTP server, everything goes to Serve.

Serve watches every HTTP request for the client hanging up, so that long work can be cancelled. The header
`x-request-disconnect-disabled` is its switch for that (ray 2.60), worth two asyncio tasks a request.

`RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH=rlservo.serve_app.ray_serve.ingress:middlewares` puts it in place. It is
imported by Serve's proxies as well, so it imports little.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Awaitable
from typing import Any, Protocol

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.serve_app.protocols.http_endpoint import AT_ONCE
from rlservo.serve_app.ray_serve import closed_endpoints, http_connections, loopback_binding
from rlservo.serve_app.server.access_checks import mend_headers

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


class Application(Protocol):
    """Answers the connections that need nothing of what Serve does."""

    def find_ahead(self, scope: Scope) -> Any | None:
        """Return the route of such a connection, None for every other."""
        ...

    def admit_ahead(self) -> bool:
        """Return whether one more request may be read; if not, count it as turned away."""
        ...

    def answer_ahead(self, match: Any, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        """Answer by the route that was found."""
        ...


class ServeBypass:
    """The application of this process, where it is a replica's."""

    def __init__(self) -> None:
        """Leave everything to Serve, as in a proxy."""
        self._app: Application | None = None
        self._thread = 0
        self.answers = False

    def install(self, app: Application, *, answers: bool = True) -> None:
        """From now on, in this thread, refuse what there is no room for, and let `app` answer, if it `answers`."""
        self._app, self._thread, self.answers = app, threading.get_ident(), answers

    def find(self, scope: Scope) -> ASGIApp | None:
        """Return what answers a connection in Serve's place, None for all that Serve handles.

        Where that is nothing but a refusal, the request counts as turned away with this call.
        """
        app = self._app
        if app is None or threading.get_ident() != self._thread:
            return None
        match = app.find_ahead(scope)
        if match is None:
            return None
        if self.answers:
            return functools.partial(_answer, app, match)
        return None if scope["type"] != "http" or app.admit_ahead() else turn_away


def _answer(app: Application, match: Any, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
    if scope["type"] == "http" and not app.admit_ahead():
        return turn_away(scope, receive, send)
    return app.answer_ahead(match, scope, receive, send)


bypass = ServeBypass()


def find_at_once(scope: Scope) -> ASGIApp | None:
    """Return what answers an HTTP request without anything that may wait, None for all others."""
    return bypass.find(scope) if bypass.answers else None


class Ingress:
    """Looks at every HTTP request and every WebSocket."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        http = scope["type"] == "http"
        if (found := bypass.find(scope)) is not None:
            await found(scope, receive, send)
            return
        headers = mend_headers(scope["headers"])
        scope.pop(AT_ONCE, None)  # Serve reads a stream itself
        if http:
            if closed_endpoints.is_closed(scope):
                await send({"type": "http.response.start", "status": 404, "headers": list(NOT_FOUND)})
                await send({"type": "http.response.body", "body": closed_endpoints.NOTHING})
                return
            headers = [*headers, NO_WATCH]
        scope["headers"] = headers
        await self._app(scope, receive, send)


async def turn_away(_scope: Scope, _receive: Receive, send: Send) -> None:
    """Answer a request that nothing is read of."""
    await send({"type": "http.response.start", "status": 503, "headers": list(TURNED_AWAY)})
    await send({"type": "http.response.body", "body": FULL})


def middlewares() -> list[Middleware]:
    """Return what Serve puts around each HTTP server it starts; it calls this before it binds the server's port."""
    http_connections.install(find_at_once)
    closed_endpoints.install()
    if loopback_binding.is_wanted():
        loopback_binding.install()
    return [Middleware(Ingress)]
