"""HTTP calls to a policy server: JSON both ways, one time budget, bounded retries, rlservo's errors.

A call takes `timeout_s` at most, including retries and waits, even if the server's bytes trickle in slowly; an answer
that is incomplete by then is never returned.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import SplitResult, quote, urlsplit

import numpy as np

from rlservo.export.contract.errors import DeadlineError, TooLargeError, UnavailableError, UsageError
from rlservo.export.contract.extras import needs_extra

with needs_extra("client", what="the HTTP client"):
    import httpcore

from rlservo.serve_app.client.replies import decode_error, excerpt
from rlservo.serve_app.wire.addresses import host_of, parse_address
from rlservo.serve_app.wire.bounded_http import FAILURES, DeadlineBackend, connection_pool
from rlservo.serve_app.wire.request_names import LABEL_HEADER

try:  # three times faster than the standard library for an image; optional for the client
    import orjson
except ModuleNotFoundError:
    orjson = None  # type: ignore[assignment]

FIRST_WAIT_S = 0.05  # before the second attempt; doubled each time
LONGEST_WAIT_S = 2.0
FIRST_BYTES = 65536
MAX_REPLY_BYTES = 64 << 20  # far above any action or contract; a wrong URL must not fill the memory
LABEL = LABEL_HEADER.encode()
KEEPALIVE_S = 5.0  # that an idle connection is kept
SCHEMES = {"http": "http", "https": "https"}
PATH_CHARACTERS = "/%:@!$&'()*+,;=~"  # of a server's address, kept as given
GATEWAYS = (500, 502)  # without an error of ours: the server behind a proxy has died (Ray's HAProxy answers 500)
Headers = Sequence[tuple[bytes, bytes]]
Reply = tuple[int, Headers, bytes]  # status, headers, body
DROPS = (httpcore.RemoteProtocolError, httpcore.ReadError, httpcore.WriteError)


class DroppedError(UnavailableError):
    """The server closed the connection before it answered."""


class Transport:
    """A keep-alive connection to one server, or a pool of them if several threads call. Thread-safe."""

    def __init__(
        self,
        url: str,
        *,
        timeout_s: float,
        retries: int,
        api_key: str | None = None,
        schemes: Mapping[str, str] = SCHEMES,
    ) -> None:
        """Check the arguments; nothing is sent before the first call.

        `api_key` travels as `Authorization: Api-Key <key>`, as openpi's clients send it. `schemes` has the connection's
        scheme for each one that an address may have.
        """
        self.url = parse_address(url, schemes)
        if not timeout_s > 0:
            raise UsageError(f"timeout_s must be above 0 seconds, got {timeout_s}")
        if retries < 0:
            raise UsageError(f"retries must be 0 or more, got {retries}")
        self._timeout_s = timeout_s
        self._retries = retries
        parts = urlsplit(self.url)
        self._address = (parts.scheme.encode(), host_of(parts), parts.port, quote(parts.path, safe=PATH_CHARACTERS))
        # Replies are a few hundred bytes: compressing them costs more than it saves.
        self._headers = [
            (b"host", _host_header(parts)),
            (b"accept", b"application/json"),
            (b"accept-encoding", b"identity"),
            (b"user-agent", b"rlservo-client"),
        ]
        if api_key is not None:
            self._headers.append((b"authorization", f"Api-Key {api_key}".encode()))
        self._backend = DeadlineBackend()
        self._pool = connection_pool(
            self.url, self._backend, _certificates, max_connections=100, keepalive_expiry=KEEPALIVE_S
        )
        self._is_closed = False
        self.label: str | None = None
        """Label of later requests, for the server's recording."""

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return max(0, self._backend.connections - 1)

    def get(self, *path: str, timeout_s: float | None = None, retries: int | None = None) -> Any:
        """Return the JSON at `/path[0]/path[1]/...`."""
        return self._parse(*self._call("GET", path, None, timeout_s, retries))

    def get_text(self, *path: str, timeout_s: float | None = None) -> str:
        """Return the text at `/path[0]/path[1]/...`."""
        return self.get_bytes(*path, timeout_s=timeout_s).decode("utf-8", "replace")

    def get_bytes(self, *path: str, timeout_s: float | None = None) -> bytes:
        """Return the content at `/path[0]/path[1]/...`."""
        content, *_ = self._call("GET", path, None, timeout_s, None)
        return content

    def post(self, *path: str, body: bytes, timeout_s: float | None = None) -> Any:
        """Send a JSON document and return the JSON answer."""
        return self._parse(*self._call("POST", path, body, timeout_s, None))

    def check_open(self) -> None:
        """Raise UsageError after `close`."""
        if self._is_closed:
            raise UsageError("the client is closed: create a new one")

    def close(self) -> None:
        """Close the connections. A call after that raises UsageError."""
        self._is_closed = True
        self._pool.close()

    def _call(
        self, method: str, path: tuple[str, ...], body: bytes | None, timeout_s: float | None, retries: int | None
    ) -> tuple[bytes, str, int]:
        """Try until there is an answer, no time or no retry left; return the content, its address and the status.

        Raises DeadlineError if the answer did not come in time (never retried: the server may still be working),
        UnavailableError if the server cannot be reached or keeps answering 503, or a gateway 500 or 502, and otherwise
        the error that the server names.
        """
        self.check_open()
        url = "/".join((self.url, *(quote(part, safe="") for part in path)))
        scheme, host, port, prefix = self._address
        target = "/".join((prefix, *(quote(part, safe="") for part in path))) or "/"
        address = httpcore.URL(scheme=scheme, host=host, port=port, target=target)
        budget = self._timeout_s if timeout_s is None else timeout_s
        deadline = time.monotonic() + budget
        retries = self._retries if retries is None else retries
        for attempt, wait in enumerate(_waits(retries)):
            try:
                status, headers, content = self._exchange(method, address, body, deadline, budget)
            except UnavailableError as error:
                failure = error
                if attempt == 0 and wait is not None and isinstance(error, DroppedError):
                    wait = 0.0  # a server that closed an idle connection is probably still running
            else:
                if status < 300:
                    return content, url, status
                refusal = decode_error(url, status, content)
                is_gateways = status in GATEWAYS and isinstance(refusal, UnavailableError)
                if status != 503 and not is_gateways:
                    raise refusal
                failure = refusal if isinstance(refusal, UnavailableError) else UnavailableError(refusal.message)
                failure.retry_after_s = _retry_after_s(headers)
                if wait is not None and failure.retry_after_s is not None:
                    wait = failure.retry_after_s
            # A wait beyond the caller's budget is useless: report the failure now.
            if wait is None or time.monotonic() + wait >= deadline:
                raise failure
            time.sleep(wait)
        raise AssertionError("the last wait is None")

    def upgrade(self, path: str, headers: Headers, deadline: float) -> tuple[httpcore.Response, bytes]:
        """Ask for another protocol at `path`; return the response, to be closed, and the first bytes behind its head.

        With status 101 these are the protocol's own, and its `network_stream` has the connection; otherwise they are
        the whole body. Raises UnavailableError and DeadlineError.
        """
        scheme, host, port, prefix = self._address
        url = httpcore.URL(scheme=scheme, host=host, port=port, target=prefix + path)
        request = httpcore.Request("GET", url, headers=self._labelled(*headers))
        with self._attempt(deadline, round(deadline - time.monotonic(), 2)) as timeout:
            request.extensions = {"timeout": timeout}
            response = self._pool.handle_request(request)
            if response.status != 101:
                return response, self._read(response, deadline)
            try:
                return response, response.extensions["network_stream"].read(FIRST_BYTES)
            except BaseException:
                response.close()
                raise

    def _exchange(self, method: str, url: httpcore.URL, body: bytes | None, deadline: float, budget: float) -> Reply:
        """Return the reply to one attempt."""
        headers = self._labelled()
        if body is not None:
            headers = [*headers, (b"content-type", b"application/json"), (b"content-length", b"%d" % len(body))]
        with self._attempt(deadline, budget) as timeout:
            request = httpcore.Request(method, url, headers=headers, content=body, extensions={"timeout": timeout})
            response = self._pool.handle_request(request)
            return response.status, response.headers, self._read(response, deadline)

    def _labelled(self, *more: tuple[bytes, bytes]) -> list[tuple[bytes, bytes]]:
        return [*self._headers, *more, *([] if self.label is None else [(LABEL, self.label.encode())])]

    def _read(self, response: httpcore.Response, deadline: float) -> bytes:
        content = b""
        try:
            for chunk in response.iter_stream():
                content += chunk
                if time.monotonic() > deadline:
                    raise httpcore.ReadTimeout
                if len(content) > MAX_REPLY_BYTES:
                    raise TooLargeError(
                        f"{self.url} sent more than {MAX_REPLY_BYTES >> 20} MiB: is it an rlservo server?"
                    )
        finally:
            response.close()  # an unread rest closes the connection, so a late answer cannot reach the next request
        if time.monotonic() > deadline:
            raise httpcore.ReadTimeout
        return content

    @contextlib.contextmanager
    def _attempt(self, deadline: float, budget: float) -> Iterator[dict[str, float]]:
        """Give httpcore's time-outs of one attempt; raise its failures as errors of ours."""
        remaining = deadline - time.monotonic()
        self._backend.deadline = deadline
        try:
            if remaining <= 0:
                raise httpcore.ReadTimeout
            yield dict.fromkeys(("connect", "read", "write", "pool"), remaining)
        except (httpcore.ReadTimeout, httpcore.WriteTimeout) as error:
            raise DeadlineError(f"{self.url} did not answer within {budget:g} s", {"timeout_s": budget}) from error
        except httpcore.ConnectTimeout as error:
            raise UnavailableError(f"{self.url} cannot be reached within {budget:g} s", {"url": self.url}) from error
        except FAILURES as error:
            why = str(error) or type(error).__name__
            if isinstance(error, DROPS):
                raise DroppedError(f"{self.url} dropped the connection: {why}", {"url": self.url}) from error
            raise UnavailableError(f"{self.url} cannot be reached: {why}", {"url": self.url}) from error
        finally:
            self._backend.deadline = None

    def _parse(self, content: bytes, url: str, status: int) -> Any:
        try:
            return json.loads(content) if orjson is None else orjson.loads(content)
        except ValueError as error:
            raise UnavailableError(
                f"{url} answered {status} with {excerpt(content)}, which is not JSON: is it an rlservo server?"
            ) from error


def encode(document: Mapping[str, Any]) -> bytes:
    """Return `document` as JSON; numpy arrays become nested lists of numbers that are exact to the bit when read."""
    if orjson is not None:
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY, default=_plain)
    return json.dumps(document, default=_plain, allow_nan=False).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be sent as JSON")


def _waits(retries: int) -> Iterator[float | None]:
    """Yield the wait after each attempt; None after the last. Jitter keeps a fleet of robots from retrying at once."""
    for attempt in range(retries):
        yield min(FIRST_WAIT_S * 2**attempt, LONGEST_WAIT_S) * random.uniform(0.75, 1.25)
    yield None


def _retry_after_s(headers: Headers) -> float | None:
    """Return Retry-After in seconds; None if absent or a date, which our servers do not send."""
    try:
        seconds = float(next((value for name, value in headers if name.lower() == b"retry-after"), b""))
    except ValueError:
        return None
    return seconds if seconds >= 0 else None  # also refuses NaN


def _certificates() -> ssl.SSLContext:
    """Return the certificates for checking servers: SSL_CERT_FILE's or SSL_CERT_DIR's, else certifi's."""
    file, folder = os.environ.get("SSL_CERT_FILE"), os.environ.get("SSL_CERT_DIR")
    if file or folder:
        return ssl.create_default_context(cafile=file or None, capath=None if file else folder)
    return httpcore.default_ssl_context()


def _host_header(parts: SplitResult) -> bytes:
    host = host_of(parts)
    host = b"[%s]" % host if b":" in host else host
    return host if parts.port is None else b"%s:%d" % (host, parts.port)
