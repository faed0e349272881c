"""Route and checks of every HTTP connection, then body and reply of a request for actions.

FastAPI's middleware, dependencies and responses cost more than a policy does, so `PolicyApp` answers requests for
actions by a `HttpEndpoint`: a bare ASGI callable with the protocol's codec. Everything runs in the event loop: a
decision takes microseconds, a hop to a thread takes more.
"""

from __future__ import annotations

import asyncio
import itertools
import secrets
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

from fastapi import FastAPI
from starlette.routing import BaseRoute, Match
from starlette.types import Message, Receive, Scope, Send

from rlservo.export.contract.errors import (
    ForbiddenError,
    RateLimitError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
)
from rlservo.serve_app.episodes.request import ClientGoneError, Request
from rlservo.serve_app.protocols.action_routes import PostRoute, StreamRoute
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
    MAY_EXPLORE,
    PATH,
    REPLY_HEADERS,
    REQUEST_ID,
    AccessChecks,
    check_path,
    fold_headers,
    header_text,
)
from rlservo.serve_app.server.api_keys import Access, Key, access_of
from rlservo.serve_app.server.audit import AUDIT, AuditEntry
from rlservo.serve_app.server.request_handler import Codec, RequestHandler

PATHS_REMEMBERED, LONGEST_REMEMBERED = 1024, 512  # the longest that a name and a version can make is 170
HANG_UP_TURNS = 4
ROOT = "/"  # a page for browsers (`status_page.py`), nothing for programs

Body = bytes | bytearray

PROCESS = secrets.token_hex(8).encode()
numbers = itertools.count(1)


class Found(NamedTuple):
    """A route and the parameters in its path; where only the path fits, FastAPI answers 404 or 405."""

    route: BaseRoute | None
    access: Access
    params: dict[str, str]
    fits: bool = True  # the method, too


class PolicyApp(FastAPI):
    """A FastAPI application whose routes say who may use them, decided before anything of the body is read.

    `find` is the one routing table. Routes for actions and streams (`PostRoute`, `StreamRoute`) are bare ASGI callables
    and are answered here, since FastAPI's middleware and router cost as much again as the request does; FastAPI runs
    the others.
    """

    def __init__(
        self, handler: RequestHandler, checks: AccessChecks, *, is_behind_serve: bool = False, **options: Any
    ) -> None:
        """`is_behind_serve`: Ray Serve gives replies their request id, and its connections take trailers for headers"""
        super().__init__(**options)
        self._handler = handler
        self._checks = checks
        self._is_behind_serve = is_behind_serve
        self._found: dict[tuple[str, str], Found] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one ASGI connection."""
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        path, headers = route_path(scope), fold_headers(scope["headers"])
        request_id = headers.get(REQUEST_ID)
        if request_id is None:
            request_id = headers[REQUEST_ID] = b"%s-%x" % (PROCESS, next(numbers))
        scope[HEADERS] = headers
        scope[REPLY_HEADERS] = () if self._is_behind_serve else ((REQUEST_ID, request_id),)
        found = self.find(scope, path)
        if not (found.fits and isinstance(found.route, PostRoute | StreamRoute)):
            await self._answer_by_fastapi(found, path, headers, scope, receive, send)
            return
        try:
            key = self._check(found, path, headers, scope)
        except RlservoError as error:
            await self._refuse(scope, headers, receive, send, error)
            return
        scope["path_params"] = found.params
        scope[MAY_EXPLORE] = key is None or key.may_explore
        await found.route.app(scope, receive, send)

    async def _answer_by_fastapi(
        self, found: Found, path: str, headers: dict[bytes, bytes], scope: Scope, receive: Receive, send: Send
    ) -> None:
        entry = AuditEntry(scope.get("method", ""), path, peer_of(scope), header_text(headers, REQUEST_ID))
        entry.is_administration = found.access is Access.admin
        scope[AUDIT] = entry
        try:
            key = self._check(found, path, headers, scope)
            entry.key = "" if key is None else key.label
            if scope["type"] == "websocket":
                sentence = f"no stream is at {path[:200]}: connect to /v1/policies/NAME/stream"
                await _send_refusal(scope, receive, send, UnknownPolicyError(sentence))
                return
            if found.route is None:
                varying = {"Vary": "Accept"} if path == ROOT else None
                await http_error(404, scope, headers=varying)(scope, receive, send)
                return
            body = await receive_body(self._handler, headers, receive)
            await super().__call__(scope, replay(body, receive), with_headers(send, scope[REPLY_HEADERS]))
        except RlservoError as error:
            entry.code = error.code
            if isinstance(error, ForbiddenError | RateLimitError):
                entry.key = entry.key or error.key
            await self._refuse(scope, headers, receive, send, error)
        except ClientGoneError:
            return
        finally:
            entry.write()

    def _check(self, found: Found, path: str, headers: dict[bytes, bytes], scope: Scope) -> Key | None:
        """Return the key that opens a route. Raises what `check_path` and `AccessChecks.check` raise."""
        check_path(scope, path)
        key = self._checks.check(scope, headers, found.access)
        if self._is_behind_serve and b"transfer-encoding" in headers:
            raise RequestError("a chunked body is not accepted behind Ray Serve: send Content-Length")
        return key

    async def _refuse(
        self, scope: Scope, headers: Mapping[bytes, bytes], receive: Receive, send: Send, error: RlservoError
    ) -> None:
        request = Request(scope["type"], "", None, time.perf_counter(), request_id=header_text(headers, REQUEST_ID))
        self._handler.record_failure(request, error.code, error.message, peer=peer_of(scope))
        await _send_refusal(scope, receive, send, error)

    def find(self, scope: Scope, path: str) -> Found:
        """Return the route of a connection.

        A path with another method is guarded as its most guarded route is; one without any is for any key.
        """
        kind = scope["method"] if scope["type"] == "http" else "WEBSOCKET"
        known = self._found.get((kind, path))
        if known is not None:
            return known
        others: list[BaseRoute] = []
        for route in self.router.routes:
            match, below = route.matches(scope)
            if match is Match.FULL:
                found = Found(route, access_of(route), below.get("path_params", {}))
                # Only these match by method and path alone: the page at `/` asks the Accept header, too.
                is_bare = isinstance(route, PostRoute | StreamRoute)
                if is_bare and len(path) <= LONGEST_REMEMBERED and PATH.fullmatch(path) is not None:
                    if len(self._found) >= PATHS_REMEMBERED:
                        self._found.clear()
                    self._found[kind, path] = found
                return found
            if match is Match.PARTIAL:
                others.append(route)
        if not others:
            return Found(None, Access.act, {}, fits=False)
        levels = {access_of(route) for route in others}
        access = next(level for level in (Access.admin, Access.act, Access.open) if level in levels)
        return Found(others[0], access, {}, fits=False)


class HttpEndpoint:
    """Answers the POST requests of one protocol."""

    def __init__(self, protocol: str, codec: Codec[Receive, tuple[bytes, Headers]], handler: RequestHandler) -> None:
        """Take the protocol's name, as metrics and log have it."""
        self._protocol = protocol
        self._codec = codec
        self._handler = handler

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
            connection=client if (client := scope.get("client")) is not None and client[1] else None,  # a proxy's has 0
            has_hung_up=partial(has_hung_up, receive),
            may_explore=scope[MAY_EXPLORE],
        )
        status = 200
        try:
            content, reply_headers = await self._handler.answer(self._codec, request, receive)
        except RlservoError as error:
            status, content, reply_headers = error_answer(error)
        except ClientGoneError:
            return
        length = (b"content-length", b"%d" % len(content))
        every = [length, *reply_headers, *scope[REPLY_HEADERS]]
        await send({"type": "http.response.start", "status": status, "headers": every})
        await send({"type": "http.response.body", "body": content})


async def has_hung_up(receive: Receive) -> bool:
    """Return whether the client of a request that was read to its end has closed its connection.

    The event loop takes a turn to read what arrived of that, one to close the connection, and two to report it here.
    """
    message = asyncio.ensure_future(receive())
    for _ in range(HANG_UP_TURNS):
        await asyncio.sleep(0)
    if not message.done():
        message.cancel()
        return False
    return bool(message.result()["type"] == "http.disconnect")


async def receive_body(handler: RequestHandler, headers: Mapping[bytes, bytes], receive: Receive) -> Body:
    """Return a request's body within the server's limits. The first message usually holds all of it.

    The one way in which a body gets into this process; how long it may take is the connection's affair
    (`engines/http_bounds.py`). Raises TooLargeError, OverloadedError and ClientGoneError.
    """
    max_bytes = handler.settings.max_body_bytes
    length = headers.get(b"content-length", b"")
    if length.isdigit() and len(length) < 20 and int(length) > max_bytes:
        raise too_large(max_bytes)
    message = await receive()
    body: Body = message.get("body", b"")
    if message.get("more_body", False):
        with handler.admission.reading_body():
            body = bytearray(body)
            while message.get("more_body", False) and len(body) <= max_bytes:
                message = await receive()
                body += message.get("body", b"")
    if message["type"] == "http.disconnect":
        raise ClientGoneError
    if len(body) > max_bytes:
        raise too_large(max_bytes)
    return body


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


def with_headers(send: Send, headers: Headers) -> Send:
    """Return a `send` that adds headers to the reply."""

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *headers]
        await send(message)

    return send_with_headers


def route_path(scope: Scope) -> str:
    """Return a connection's path below the prefix that the application is mounted at, as Starlette's routes see it."""
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    below = path[len(root) :]
    return below if path.startswith(root) and below[:1] in ("", "/") else path


def peer_of(scope: Scope) -> str | None:
    """Return the client's address; behind trusted proxies uvicorn takes it from `X-Forwarded-For`."""
    client = scope.get("client")
    return None if client is None else str(client[0])
