"""Error replies of a server, turned back into the errors that it raised."""

from __future__ import annotations

import json
from typing import Any

from rlservo.export.contract.errors import (
    DeadlineError,
    RequestError,
    RlservoError,
    StateNeededError,
    TooLargeError,
    UnavailableError,
    UsageError,
)


def decode_error(url: str, status: int, content: bytes) -> RlservoError:
    """Return the error in the body of an HTTP reply that is not a success."""
    try:
        document = json.loads(content)
    except ValueError:
        document = None
    error = error_of(document, status)
    if error is not None:
        return error
    if status == 404:  # Ray Serve's own answer while the application is being deployed
        return UnavailableError(f"{url} answered 404 with {excerpt(content)}: no rlservo server is there (yet)")
    return _class_of_status(status)(f"{url} answered {status} with {excerpt(content)}: is it an rlservo server?")


def error_of(document: Any, status: int) -> RlservoError | None:
    """Return the error in `{"error", "code", "details"?}`; None if the document is not that."""
    if not isinstance(document, dict) or not isinstance(document.get("error"), str):
        return None
    details = document.get("details")
    details = details if isinstance(details, dict) else {}
    kind = _classes().get(str(document.get("code")), _class_of_status(status))
    if kind is RequestError and StateNeededError.is_described_by(details):
        kind = StateNeededError
    return kind(document["error"], details)


def excerpt(content: bytes) -> str:
    """Return the beginning of a body, to be shown in a message."""
    text = content[:80].decode("utf-8", "replace")
    return f"{text!r}{'...' if len(content) > 80 else ''}" if text else "an empty body"


def _classes() -> dict[str, type[RlservoError]]:
    """Return every error class by its code."""
    classes: dict[str, type[RlservoError]] = {}
    queue: list[type[RlservoError]] = [RlservoError]
    while queue:
        kind = queue.pop(0)
        classes.setdefault(kind.code, kind)  # a class comes before those that inherit its code
        queue += kind.__subclasses__()
    return classes


def _class_of_status(status: int) -> type[RlservoError]:
    """Return the error for an answer that carries no code of ours, a proxy's for example."""
    if status in (401, 403):
        return UsageError
    if status in (408, 504):
        return DeadlineError
    if status == 413:
        return TooLargeError
    return UnavailableError if status >= 500 or status < 400 else RequestError
