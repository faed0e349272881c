"""HTTP/1.1 connections with one deadline over all reads and writes, through the environment's proxy.

A socket's time-out applies to each read and each piece of a write: a server that sends or takes a byte now and then can
delay a client indefinitely. The deadlines of a control loop and of a storage call are for the whole answer. A failure
of the network or of the protocol is a ConnectionError, a deadline that has passed a TimeoutError.
"""

from __future__ import annotations

import base64
import functools
import select
import socket
import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar
from urllib.parse import unquote, urlsplit
from urllib.request import getproxies, proxy_bypass

import httptools

from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import UsageError

READ_BYTES = 65536
MAX_OVERHEAD = 1 << 17  # [bytes] of a head and trailers, and of a body's framing beyond the body's own length
TLS_SCHEMES, PORTS = ("https", "wss"), {"http": 80, "ws": 80, "https": 443, "wss": 443}
WANTED: dict[type[OSError], int] = {ssl.SSLWantReadError: select.POLLIN, ssl.SSLWantWriteError: select.POLLOUT}

Given = TypeVar("Given")
Done = TypeVar("Done")


@dataclass(frozen=True)
class ServerRoute:
    """The way to a server, and the beginning of a request that takes it."""

    host: str
    port: int
    tls: ssl.SSLContext | None
    proxy: tuple[str, int] | None
    proxy_field: bytes  # the proxy's password
    prefix: bytes  # of a target in a request that a proxy reads
    host_field: bytes

    @classmethod
    def to(cls, url: str, certificates: str | None) -> ServerRoute:
        """Return the route to a URL's server, through the environment's proxy unless it is on this machine.

        The server's certificate is checked with those in the file `certificates`, by default the system's. Raises
        UsageError for an unsupported kind of proxy.
        """
        server, field = urlsplit(url), b""
        host, place = server.hostname or "", server.netloc.encode()
        # Reading the certificates takes 20 ms; http has no use for them.
        tls = _trusting(certificates or None) if server.scheme in TLS_SCHEMES else None
        address = None if is_loopback(host) or proxy_bypass(server.netloc) else getproxies().get(server.scheme)
        proxy = urlsplit(address if address and "://" in address else f"http://{address}")
        if address and proxy.scheme != "http":
            raise UsageError(
                f"a proxy in the environment has the scheme {proxy.scheme!r}: expected an address such as "
                "'http://proxy:3128'"
            )
        if address and proxy.username is not None:
            user = f"{unquote(proxy.username)}:{unquote(proxy.password or '')}".encode()
            field = b"proxy-authorization: Basic %s\r\n" % base64.b64encode(user)
        hop = (proxy.hostname or "", proxy.port or PORTS["http"]) if address else None
        prefix = b"http://" + place if hop and server.scheme == "http" else b""  # others go through a tunnel
        port = server.port or PORTS[server.scheme]
        return cls(host, port, tls, hop, field, prefix, b"host: %s\r\n" % place)

    def request(self, method: str, target: bytes, fields: bytes, body: bytes | None) -> bytes:
        """Return a request; `fields` are its other header lines."""
        own = self.host_field + self.proxy_field if self.prefix else self.host_field
        if body is None:
            return b"%s %s%s HTTP/1.1\r\n%s%s\r\n" % (method.encode(), self.prefix, target, own, fields)
        return b"%s %s%s HTTP/1.1\r\n%s%scontent-length: %d\r\n\r\n%s" % (
            method.encode(), self.prefix, target, own, fields, len(body), body
        )  # fmt: skip

    @property
    def tunnel_request(self) -> bytes:
        """The request for a tunnel, through which a proxy passes on everything unread."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        place = f"{name}:{self.port}".encode()
        return b"CONNECT %s HTTP/1.1\r\nhost: %s\r\n%s\r\n" % (place, place, self.proxy_field)


class NotHttpError(ConnectionError):
    """The server sent something that is not an answer in HTTP."""


class Connection:
    """A connection to a server, and the response that arrives on it. After any exception it must be closed.

    httptools' parser calls the methods `on_...`.
    """

    status = 0  # until the head is complete
    is_complete = False
    rest = b""
    """The first bytes of another protocol, with status 101."""
    is_reusable = False
    """Whether it can take another request."""

    def __init__(self, route: ServerRoute, deadline: float) -> None:
        """Connect by `deadline` (`time.monotonic`). Raises ConnectionError and TimeoutError, as all methods do."""
        try:
            self._socket = socket.create_connection(route.proxy or (route.host, route.port), time_left(deadline))
        except TimeoutError:
            raise
        except OSError as error:
            raise ConnectionError(str(error)) from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setblocking(False)
            self._readable = select.poll()
            self._readable.register(self._socket, select.POLLIN)
            self._parser = httptools.HttpResponseParser(self)
            if route.proxy is not None and not route.prefix:
                self.ask(route.tunnel_request, deadline)
                while not self.status:
                    self.receive(deadline)
                if not 200 <= self.status < 300:
                    raise ConnectionError(f"the proxy answered {self.status}")
                self._parser = httptools.HttpResponseParser(self)  # the other would wait for the tunnel's end
            if route.tls is not None:
                self._socket.settimeout(time_left(deadline))
                self._socket = route.tls.wrap_socket(self._socket, server_hostname=route.host)
                self._socket.setblocking(False)
        except BaseException as error:
            self.close()
            if isinstance(error, OSError) and not isinstance(error, TimeoutError):
                raise ConnectionError(str(error)) from error
            raise
        self.used_at = time.monotonic()
        """Time of the server's last bytes."""

    @property
    def is_quiet(self) -> bool:
        """Whether the server has neither closed it nor sent anything that no one asked for."""
        return not self._readable.poll(0)

    def ask(self, request: bytes, deadline: float) -> None:
        """Send a request, whose response comes with `receive`."""
        self.status, self.is_complete, self.is_reusable = 0, False, False
        self.headers: list[tuple[bytes, bytes]] = []
        self.body = bytearray()
        self._overhead = 0  # bytes that were not of the body
        self.send(request, deadline)

    def send(self, content: bytes, deadline: float) -> None:
        """Send all of `content`."""
        rest = memoryview(content)
        while rest:
            time_left(deadline)
            rest = rest[self._do(self._socket.send, rest, select.POLLOUT, deadline) :]

    def read(self, deadline: float) -> bytes:
        """Return the next bytes; none at the connection's end."""
        _wait(self._readable, deadline)
        data = self._do(self._socket.recv, READ_BYTES, select.POLLIN, deadline)
        self.used_at = time.monotonic()
        return data

    def receive(self, deadline: float) -> None:
        """Read the next bytes of a response; none come at the connection's end."""
        data, before = self.read(deadline), len(self.body)
        try:
            self._parser.feed_data(data)
        except httptools.HttpParserUpgrade as switch:
            self.rest = data[switch.args[0] :]
            self.is_complete = True
        except httptools.HttpParserError as error:
            raise NotHttpError(f"the answer is not HTTP: {error}") from error
        own = len(self.body) - before
        self._overhead += len(data) - 2 * own
        if self._overhead > MAX_OVERHEAD:
            raise NotHttpError(f"the answer has more than {MAX_OVERHEAD} bytes besides its body")
        if not data and not self.is_complete:
            has_length = {b"content-length", b"transfer-encoding"}.intersection(name for name, _ in self.headers)
            if not self.status or has_length:
                raise ConnectionError("the server closed it before the answer was complete")
            self.is_complete = True

    def close(self) -> None:
        """Close it."""
        self._socket.close()

    def on_header(self, name: bytes, value: bytes) -> None:
        if not self.status:  # later ones are trailers
            self.headers.append((name.lower(), value))

    def on_headers_complete(self) -> None:
        if not self.is_complete:
            self.status = self._parser.get_status_code()

    def on_body(self, block: bytes) -> None:
        if not self.is_complete:  # not a second answer's
            self.body += block

    def on_message_begin(self) -> None:
        self.is_reusable = False  # a second answer, which no one asked for, may have begun

    def on_message_complete(self) -> None:
        if 100 <= self.status < 200 and self.status != 101:  # an interim one
            self.status = 0
            self.headers.clear()
        elif not self.is_complete:
            self.is_complete = True
            self.is_reusable = self.status != 101 and self._parser.should_keep_alive()

    def _do(self, operation: Callable[[Given], Done], given: Given, events: int, deadline: float) -> Done:
        """Return a socket operation's result; `events` are what it waits for, unless TLS wants the other direction."""
        while True:
            try:
                return operation(given)
            except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError) as error:
                ready = select.poll()
                ready.register(self._socket, WANTED.get(type(error), events))
                _wait(ready, deadline)
            except OSError as error:
                raise ConnectionError(str(error)) from error


def _wait(ready: select.poll, deadline: float) -> None:
    if not ready.poll(1e3 * time_left(deadline)):
        raise TimeoutError("the deadline has passed")


def time_left(deadline: float) -> float:
    """Return the seconds before a deadline (`time.monotonic`). Raises TimeoutError if it has passed."""
    left_s = deadline - time.monotonic()
    if left_s <= 0:
        raise TimeoutError("the deadline has passed")
    return left_s


@functools.cache
def _trusting(certificates: str | None) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=certificates)
