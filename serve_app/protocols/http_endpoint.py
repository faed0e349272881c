"""HTTP: route and checks of every connection, then body and answer of a request for actions.

FastAPI's middleware, dependencies and responses cost more than a policy does, so `PolicyApp` finds a request's route
itself and, for actions, answers by a `HttpEndpoint`: a bare ASGI callable with the protocol's codec. Everything runs
in the event loop: a decision takes microseconds, a hop to a thread takes more.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import secrets
import sys
import time
from collections.abc import Awaitable, Mapping
from functools import partial
from typing import Any, NamedTuple

from fastapi import FastAPI
from starlette.routing import BaseRoute, Match
from starlette.types import Message, Receive, Scope, Send

from rlservo.export.contract.errors import ForbiddenError, RateLimitError, RlservoError, UnknownPolicyError
from rlservo.serve_app.episodes.request import Request
from rlservo.serve_app.protocols.direct_routes import PostRoute, StreamRoute
from rlservo.serve_app.protocols.http_errors import (
    Headers,
    error_answer,
    http_error,
    refuse_upgrade,
    send_error,
    too_large,
)
from rlservo.serve_app.server.access_checks import (
    HEADERS,
    LABEL,
    PATH,
    REPLY_HEADERS,
    REQUEST_ID,
    AccessChecks,
    check_path,
    fold_headers,
    header_text,
)
from rlservo.serve_app.server.api_keys import Access, access_of
from rlservo.serve_app.server.audit import AUDIT, AuditEntry
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.request_log import FIELDS
from rlservo.serve_app.server.request_path import ClientGoneError, Codec
from rlservo.serve_app.wire.request_stamp import STAMP

logger = logging.getLogger(__name__)

PATHS_REMEMBERED, LONGEST_REMEMBERED = 1024, 512  # the longest that a name and a version can make is 170
HANG_UP_TURNS = 4
TURNS, TURN_S = 4, 0.005  # of the event loop, for what has arrived and not been read
STAMP_HEADER = STAMP.encode()
ROOT = "/"  # a page for browsers (`status_page.py`), nothing for programs

# In a connection's scope, where its server has them:
REPLY = "rlservo.reply"  # writes (status, headers, body) at once, False where that has to wait
AT_ONCE = "rlservo.at_once"  # takes what answers a WebSocket's message, for one that comes while it is waited for

Body = bytes | bytearray

PROCESS = secrets.token_hex(8).encode()
numbers = itertools.count(1)


class DirectMatch(NamedTuple):
    """A direct route and the parameters in its path."""

    route: PostRoute | StreamRoute
    params: dict[str, str]


class PolicyApp(FastAPI):
    """A FastAPI application that finds each connection's route itself, lets the route decide who may use it, and
    answers requests for actions and streams before its middleware and router see them.

    Those cost as much again as the request does (measured: a sixth of the round trip). A path that no route has never
    reaches FastAPI.
    """

    def __init__(self, core: Core, checks: AccessChecks, **options: Any) -> None:
        super().__init__(**options)
        self._core = core
        self._checks = checks
        self._direct: dict[str, list[PostRoute | StreamRoute]] = {"POST": [], "WEBSOCKET": []}
        self._matches: dict[tuple[str, str], DirectMatch] = {}
        self._mount: str | None = None  # the paths' prefix, which the first request that Serve brings tells
        self.offer: Headers = ()
        """Headers of replies that went by a proxy: where there is a way without it (`wire/direct_offer.py`)."""

    def add_direct(self, route: PostRoute | StreamRoute) -> None:
        """Add a route that is answered without FastAPI, which only documents it."""
        self.router.routes.append(route)
        self._direct["POST" if isinstance(route, PostRoute) else "WEBSOCKET"].append(route)

    def find_ahead(self, scope: Scope) -> DirectMatch | None:
        """Return the direct route of a connection that Serve has not handled yet; None is for Serve to handle."""
        mount, path = self._mount, scope["path"]
        return None if mount is None or not path.startswith(mount) else self.find_direct(scope, path[len(mount) :])

    def admit_ahead(self) -> bool:
        """Return whether such a request may be read; if not, count it as turned away."""
        return self._core.admission.admit_unread()

    def answer_ahead(self, match: DirectMatch, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        """Answer as Serve would have it answered: under its prefix, and with the request's id on the reply."""
        scope["root_path"] = self._mount
        return self.answer_found(match, scope, receive, send, offer=self.offer)

    async def answer_found(
        self, match: DirectMatch, scope: Scope, receive: Receive, send: Send, *, offer: Headers = ()
    ) -> None:
        """Answer by a direct route, with the request's id and an `offer` on the reply."""
        headers = fold_headers(scope["headers"])
        request_id = headers.setdefault(REQUEST_ID, b"%s-%x" % (PROCESS, next(numbers)))
        scope[REPLY_HEADERS] = ((REQUEST_ID, request_id), *offer)
        try:
            await self._answer_direct(match, headers, scope, receive, send)
        except Exception:  # a fault outside what the request path guards; Serve keeps uvicorn from logging it
            logger.exception("a request failed", extra={FIELDS: {"request_id": request_id.decode("latin-1")}})
            raise

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch one ASGI connection."""
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        self._mount = scope.get("root_path", "")
        scope[REPLY_HEADERS] = self.offer  # also to a stream that began before the prefix was known
        await self.answer(scope, receive, send)

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one ASGI connection under the prefix that it has."""
        path, headers = route_path(scope), fold_headers(scope["headers"])
        match = self.find_direct(scope, path)
        if match is not None:
            await self._answer_direct(match, headers, scope, receive, send)
            return
        method, request_id = scope.get("method", ""), header_text(headers, REQUEST_ID)
        entry = scope[AUDIT] = AuditEntry(method, path, peer_of(scope), request_id)
        try:
            await self._answer_routed(entry, path, headers, scope, receive, send)
        finally:
            entry.write()

    async def _answer_routed(
        self, entry: AuditEntry, path: str, headers: dict[bytes, bytes], scope: Scope, receive: Receive, send: Send
    ) -> None:
        try:
            check_path(scope, path)
            route, access = self._find(scope)
            entry.is_administration = access is Access.admin
            key = self._checks.check(scope, headers, access)
            entry.key = "" if key is None else key.label
            scope[HEADERS] = headers
            if scope["type"] == "websocket":
                sentence = f"no stream is at {path[:200]}: connect to /v1/policies/NAME/stream"
                await _send_refusal(scope, receive, send, UnknownPolicyError(sentence))
                return
            if route is None:
                varying = {"Vary": "Accept"} if path == ROOT else None
                await http_error(404, scope, headers=varying)(scope, receive, send)
                return
            body = await receive_body(self._core, headers, receive)
        except RlservoError as error:
            entry.code = error.code
            if isinstance(error, ForbiddenError | RateLimitError):
                entry.key = entry.key or error.key
            await self._refuse(scope, headers, receive, send, error)
        except ClientGoneError:
            return
        else:
            await super().__call__(scope, replay(body, receive), send)

    async def _answer_direct(
        self, match: DirectMatch, headers: dict[bytes, bytes], scope: Scope, receive: Receive, send: Send
    ) -> None:
        try:
            if b"%" in (scope.get("raw_path") or b""):
                check_path(scope, scope["path"])
            self._checks.check(scope, headers, match.route.access)
        except RlservoError as error:
            await self._refuse(scope, headers, receive, send, error)
            return
        scope[HEADERS], scope["path_params"] = headers, match.params
        await match.route.app(scope, receive, send)

    async def _refuse(
        self, scope: Scope, headers: Mapping[bytes, bytes], receive: Receive, send: Send, error: RlservoError
    ) -> None:
        request = Request(scope["type"], "", None, time.perf_counter(), request_id=header_text(headers, REQUEST_ID))
        self._core.record_failure(request, error.code, error.message, peer=peer_of(scope))
        await _send_refusal(scope, receive, send, error)

    def find_direct(self, scope: Scope, path: str) -> DirectMatch | None:
        """Return the direct route of a usable path below the prefix."""
        kind = scope["method"] if scope["type"] == "http" else "WEBSOCKET"
        found = self._matches.get((kind, path))
        if found is None and len(path) <= LONGEST_REMEMBERED and PATH.fullmatch(path) is not None:
            for route in self._direct.get(kind, ()):
                match = route.path_regex.fullmatch(path)
                if match is not None:
                    if len(self._matches) >= PATHS_REMEMBERED:
                        self._matches.clear()
                    found = self._matches[kind, path] = DirectMatch(route, match.groupdict())
                    break
        return found

    def _find(self, scope: Scope) -> tuple[BaseRoute | None, Access]:
        """Return (the route that FastAPI will take, who may use it).

        A path with another method is guarded as its most guarded route is; one without any is for whoever has a key.
        """
        others: list[BaseRoute] = []
        for route in self.router.routes:
            match, _ = route.matches(scope)
            if match is Match.FULL:
                return route, access_of(route)
            if match is Match.PARTIAL:
                others.append(route)
        if not others:
            return None, Access.act
        levels = {access_of(route) for route in others}
        return others[0], next(level for level in (Access.admin, Access.act, Access.open) if level in levels)


class HttpEndpoint:
    """Answers the POST requests of one protocol."""

    def __init__(self, protocol: str, codec: Codec[Receive, tuple[bytes, Headers]], core: Core) -> None:
        """Take the protocol's name, as metrics and log have it."""
        self._protocol = protocol
        self._codec = codec
        self._core = core

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, errors included."""
        headers, params = scope[HEADERS], scope["path_params"]
        request = Request(
            self._protocol,
            params["name"],
            params.get("version"),
            time.perf_counter(),
            label=header_text(headers, LABEL),
            request_id=header_text(headers, REQUEST_ID),
            headers=headers,
            waited=self._core.admission.waited(headers.get(STAMP_HEADER)),
            connection=client if (client := scope.get("client")) is not None and client[1] else None,  # a proxy's has 0
            has_hung_up=partial(has_hung_up, receive),
        )
        status = 200
        try:
            content, reply_headers = await self._core.answer(self._codec, request, receive)
        except RlservoError as error:
            status, content, reply_headers = error_answer(error)
        except ClientGoneError:
            return
        length = (b"content-length", b"%d" % len(content))
        every = [length, *reply_headers, *scope.get(REPLY_HEADERS, ())]
        reply = scope.pop(REPLY, None)
        if reply is not None and reply(status, every, content):
            return
        await send({"type": "http.response.start", "status": status, "headers": every})
        await send({"type": "http.response.body", "body": content})


async def has_hung_up(receive: Receive) -> bool:
    """Return whether the client of a request that was read to its end has closed its connection.

    What has arrived of that takes a turn of the event loop to be read, one to close the connection, and two to be heard
    of here.
    """
    message = asyncio.ensure_future(receive())
    for _ in range(HANG_UP_TURNS):
        await asyncio.sleep(0)
    if not message.done():
        message.cancel()
        return False
    return bool(message.result()["type"] == "http.disconnect")


class WholeBody:
    """The `receive` of a request all of which has come."""

    __slots__ = ("_receive", "body")

    def __init__(self, body: bytes, receive: Receive) -> None:
        self.body: bytes | None = body
        self._receive = receive

    async def __call__(self) -> Message:
        """Return the body, and then what else comes."""
        body, self.body = self.body, None
        if body is None:
            return await self._receive()
        return {"type": "http.request", "body": body, "more_body": False}


async def receive_body(core: Core, headers: Mapping[bytes, bytes], receive: Receive) -> Body:
    """Return a request's body within the server's limits. The first message usually holds all of it.

    The one way in which a body gets into this process. Raises TooLargeError, DeadlineError, OverloadedError and
    ClientGoneError.
    """
    max_bytes, timeout_s = core.settings.max_body_bytes, core.settings.body_timeout_s
    length = headers.get(b"content-length", b"")
    if length.isdigit() and len(length) < 20 and int(length) > max_bytes:
        raise too_large(max_bytes)
    if isinstance(receive, WholeBody) and receive.body is not None:  # nothing to wait for, and so no time-out
        if len(receive.body) > max_bytes:
            raise too_large(max_bytes)
        return receive.body
    admission = core.admission
    given_s = admission.begin_body(timeout_s)
    timer = _BodyTimer(given_s)
    try:
        message = await receive()
        body = message.get("body", b"")
        if message.get("more_body", False):
            body = bytearray(body)
            while message.get("more_body", False):
                timer.pieces += 1
                message = await receive()
                body += message.get("body", b"")
                if len(body) > max_bytes:
                    break
    except asyncio.CancelledError:
        if not timer.late:
            raise
        if sys.version_info >= (3, 11) and (task := asyncio.current_task()) is not None:  # it counts cancellations
            task.uncancel()
        raise admission.late_body(timeout_s, given_s) from None
    finally:
        timer.stop()
        admission.end_body()
    if message["type"] == "http.disconnect":
        raise ClientGoneError
    if len(body) > max_bytes:
        raise too_large(max_bytes)
    return body  # type: ignore[no-any-return]  # ASGI messages are untyped


class _BodyTimer:
    """Cancels the current task when a body's time is over and nothing more of it comes.

    On a starved process the clock can pass the time before the loop has read what has long arrived (uvloop even looks
    at its timers first). So when the time is over, the loop gets a few turns, in each of which it reads, and as many
    again for every piece that they bring; for as long again as the time was, at most.
    """

    __slots__ = ("_handle", "_last", "_loop", "_quiet", "_seconds", "_seen", "_task", "late", "pieces")

    def __init__(self, seconds: float) -> None:
        self._loop = asyncio.get_running_loop()
        self._task = asyncio.current_task()
        self._handle = self._loop.call_later(seconds, self._check)
        self._seconds = seconds
        self._last = 0.0  # when the time is over whatever comes: as long again, from the first check on
        self._quiet = self._seen = 0
        self.pieces = 0
        self.late = False

    def stop(self) -> None:
        """Never cancel the task."""
        self._handle.cancel()

    def _check(self) -> None:
        now = self._loop.time()
        self._last = self._last or now + self._seconds
        if self.pieces != self._seen and now < self._last:
            self._seen, self._quiet = self.pieces, 0
        if self._quiet < TURNS:
            self._quiet += 1
            self._handle = self._loop.call_later(TURN_S, self._check)
        elif self._task is not None:
            self.late = True
            self._task.cancel()


async def _send_refusal(scope: Scope, receive: Receive, send: Send, error: RlservoError) -> None:
    headers = scope.get(REPLY_HEADERS, ())
    if scope["type"] == "http":
        await send_error(send, error, headers=headers)
    else:
        await refuse_upgrade(scope, receive, send, error, headers)


def replay(body: Body, receive: Receive) -> Receive:
    """Return a `receive` that gives a body that has been read, and then what else comes."""
    messages: list[Message] = [{"type": "http.request", "body": bytes(body), "more_body": False}]

    async def receive_again() -> Message:
        return messages.pop() if messages else await receive()

    return receive_again


def route_path(scope: Scope) -> str:
    """Return a connection's path below the prefix that the application is mounted at, as Starlette's routes see it."""
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    below = path[len(root) :]
    return below if path.startswith(root) and below[:1] in ("", "/") else path


def peer_of(scope: Scope) -> str | None:
    """Return the client's address; behind HAProxy uvicorn takes it from `X-Forwarded-For`, which HAProxy adds."""
    client = scope.get("client")
    return None if client is None else str(client[0])
