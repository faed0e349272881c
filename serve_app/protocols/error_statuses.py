"""Replies, and the status and body of each error: HTTP's and gRPC's."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from typing import Any

from starlette.types import Send

from rlservo import errors
from rlservo.errors import ActionError, InternalError, RlservoError, TooLargeError, UnavailableError
from rlservo.serve_app.protocols.request_fields import encode_json
from rlservo.serve_app.server.request_handler import BUG

logger = logging.getLogger(__name__)

STATUS: tuple[tuple[type[RlservoError], int, str], ...] = (  # HTTP's and gRPC's; the first match counts
    (errors.ObservationError, 422, "INVALID_ARGUMENT"),
    (errors.UnknownPolicyError, 404, "NOT_FOUND"),
    (errors.MediaTypeError, 415, "INVALID_ARGUMENT"),
    (errors.TooLargeError, 413, "RESOURCE_EXHAUSTED"),  # gRPC's own status for a message beyond its limit
    (errors.RequestError, 400, "INVALID_ARGUMENT"),
    (errors.DeadlineError, 408, "DEADLINE_EXCEEDED"),
    (errors.ConflictError, 409, "FAILED_PRECONDITION"),
    (errors.SessionLostError, 410, "FAILED_PRECONDITION"),
    (errors.SessionError, 409, "FAILED_PRECONDITION"),
    (errors.RateLimitError, 429, "RESOURCE_EXHAUSTED"),
    (errors.UnavailableError, 503, "UNAVAILABLE"),
    (errors.UnauthenticatedError, 401, "UNAUTHENTICATED"),
    (errors.ForbiddenError, 403, "PERMISSION_DENIED"),
    (errors.RlservoError, 500, "INTERNAL"),  # a bug of ours, or an unsafe action
)
RETRY_AFTER_S = 1
JSON = b"application/json"
Headers = tuple[tuple[bytes, bytes], ...]
JSON_HEADERS: Headers = ((b"content-type", JSON),)


def too_large(limit: int) -> TooLargeError:
    return TooLargeError(f"the request body is larger than {limit} bytes", {"max_body_bytes": limit})


def status_of(error: RlservoError) -> tuple[int, str]:
    """Return an error's HTTP status, and the name of its gRPC status."""
    return next((http, grpc) for kind, http, grpc in STATUS if isinstance(error, kind))


def describe(error: Exception) -> tuple[tuple[int, str], dict[str, Any], int | None]:
    """Return (status of HTTP and gRPC, document without internals, seconds to wait for another try); log our faults."""
    if not isinstance(error, RlservoError):
        logger.error("a request failed", exc_info=error)
        error = InternalError(BUG)
    status = status_of(error)
    if status[0] == 500 and not isinstance(error, InternalError):  # which is logged with its traceback
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
    (status, _), document, wait_s = describe(error)
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


async def send_reply(
    send: Send, status: int, content: bytes, headers: Iterable[tuple[bytes, bytes]], *, kind: str = "http.response"
) -> None:
    """Send a whole reply; `kind` is the ASGI messages'."""
    every = [(b"content-length", b"%d" % len(content)), *headers]
    await send({"type": f"{kind}.start", "status": status, "headers": every})
    await send({"type": f"{kind}.body", "body": content})
