"""Routing and checks of every connection; body and reply of requests for actions.

Everything runs in the event loop: a decision takes microseconds, a hop to a thread takes more.
"""

from __future__ import annotations

import asyncio
import itertools
import secrets
import time
from collections.abc import Mapping
from functools import partial

from rlservo.export.contract.errors import (
    ForbiddenError,
    InternalError,
    RateLimitError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
)
from rlservo.serve_app.episodes.request import ClientGoneError, Request
from rlservo.serve_app.protocols.http_errors import (
    Headers,
    error_answer,
    missing_route,
    refuse_upgrade,
    send_error,
    send_reply,
    too_large,
)
from rlservo.serve_app.protocols.routes import WEBSOCKET, Answer, Call, Found, RoutingTable
from rlservo.serve_app.server.access_checks import (
    HEADERS,
    LABEL,
    MAY_EXPLORE,
    REPLY_HEADERS,
    REQUEST_ID,
    OriginChecks,
    authorize,
    check_path,
    fold_headers,
    header_text,
    presented_key,
)
from rlservo.serve_app.server.api_keys import Access, Key
from rlservo.serve_app.server.logs import AuditEntry
from rlservo.serve_app.server.request_handler import Codec, RequestHandler
from rlservo.serve_app.wire.asgi import Receive, Scope, Send

HANG_UP_TURNS = 4

Body = bytes | bytearray

PROCESS = secrets.token_hex(8).encode()
numbers = itertools.count(1)


class PolicyApp:
    """The ASGI application: finds each connection's route, and checks the client before it reads the body."""

    def __init__(
        self, handler: RequestHandler, checks: OriginChecks, table: RoutingTable, *, is_behind_serve: bool = False
    ) -> None:
        """`is_behind_serve`: Ray Serve adds the request id to replies, and its connections treat trailers as headers"""
        self.handler = handler
        self.table = table
        self._checks = checks
        self._is_behind_serve = is_behind_serve

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one ASGI connection."""
        if scope["type"] == "lifespan":  # the engine loads the policies
            for phase in ("startup", "shutdown"):
                await receive()
                await send({"type": f"lifespan.{phase}.complete"})
            return
        path, headers = route_path(scope), fold_headers(scope["headers"])
        request_id = headers.get(REQUEST_ID)
        if request_id is None:
            request_id = headers[REQUEST_ID] = b"%s-%x" % (PROCESS, next(numbers))
        scope[HEADERS] = headers
        scope[REPLY_HEADERS] = () if self._is_behind_serve else ((REQUEST_ID, request_id),)
        method = scope["method"] if scope["type"] == "http" else WEBSOCKET
        found = self.table.find(method, path, headers.get(b"accept", b""))
        if found.route is None or found.route.app is None:
            await self._answer(found, path, scope, receive, send)
            return
        try:
            key = self._check(found, path, scope)
        except RlservoError as error:
            await self._refuse(scope, receive, send, error)
            return
        scope["path_params"] = found.params
        scope[MAY_EXPLORE] = key is None or key.may_explore
        await found.route.app(scope, receive, send)

    async def _answer(self, found: Found, path: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer if there is no route, or one that takes the whole body."""
        headers = scope[HEADERS]
        entry = AuditEntry(scope.get("method", ""), path, peer_of(scope), header_text(headers, REQUEST_ID))
        own: Headers
        try:
            key = self._check(found, path, scope)
            entry.key = "" if key is None else key.label
            if scope["type"] == "websocket":
                raise UnknownPolicyError(f"there is no stream at {path[:200]}: connect to /v1/policies/NAME/stream")
            if found.route is None or found.route.answer is None:
                status, entry.code, content, own = missing_route(entry.method, path, found.allowed)
            else:
                body = await receive_body(self.handler, headers, receive)
                call = Call(found.params, headers, bytes(body), entry)
                status, content, own = await _reply_of(found.route.answer, call)
            await send_reply(send, status, content, own + scope[REPLY_HEADERS])
        except RlservoError as error:
            entry.code = error.code
            if isinstance(error, ForbiddenError | RateLimitError):
                entry.key = entry.key or error.key
            await self._refuse(scope, receive, send, error)
        except ClientGoneError:
            return
        finally:
            if found.access is Access.admin:
                entry.write()

    def _check(self, found: Found, path: str, scope: Scope) -> Key | None:
        """Return the key that permits a route. Raises what `check_path`, `OriginChecks.check` and `authorize` raise."""
        check_path(scope, path)
        self._checks.check(scope, scope[HEADERS])
        key = authorize(self.handler.keys, presented_key(scope[HEADERS]), found.access)
        if self._is_behind_serve and b"transfer-encoding" in scope[HEADERS]:
            raise RequestError("a chunked body is not accepted behind Ray Serve: send Content-Length")
        return key

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, error: RlservoError) -> None:
        headers, own = scope[HEADERS], scope[REPLY_HEADERS]
        request = Request(scope["type"], "", None, time.perf_counter(), peer=peer_of(scope))
        request.request_id = header_text(headers, REQUEST_ID)
        self.handler.record_failure(request, error)
        if scope["type"] == "http":
            await send_error(send, error, headers=own)
        else:
            await refuse_upgrade(scope, receive, send, error, own)


async def _reply_of(answer: Answer, call: Call) -> tuple[int, bytes, Headers]:
    """Return (status, body, headers), errors included."""
    try:
        return 200, *await answer(call)
    except Exception as error:
        call.audit.code = error.code if isinstance(error, RlservoError) else InternalError.code
        return error_answer(error)


class HttpEndpoint:
    """Answers the POST requests of one protocol."""

    def __init__(self, protocol: str, codec: Codec[Receive, tuple[bytes, Headers]], handler: RequestHandler) -> None:
        """Take the protocol's name for metrics and logs."""
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
            connection=client if (client := scope.get("client")) is not None and client[1] else None,  # 0: a proxy
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
        await send_reply(send, status, content, reply_headers + scope[REPLY_HEADERS])


async def has_hung_up(receive: Receive) -> bool:
    """Return whether the client has closed its connection after sending a complete request.

    The event loop takes one turn to read the close, one to close the connection, and two to report it here.
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

    Every body enters this process here; its time limit is enforced by the connection (`engines/http_bounds.py`). Raises
    TooLargeError, OverloadedError and ClientGoneError.
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
