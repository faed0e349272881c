"""Replies that HAProxy gives by itself, as the files that its configuration names."""

from __future__ import annotations

from pathlib import Path

ACTION_TIMEOUT_S = 5  # for a replica's answer to a request for actions: policies take milliseconds
REQUEST_TIMEOUT_S = 5  # for a request's head, and a body that fits the proxy's buffer
UNREACHABLE, TOO_SLOW_CLIENT, TOO_SLOW_REPLICA = "503.http", "408.http", "504.http"

_HEAD = b"content-type: application/json\r\nconnection: close\r\n\r\n"
_REPLIES = {
    UNREACHABLE: b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 1\r\n"
    + _HEAD
    + b'{"error":"no replica of the policy server can be reached: try again shortly","code":"unavailable"}',
    TOO_SLOW_CLIENT: b"HTTP/1.1 408 Request Timeout\r\n"
    + _HEAD
    + b'{"error":"the request did not arrive within %d s","code":"deadline-passed"}' % REQUEST_TIMEOUT_S,
    TOO_SLOW_REPLICA: b"HTTP/1.1 504 Gateway Timeout\r\nretry-after: 1\r\n"
    + _HEAD
    + b'{"error":"no replica answered within %d s: try again","code":"no-answer"}' % ACTION_TIMEOUT_S,
}


def write_error_replies(folder: Path) -> None:
    """Write them: without the files that its configuration names, HAProxy does not start."""
    for name, reply in _REPLIES.items():
        (folder / name).write_bytes(reply)
