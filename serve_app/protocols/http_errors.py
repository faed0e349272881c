"""HTTP status and body of each error, the same for every HTTP protocol; and a WebSocket's form of one."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from rlservo.export.contract.errors import (
    ActionError,
    ConflictError,
    DeadlineError,
    ForbiddenError,
    InternalError,
    MediaTypeError,
    ObservationError,
    RateLimitError,
    RequestError,
    RlservoError,
    SessionError,
    SessionLostError,
    TooLargeError,
    UnauthenticatedError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app.protocols import json_messages
from rlservo.serve_app.server.request_handler import BUG

logger = logging.getLogger(__name__)

DENIAL = "websocket.http.response"  # the ASGI extension that answers an upgrade with an HTTP error
FAILED = 1011  # the close code openpi's server uses for every error

STATUS: tuple[tuple[type[RlservoError], int], ...] = (  # the first that fits; whatever does not fit is our fault: 500
    (ObservationError, 422),
    (UnknownPolicyError, 404),
    (MediaTypeError, 415),
    (TooLargeError, 413),
    (RequestError, 400),
    (DeadlineError, 408),
    (ConflictError, 409),
    (SessionLostError, 410),
    (SessionError, 409),
    (RateLimitError, 429),
    (UnavailableError, 503),
    (UnauthenticatedError, 401),
    (ForbiddenError, 403),
    (ActionError, 500),
)
CODES = {
    404: "not-found",
    405: "method-not-allowed",
    413: "too-large",
    415: "wrong-media-type",
}  # where FastAPI decides
OTHER = "http-error"
ANY_ROUTE = (400, 401, 403, 408, 413, 429)  # its path, key, host, page, body and rate
RETRY_AFTER_S = 1
JSON = b"application/json"
Headers = tuple[tuple[bytes, bytes], ...]
JSON_HEADERS: Headers = ((b"content-type", JSON),)


def too_large(limit: int) -> TooLargeError:
    return TooLargeError(f"the request body is larger than {limit} bytes", {"max_body_bytes": limit})


# Errors: the one table above, and one body for all.


def status_of(error: RlservoError) -> int:
    """Return the HTTP status of an error."""
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)


def error_answer(error: RlservoError) -> tuple[int, bytes, Headers]:
    """Return (status, body, headers) and log what is our own fault."""
    status = status_of(error)
    headers = JSON_HEADERS
    if status == 503:
        headers += ((b"retry-after", str(RETRY_AFTER_S).encode()),)
    elif status == 429:
        headers += ((b"retry-after", str(retry_after_s(error)).encode()),)
    elif status == 401:
        headers += ((b"www-authenticate", b"Bearer"),)
    elif status >= 500 and not isinstance(error, InternalError):  # which is logged with its traceback
        logger.error("%s", error.message)
    return status, encode_error(error), headers


def retry_after_s(error: RlservoError) -> int:
    """Return the whole seconds after which to ask again."""
    return max(RETRY_AFTER_S, math.ceil(float(error.details.get("retry_after_s", 0))))


def encode_error(error: RlservoError) -> bytes:
    """Return the body of an error; the inside of the server stays inside."""
    if status_of(error) == 500 and not isinstance(error, ActionError):
        return encode_bug()
    document: dict[str, Any] = {"error": error.message, "code": error.code}
    if error.details:
        document["details"] = error.details
    return json_messages.encode_json(document)


def encode_bug() -> bytes:
    """Return the body of an error that is none of ours to explain to a client."""
    return json_messages.encode_json({"error": BUG, "code": "internal"})


def http_error(status: int, scope: Scope, *, detail: str = "", headers: Mapping[str, str] | None = None) -> Response:
    """Return the answer where no route of ours has decided."""
    path, headers = scope["path"][:200], headers or {}
    sentences = {
        404: f"nothing is at {path}: policies are under /v1/policies, documentation at /docs",
        405: f"{scope['method']} is not what {path} takes: {headers.get('Allow', 'another method')} is",
    }
    document = {"error": sentences.get(status, detail), "code": CODES.get(status, OTHER)}
    return Response(json_messages.encode_json(document), status, headers, "application/json")


async def send_error(send: Send, error: RlservoError, *, kind: str = "http.response", headers: Headers = ()) -> None:
    """Answer with an error; `kind` is the ASGI messages', `headers` are further ones."""
    status, content, own = error_answer(error)
    every = [(b"content-length", b"%d" % len(content)), *own, *headers]
    await send({"type": f"{kind}.start", "status": status, "headers": every})
    await send({"type": f"{kind}.body", "body": content})


async def refuse_upgrade(
    scope: Scope, receive: Receive, send: Send, error: RlservoError, headers: Headers = ()
) -> None:
    """Answer an upgrade with an HTTP error; if the server cannot send one, accept it and fail in our own way."""
    await receive()  # websocket.connect
    if DENIAL in scope.get("extensions", {}):
        await send_error(send, error, kind=DENIAL, headers=headers)
        return
    await send({"type": "websocket.accept"})
    await fail_stream(send, error_answer(error)[1])


async def fail_stream(send: Send, content: bytes) -> None:
    """End an open WebSocket with an error's body."""
    try:
        await send({"type": "websocket.send", "text": content.decode()})
        await send({"type": "websocket.close", "code": FAILED, "reason": "see the text frame"})
    except (OSError, RuntimeError):  # the client has gone meanwhile
        logger.debug("a stream's client went before its error could be sent")


def error_models(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return FastAPI's `responses` for these error statuses, and for those that every route may answer with."""
    return {status: {"model": json_messages.ErrorReply} for status in sorted({*ANY_ROUTE, *statuses})}
