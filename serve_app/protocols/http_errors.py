"""HTTP status and body of each error, the same for every HTTP protocol, and errors on a WebSocket."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

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
from rlservo.serve_app.protocols.json_text import encode_json
from rlservo.serve_app.server.request_handler import BUG
from rlservo.serve_app.wire.asgi import Receive, Scope, Send

logger = logging.getLogger(__name__)

DENIAL = "websocket.http.response"  # the ASGI extension that answers an upgrade with an HTTP error
FAILED = 1011  # the close code openpi's server uses for every error

STATUS: tuple[tuple[type[RlservoError], int], ...] = (  # the first match counts; anything else is a bug of ours: 500
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
RETRY_AFTER_S = 1
JSON = b"application/json"
Headers = tuple[tuple[bytes, bytes], ...]
JSON_HEADERS: Headers = ((b"content-type", JSON),)


def too_large(limit: int) -> TooLargeError:
    return TooLargeError(f"the request body is larger than {limit} bytes", {"max_body_bytes": limit})


# Errors: the table above, and one body format for all.


def status_of(error: RlservoError) -> int:
    """Return the HTTP status of an error."""
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)


def describe(error: Exception) -> tuple[int, dict[str, Any], int | None]:
    """Return (status, document without internal details, seconds to wait before another try); log our own faults."""
    if not isinstance(error, RlservoError):
        logger.error("a request failed", exc_info=error)
        error = InternalError(BUG)
    status = status_of(error)
    if status == 500 and not isinstance(error, InternalError):  # which is logged with its traceback
        logger.error("%s", error.message)
        if not isinstance(error, ActionError):
            error = InternalError(BUG)
    document: dict[str, Any] = {"error": error.message, "code": error.code}
    if error.details:
        document["details"] = error.details
    wait_s = max(RETRY_AFTER_S, math.ceil(float(error.details.get("retry_after_s", 0))))
    return status, document, wait_s if isinstance(error, UnavailableError) else None


def error_answer(error: Exception) -> tuple[int, bytes, Headers]:
    """Return (status, body, headers) for `describe`'s result."""
    status, document, wait_s = describe(error)
    headers = JSON_HEADERS
    if wait_s is not None:
        headers += ((b"retry-after", b"%d" % wait_s),)
    elif status == 401:
        headers += ((b"www-authenticate", b"Bearer"),)
    return status, encode_json(document), headers


def missing_route(method: str, path: str, allowed: Sequence[str]) -> tuple[int, str, bytes, Headers]:
    """Return (status, code, body, headers) if no route has the path, or only for the `allowed` methods."""
    shown, headers = path[:200], JSON_HEADERS
    if allowed:
        status, code, sentence = 405, "method-not-allowed", f"{method} is not what {shown} takes: {allowed[0]} is"
        headers += ((b"allow", ", ".join(allowed).encode()),)
    else:
        status, code, sentence = 404, "not-found", f"there is nothing at {shown}: policies are under /v1/policies"
        if path == "/":  # a page for browsers
            headers += ((b"vary", b"Accept"),)
    return status, code, encode_json({"error": sentence, "code": code}), headers


def check_media_type(headers: Mapping[bytes, bytes], *accepted: bytes, optional: bool = False) -> None:
    """Raise MediaTypeError unless the body is of an accepted content type.

    A web page can send forms, plain text and bodies of no type to any server; for other types a browser asks the server
    first. Triton's client names no type: `optional` accepts that, except from a browser.
    """
    given = headers.get(b"content-type")
    usage = f"send {accepted[0].decode()} (curl: -H 'content-type: {accepted[0].decode()}')"
    if given is None:
        if not optional or b"origin" in headers or b"sec-fetch-site" in headers:
            raise MediaTypeError(f"the request has no content type: {usage}")
    elif given not in accepted and given.split(b";", 1)[0].strip().lower() not in accepted:
        raise MediaTypeError(f"the content type is '{given[:64].decode('latin-1')}': {usage}")


async def send_reply(
    send: Send, status: int, content: bytes, headers: Iterable[tuple[bytes, bytes]], *, kind: str = "http.response"
) -> None:
    """Send a whole reply; `kind` is the ASGI messages'."""
    every = [(b"content-length", b"%d" % len(content)), *headers]
    await send({"type": f"{kind}.start", "status": status, "headers": every})
    await send({"type": f"{kind}.body", "body": content})


async def send_error(send: Send, error: RlservoError, *, kind: str = "http.response", headers: Headers = ()) -> None:
    """Answer with an error; `headers` are further ones."""
    status, content, own = error_answer(error)
    await send_reply(send, status, content, own + headers, kind=kind)


async def refuse_upgrade(
    scope: Scope, receive: Receive, send: Send, error: RlservoError, headers: Headers = ()
) -> None:
    """Answer an upgrade with an HTTP error; if the server cannot send one, accept it and send the error as a frame."""
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
    except (OSError, RuntimeError):  # the client has disconnected
        logger.debug("a stream's client disconnected before its error could be sent")
