"""Bounded HTTP connections: one deadline over all reads and writes, through the environment's proxy.

httpcore's time-outs apply to each read and each piece of a write: a server that sends or takes a byte now and then can
delay a client indefinitely. The deadlines of a control loop and of a storage call are for the whole answer.
"""

from __future__ import annotations

import contextlib
import functools
import socket
import ssl
import threading
import time
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import getproxies, proxy_bypass

import httpcore

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.wire.addresses import is_loopback

FAILURES = (
    httpcore.NetworkError,
    httpcore.ProtocolError,
    httpcore.ProxyError,
    httpcore.UnsupportedProtocol,
)
TIMEOUTS = (TimeoutError, httpcore.TimeoutException)
MOST_HELD = 65536  # [bytes] of a request, held back until it is complete


class DeadlineBackend(httpcore.SyncBackend):
    """Makes connections that give up at a deadline, which each thread sets for its exchange."""

    def __init__(self) -> None:
        self.deadline = _Deadline()
        self.connections = 0

    def connect_tcp(
        self, host: str, port: int, timeout: float | None = None, *more: Any, **options: Any
    ) -> httpcore.NetworkStream:
        """Connect."""
        stream = super().connect_tcp(host, port, self.deadline.left(timeout), *more, **options)
        self.connections += 1
        return _DeadlineStream(stream, self.deadline)


def connection_pool(
    url: str, backend: DeadlineBackend, certificates: str | None, **options: Any
) -> httpcore.ConnectionPool:
    """Return a connection pool for a server, through the environment's proxy unless it is on this machine.

    The server's certificate is checked with those in the file `certificates`, by default the system's. Raises
    UsageError for an unsupported kind of proxy.
    """
    server = urlsplit(url)
    # Reading the certificates takes 20 ms; http has no use for them.
    options["ssl_context"] = _trusting(certificates or None) if server.scheme in ("https", "wss") else None
    is_direct = is_loopback(server.hostname or "") or proxy_bypass(server.netloc)
    proxy = None if is_direct else getproxies().get(server.scheme)
    if proxy is not None:
        parts = urlsplit(proxy if "://" in proxy else f"http://{proxy}")
        if parts.scheme != "http":
            raise UsageError(
                f"a proxy in the environment has the scheme {parts.scheme!r}: expected an address such as "
                "'http://proxy:3128'"
            )
        user = None if parts.username is None else (unquote(parts.username), unquote(parts.password or ""))
        options["proxy"] = httpcore.Proxy(f"http://{parts.netloc.rpartition('@')[2]}", user)
    return httpcore.ConnectionPool(network_backend=backend, **options)


def time_left(deadline: float) -> float:
    """Return the seconds before a deadline (`time.monotonic`). Raises TimeoutError if it has passed."""
    left_s = deadline - time.monotonic()
    if left_s <= 0:
        raise TimeoutError("the deadline has passed")
    return left_s


def send_all(connection: socket.socket, content: bytes, deadline: float) -> None:
    """Send all of `content` by a deadline. Raises TimeoutError and OSError.

    The time-outs of `sendall` over TLS and of httpcore's `write` begin again with each piece that the server takes.
    """
    rest = memoryview(content)
    while rest:
        connection.settimeout(time_left(deadline))
        rest = rest[connection.send(rest) :]


class _Deadline(threading.local):
    """End of this thread's exchange."""

    at = 0.0

    def left(self, timeout: float | None) -> float:
        """Return the seconds before it and before `timeout`. Raises TimeoutError."""
        left_s = time_left(self.at)
        return left_s if timeout is None else min(left_s, timeout)


class _DeadlineStream(httpcore.NetworkStream):
    """Sends a request's head together with its body, which httpcore writes separately: the server reads only once."""

    def __init__(self, stream: httpcore.NetworkStream, deadline: _Deadline) -> None:
        self._stream = stream
        self._deadline = deadline
        self._held = b""

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        if self._held:
            with contextlib.suppress(httpcore.WriteError):  # as in httpcore: the server may have sent why it closed
                self._send(timeout)
        return self._stream.read(max_bytes, self._deadline.left(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._held += buffer
        if len(self._held) > MOST_HELD:
            self._send(timeout)

    def _send(self, timeout: float | None) -> None:
        held, self._held = self._held, b""
        end = time.monotonic() + self._deadline.left(timeout)
        try:
            send_all(self.get_extra_info("socket"), held, end)
        except TimeoutError:
            raise
        except OSError as error:
            raise httpcore.WriteError(str(error)) from error

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        stream = self._stream.start_tls(ssl_context, server_hostname, self._deadline.left(timeout))
        return _DeadlineStream(stream, self._deadline)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


@functools.cache
def _trusting(certificates: str | None) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=certificates)
