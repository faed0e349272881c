"""Bounded HTTP connections: one deadline over all reads and writes, through the environment's proxy.

httpcore's time-outs apply to each read: a server that sends a byte now and then can delay a client indefinitely. The
deadlines of a control loop and of a storage call are for the whole answer.
"""

from __future__ import annotations

import contextlib
import ssl
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import getproxies, proxy_bypass

import httpcore

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.wire.addresses import host_of, is_loopback

PROXIES: dict[str, Callable[..., httpcore.ConnectionPool]] = {
    "http": httpcore.HTTPProxy,
    "https": httpcore.HTTPProxy,
    "socks5": httpcore.SOCKSProxy,
    "socks5h": httpcore.SOCKSProxy,
}
FAILURES = (
    httpcore.NetworkError,
    httpcore.ProtocolError,
    httpcore.ProxyError,
    httpcore.TimeoutException,
    httpcore.UnsupportedProtocol,
)
MOST_HELD = 65536
"""[bytes] Part of a request that is held back until it is complete."""


class DeadlineBackend(httpcore.NetworkBackend):
    """Makes connections that give up at `deadline`, which is set per thread."""

    def __init__(self) -> None:
        self._backend = httpcore.SyncBackend()
        self._local = threading.local()
        self.connections = 0

    @property
    def deadline(self) -> float | None:
        """End of this thread's exchange (`time.monotonic`); None leaves httpcore's own time-outs."""
        return getattr(self._local, "deadline", None)

    @deadline.setter
    def deadline(self, value: float | None) -> None:
        self._local.deadline = value

    def remaining(self, timeout: float | None, kind: type[Exception]) -> float | None:
        """Return the time left before `timeout` and the deadline; raise `kind` if none is left."""
        if self.deadline is None:
            return timeout
        remaining_s = self.deadline - time.monotonic()
        if remaining_s <= 0:
            raise kind("the deadline has passed")
        return remaining_s if timeout is None else min(remaining_s, timeout)

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Connect."""
        remaining_s = self.remaining(timeout, httpcore.ConnectTimeout)
        stream = self._backend.connect_tcp(host, port, remaining_s, local_address, socket_options)
        self.connections += 1
        return _DeadlineStream(stream, self)

    def sleep(self, seconds: float) -> None:
        """Sleep, as httpcore's own retries do."""
        time.sleep(seconds)


def connection_pool(
    url: str, backend: DeadlineBackend, certificates: Callable[[], ssl.SSLContext], **options: Any
) -> httpcore.ConnectionPool:
    """Return a connection pool for a server, through the environment's proxy unless it is on this machine.

    Raises UsageError for an unsupported kind of proxy.
    """
    server = urlsplit(url)
    options["network_backend"] = backend
    # Reading the certificates takes 20 ms; http has no use for them.
    options["ssl_context"] = certificates() if server.scheme in ("https", "wss") else None
    is_direct = is_loopback(server.hostname or "") or proxy_bypass(server.netloc)
    proxy = None if is_direct else getproxies().get(server.scheme)
    if proxy is None:
        return httpcore.ConnectionPool(**options)
    parts = urlsplit(proxy if "://" in proxy else f"http://{proxy}")
    user = None if parts.username is None else (unquote(parts.username), unquote(parts.password or ""))
    address = httpcore.URL(scheme=parts.scheme.encode(), host=host_of(parts), port=parts.port, target=b"/")
    if parts.scheme not in PROXIES:
        raise UsageError(
            f"a proxy in the environment has the scheme {parts.scheme!r}: expected an address such as "
            "'http://proxy:3128'"
        )
    return PROXIES[parts.scheme](address, user, **options)


class _DeadlineStream(httpcore.NetworkStream):
    """Sends a request's head together with its body, which httpcore writes separately: the server reads only once."""

    def __init__(self, stream: httpcore.NetworkStream, backend: DeadlineBackend) -> None:
        self._stream = stream
        self._backend = backend
        self._held = b""

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        if self._held:
            with contextlib.suppress(httpcore.WriteError):  # as in httpcore: the server may have sent why it closed
                self._send(timeout)
        return self._stream.read(max_bytes, self._backend.remaining(timeout, httpcore.ReadTimeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._held += buffer
        if len(self._held) > MOST_HELD:
            self._send(timeout)

    def _send(self, timeout: float | None) -> None:
        held, self._held = self._held, b""
        self._stream.write(held, self._backend.remaining(timeout, httpcore.WriteTimeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        remaining_s = self._backend.remaining(timeout, httpcore.ConnectTimeout)
        return _DeadlineStream(self._stream.start_tls(ssl_context, server_hostname, remaining_s), self._backend)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)
