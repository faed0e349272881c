"""HTTP endpoint of the hot path: read a body within its limits, call a handler, write the reply.

`Endpoint` is the hot path: a plain ASGI callable, because FastAPI's dependency and response machinery costs more than
the policy does. Everything runs in the event loop: a decision takes microseconds, a hop to a thread takes more. It
pauses nowhere, but for a policy that computes together what comes at the same time (`micro_batching.py`).
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from fastapi import Request
from fastapi.routing import APIRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rlservo.export.contract.errors import DeadlineError, MediaTypeError, RlservoError
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers, encode_bug, error_answer, too_large
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.request_age import LEAST_S
from rlservo.serve_app.server.request_log import FIELDS
from rlservo.serve_app.versions.policy_store import Decision

logger = logging.getLogger(__name__)
TURNS, TURN_S = 4, 0.005  # of the event loop, for what has arrived and not been read
KEY = "rlservo.key"  # the key that opened a request, in its scope
Body = bytes | bytearray
Handle = Callable[[Scope, Body, float], Awaitable[tuple[bytes, Headers, Decision]]]
CheckHeaders = Callable[[list[tuple[bytes, bytes]]], None]


class Endpoint:
    """A POST endpoint: reads the body, calls `handle(scope, body, received)`, answers, errors included."""

    def __init__(self, protocol: str, handle: Handle, check_headers: CheckHeaders, core: Core) -> None:
        self._protocol = protocol
        self._handle = handle
        self._check_headers = check_headers
        self._core = core

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        admission, log = self._core.admission, self._core.log
        started = time.perf_counter()
        try:
            self._check_headers(scope["headers"])
            waited = admission.age.waited(scope["headers"])
            body = await receive_body(self._core, scope, receive)
            if body is None:  # the client has gone
                return
            received = min(started, admission.enter(waited))  # only now: a body that is slow to come waits for itself
            if waited is not None and waited > LEAST_S:
                received -= waited
            content, headers, decision = await self._handle(scope, body, received)
            status = 200
            taken, batch = time.perf_counter() - received, decision.batch or 1
            self._core.metrics.answered(self._protocol, decision, batch, taken)
            if log.every:
                log.answered(
                    self._protocol, decision.name, decision.version, taken, batch=batch, request_id=request_id(scope)
                )
        except RlservoError as error:
            status, content, headers = error_answer(error)
            self._failed(scope, error, time.perf_counter() - started)
        except Exception:
            logger.exception("a request failed", extra={FIELDS: {"request_id": request_id(scope)}})
            status, content, headers = 500, encode_bug(), JSON_HEADERS
            self._core.metrics.failed(self._protocol, "", "", "internal")  # what failed may be the policies
        await send(
            {
                "type": "http.response.start",
                "status": status,
                "headers": [(b"content-length", b"%d" % len(content)), *headers],
            }
        )
        await send({"type": "http.response.body", "body": content})

    def _failed(self, scope: Scope, error: RlservoError, seconds: float) -> None:
        params = scope["path_params"]
        name, version = params["name"], params.get("version")
        self._core.failed(self._protocol, name, version, error.code)
        self._core.log.failed(
            self._protocol, name, version, error.code, error.message, request_id=request_id(scope), seconds=seconds
        )


class BareRoute(APIRoute):
    """A route FastAPI documents and routes to, and otherwise leaves alone: `app` is a bare ASGI callable."""

    access = Access.act

    def __init__(
        self,
        path: str,
        endpoint: ASGIApp,
        *,
        operation: str,
        tag: str,
        summary: str,
        reply: Any,
        body: Mapping[str, Any],
        responses: dict[int | str, dict[str, Any]],
    ) -> None:
        async def documented() -> None:
            """Documented, never called: `app` answers."""

        super().__init__(
            path,
            documented,
            methods=["POST"],
            name=operation,
            tags=[tag],
            summary=summary,
            description=summary + ".",
            response_model=reply,
            responses=responses,
            openapi_extra={
                "requestBody": {"required": True, "content": body},
                "parameters": [
                    {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
                    for name in ("name", "version")
                    if f"{{{name}}}" in path
                ],
            },
            generate_unique_id_function=lambda _route: operation,
        )
        self.app = endpoint


async def receive_body(core: Core, scope: Scope, receive: Receive) -> Body | None:
    """Return a request's body within the server's limits, or None when the client hung up.

    The one way in which a body gets into this process. Raises TooLargeError, DeadlineError and OverloadedError.
    """
    settings = core.settings
    check_length(scope["headers"], settings.max_body_bytes)
    with core.admission.reading(settings.body_timeout_s) as timeout_s:
        return await read_body(receive, max_bytes=settings.max_body_bytes, timeout_s=timeout_s)


def replay(body: Body, receive: Receive) -> Receive:
    """Return a `receive` that gives a body that has been read, and then what else comes."""
    messages: list[Message] = [{"type": "http.request", "body": bytes(body), "more_body": False}]

    async def receive_again() -> Message:
        return messages.pop() if messages else await receive()

    return receive_again


async def read_body(receive: Receive, *, max_bytes: int, timeout_s: float) -> Body | None:
    """Return the body, or None when the client hung up. The first message usually holds all of it.

    Raises TooLargeError and DeadlineError.
    """
    timer = _BodyTimer(timeout_s)
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
        raise DeadlineError(f"the request body did not arrive within {timeout_s:g} s") from None
    finally:
        timer.stop()
    if message["type"] == "http.disconnect":
        return None
    if len(body) > max_bytes:
        raise too_large(max_bytes)
    return body  # type: ignore[no-any-return]  # ASGI messages are untyped


class _BodyTimer:
    """Cancels the current task when a body's time is over and nothing more of it comes.

    On a starved process the clock can pass the time before the loop has read what has long arrived (uvloop even looks
    at its timers first). So when the time is over, the loop gets a few turns, in each of which it reads, and as many
    again for every piece that they bring; for as long again as the time was, at most.
    """

    __slots__ = ("_handle", "_last", "_loop", "_quiet", "_seen", "_task", "late", "pieces")

    def __init__(self, seconds: float) -> None:
        self._loop = asyncio.get_running_loop()
        self._task = asyncio.current_task()
        self._handle = self._loop.call_later(seconds, self._look)
        self._last = self._loop.time() + 2 * seconds
        self._quiet = self._seen = 0
        self.pieces = 0
        self.late = False

    def stop(self) -> None:
        """Forget about it."""
        self._handle.cancel()

    def _look(self) -> None:
        now = self._loop.time()
        if self.pieces != self._seen and now < self._last:
            self._seen, self._quiet = self.pieces, 0
        if self._quiet < TURNS:
            self._quiet += 1
            self._handle = self._loop.call_later(TURN_S, self._look)
        elif self._task is not None:
            self.late = True
            self._task.cancel()


def request_id(scope: Scope) -> str | None:
    """Return the request's id: the client's, or the one that Ray Serve or `ingress.py` made, which is on the answer."""
    for name, value in scope["headers"]:
        if name == b"x-request-id":
            return str(value.decode("latin-1"))
    return None


def peer_of(scope: Scope) -> str | None:
    """Return the client's address; behind HAProxy uvicorn takes it from `X-Forwarded-For`, which HAProxy adds."""
    client = scope.get("client")
    return None if client is None else str(client[0])


def check_length(headers: list[tuple[bytes, bytes]], max_bytes: int) -> None:
    """Raise TooLargeError for a body that announces itself as too large."""
    for name, value in headers:
        if name == b"content-length" and value.isdigit() and len(value) < 20 and int(value) > max_bytes:
            raise too_large(max_bytes)


def check_media_type(headers: list[tuple[bytes, bytes]], *accepted: bytes, optional: bool = False) -> None:
    """Raise MediaTypeError unless the body is of an accepted content type.

    A web page can send forms, plain text and bodies of no type to any server; for another type a browser asks the
    server first. Triton's client names no type: `optional` lets through who does not, unless it is a browser.
    """
    named = page = False
    for name, value in headers:
        if name == b"content-type":
            named = True
            if value not in accepted and value.split(b";", 1)[0].strip().lower() not in accepted:
                raise MediaTypeError(
                    f"the content type is '{value[:64].decode('latin-1')}': send {accepted[0].decode()} "
                    f"(curl: -H 'content-type: {accepted[0].decode()}')"
                )
        elif name in (b"origin", b"sec-fetch-site"):
            page = True
    if not named and (page or not optional):
        raise MediaTypeError(
            f"the request has no content type: send {accepted[0].decode()} "
            f"(curl: -H 'content-type: {accepted[0].decode()}')"
        )


async def json_only(request: Request) -> None:
    """Raise MediaTypeError for what is not JSON: a dependency of the routes that FastAPI runs."""
    check_media_type(request.scope["headers"], JSON)


def session_of(scope: Scope) -> str | None:
    """Return the session that the header `x-session-id` names; Ray Serve's own routing knows it, too."""
    for name, value in scope["headers"]:
        if name == b"x-session-id":
            return str(value.decode("latin-1"))
    return None
