"""Bounded HTTP request: it takes no longer and brings no more bytes than it may, and follows no redirect."""

from __future__ import annotations

import functools
import os
import ssl
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import BinaryIO

import httpcore

from rlservo.export.contract.errors import first_line
from rlservo.serve_app.wire.bounded_http import FAILURES, MOST_HELD, DeadlineBackend, connection_pool

SLOWEST = 256 << 10  # [bytes/s] of a body, after the time-out
REFUSAL = 4096  # [bytes] of a refusal's body, of which a sentence is made


class TooLongReplyError(Exception):
    """The reply brings more bytes than it may."""


@dataclass(frozen=True)
class Reply:
    """Answer of a server; the body of a success is elsewhere."""

    status: int
    headers: Mapping[str, str]
    refusal: bytes = b""  # the beginning of its body


def request(
    method: str, url: str, headers: Mapping[str, str], body: bytes, *, into: BinaryIO, most: int, timeout_s: float
) -> Reply:
    """Send one request; write the body of a success, at most `most` bytes and never unpacked, into `into`.

    Raises TooLongReplyError, ConnectionError, and TimeoutError when connecting takes longer than `timeout_s`, or the
    rest longer than that and the time of what has come at `SLOWEST`.
    """
    backend = DeadlineBackend()
    backend.deadline = deadline = time.monotonic() + timeout_s + len(body) / SLOWEST
    sent: dict[bytes | str, bytes | str] = {"Content-Length": str(len(body))} if method == "PUT" else {}
    sent.update(headers)
    timeout = {"connect": timeout_s, "read": timeout_s, "write": timeout_s}
    blocks = (body[start : start + MOST_HELD] for start in range(0, len(body), MOST_HELD))
    content = blocks if method == "PUT" else None
    length = 0
    try:
        with (
            connection_pool(url, backend, lambda: _trusted(os.environ.get("AWS_CA_BUNDLE") or None)) as pool,
            pool.stream(method, url, headers=sent, content=content, extensions={"timeout": timeout}) as reply,
        ):
            found = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in reply.headers}
            refusal = b""
            for block in reply.iter_stream():
                length += len(block)
                backend.deadline = deadline + length / SLOWEST
                if not 200 <= reply.status < 300:
                    refusal += block[:REFUSAL]
                    if length >= REFUSAL:
                        break
                elif length > most:
                    raise TooLongReplyError
                else:
                    into.write(block)
            return Reply(reply.status, found, refusal)
    except httpcore.TimeoutException:
        raise TimeoutError from None
    except FAILURES as error:
        raise ConnectionError(f"the connection broke after {length:,} bytes" if length else first_line(error)) from None


@functools.cache
def _trusted(certificates: str | None) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=certificates)
