"""Bounded HTTP request: it takes no longer and brings no more bytes than it may, and follows no redirect."""

from __future__ import annotations

import base64
import contextlib
import functools
import http.client
import os
import socket
import ssl
import threading
import time
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPMessage
from typing import BinaryIO
from urllib.parse import unquote, urlsplit

from rlservo.export.contract.errors import first_line

BLOCK = 1 << 16  # [bytes]
SLOWEST = 256 << 10  # [bytes/s] of a body, after the time-out
REFUSAL = 4096  # [bytes] of a refusal's body, of which a sentence is made
LOOPBACK = ("localhost", "127.", "::1")  # never through a proxy


class TooLongReplyError(Exception):
    """The reply brings more bytes than it may."""


@dataclass(frozen=True)
class Reply:
    """Answer of a server; the body of a success is elsewhere."""

    status: int
    headers: HTTPMessage
    refusal: bytes = b""  # the beginning of its body


def request(
    method: str, url: str, headers: Mapping[str, str], body: bytes, *, into: BinaryIO, most: int, timeout_s: float
) -> Reply:
    """Send one request; write the body of a success, at most `most` bytes and never unpacked, into `into`.

    Raises TooLongReplyError, ConnectionError, and TimeoutError when connecting takes longer than `timeout_s`, or the
    rest longer than that and the time of what has come at `SLOWEST`.
    """
    connection, target, added = _connection(url, timeout_s)
    ended, is_late = threading.Event(), threading.Event()
    length = 0

    def watch(used: socket.socket) -> None:  # a socket's own time-out begins again with every byte
        began = time.monotonic()
        while (left_s := began + timeout_s + (len(body) + length) / SLOWEST - time.monotonic()) > 0:
            if ended.wait(left_s):
                return
        is_late.set()
        with contextlib.suppress(OSError):
            used.shutdown(socket.SHUT_RDWR)

    try:
        connection.connect()
        threading.Thread(target=watch, args=[connection.sock], name="storage", daemon=True).start()
        connection.request(method, target, body or None, {**added, **headers})
        with connection.getresponse() as reply:
            if not 200 <= reply.status < 300:
                return Reply(reply.status, reply.headers, reply.read(REFUSAL))
            while block := reply.read(BLOCK):
                length += len(block)
                if length > most:
                    raise TooLongReplyError
                into.write(block)
            if is_late.is_set() or str(length) != reply.headers.get("content-length", str(length)):
                raise ConnectionError(f"the connection broke after {length:,} bytes")
            return Reply(reply.status, reply.headers)
    except (OSError, http.client.HTTPException, ValueError) as error:
        if is_late.is_set() or isinstance(error, TimeoutError):
            raise TimeoutError from None
        raise ConnectionError(first_line(error)) from None
    finally:
        ended.set()
        connection.close()


def _connection(url: str, timeout_s: float) -> tuple[http.client.HTTPConnection, str, dict[str, str]]:
    """Return a connection to a URL's server, or to the environment's proxy for it, what to ask for, and headers."""
    parts = urlsplit(url)
    host, target = parts.hostname or "", parts._replace(scheme="", netloc="").geturl()
    proxy = urllib.request.getproxies().get(parts.scheme)
    if proxy is None or host.startswith(LOOPBACK) or urllib.request.proxy_bypass(host):
        return _open(parts.scheme, host, parts.port, timeout_s), target, {}
    via = urlsplit(proxy if "://" in proxy else f"http://{proxy}")
    login = base64.b64encode(f"{unquote(via.username or '')}:{unquote(via.password or '')}".encode()).decode()
    added = {"Proxy-Authorization": f"Basic {login}"} if via.username else {}
    connection = _open(parts.scheme, via.hostname or "", via.port or 80, timeout_s)
    if parts.scheme == "http":
        return connection, url, added
    connection.set_tunnel(host, parts.port or 443, added)
    return connection, target, {}


def _open(scheme: str, host: str, port: int | None, timeout_s: float) -> http.client.HTTPConnection:
    if scheme == "http":
        return http.client.HTTPConnection(host, port, timeout=timeout_s)
    trusted = _trusted(os.environ.get("AWS_CA_BUNDLE") or None)
    return http.client.HTTPSConnection(host, port, timeout=timeout_s, context=trusted)


@functools.cache
def _trusted(certificates: str | None) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=certificates)
