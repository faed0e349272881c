"""HTTP calls to a policy server: JSON both ways, one time budget, bounded retries, rlservo's errors.

A call takes `timeout_s` at most, including retries and waits, even if the server's bytes trickle in slowly; an answer
that is incomplete by then is never returned.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote, urlsplit

import httpcore
import numpy as np
import orjson

from rlservo.export.contract.errors import DeadlineError, TooLargeError, UnavailableError, UsageError
from rlservo.serve_app.client.replies import decode_error, excerpt
from rlservo.serve_app.wire.addresses import parse_address
from rlservo.serve_app.wire.http_deadlines import FAILURES, TIMEOUTS, DeadlineBackend, connection_pool, time_left
from rlservo.serve_app.wire.request_names import LABEL_HEADER

FIRST_WAIT_S = 0.05  # before the second attempt; doubled each time
LONGEST_WAIT_S = 2.0
READ_BYTES = 65536  # of a stream, at once
MAX_REPLY_BYTES = 64 << 20  # far above any action or contract; a wrong URL must not fill the memory
KEEPALIVE_S = 5.0  # that an idle connection is kept
SCHEMES = {"http": "http", "https": "https"}
RETRIED = (500, 502, 503)  # the first two without an error of ours: a gateway, whose server has died (HAProxy, nginx)
DROPS = (httpcore.RemoteProtocolError, httpcore.ReadError, httpcore.WriteError)
Headers = Sequence[tuple[bytes, bytes]]


class BrokenError(UnavailableError):
    """The connection is missing or closed, so there is no answer."""


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
        self._place = httpcore.URL(self.url)
        # Replies are a few hundred bytes: compressing them costs more than it saves.
        self._headers = [
            (b"host", urlsplit(self.url).netloc.encode()),
            (b"accept", b"application/json"),
            (b"accept-encoding", b"identity"),
            (b"user-agent", b"rlservo-client"),
        ]
        if api_key is not None:
            self._headers.append((b"authorization", f"Api-Key {api_key}".encode()))
        self._backend = DeadlineBackend()
        certificates = os.environ.get("SSL_CERT_FILE")
        self._pool = connection_pool(
            self.url, self._backend, certificates, max_connections=100, keepalive_expiry=KEEPALIVE_S
        )
        self._is_closed = False
        self.label: str | None = None
        """Label of later requests, for the server's recording."""

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return max(0, self._backend.connections - 1)

    def get(self, *path: str, timeout_s: float | None = None) -> Any:
        """Return the JSON at `/path[0]/path[1]/...`."""
        return self._parse(self._call("GET", path, None, timeout_s))

    def get_bytes(self, *path: str, timeout_s: float | None = None) -> bytes:
        """Return the content at `/path[0]/path[1]/...`."""
        return self._call("GET", path, None, timeout_s)

    def post(self, *path: str, document: Mapping[str, Any], timeout_s: float | None = None) -> Any:
        """Send a document as JSON and return the JSON answer.

        numpy arrays become nested lists of numbers that are exact to the bit when read.
        """
        body = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY, default=np.ndarray.tolist)
        return self._parse(self._call("POST", path, body, timeout_s))

    def close(self) -> None:
        """Close the connections. A call after that raises UsageError."""
        self._is_closed = True
        self._pool.close()

    def _call(self, method: str, path: tuple[str, ...], body: bytes | None, timeout_s: float | None) -> bytes:
        """Try until there is an answer, no time or no retry left; return the content.

        Raises DeadlineError if the answer did not come in time (never retried: the server may still be working),
        UnavailableError if the server cannot be reached or keeps answering 503, or a gateway 500 or 502, and otherwise
        the error that the server names.
        """
        target = "".join(f"/{quote(part, safe='')}" for part in path)
        headers = []
        if body is not None:
            headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body))]
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        attempt = 0
        while True:
            # Jitter keeps a fleet of robots from retrying at once.
            wait = min(FIRST_WAIT_S * 2**attempt, LONGEST_WAIT_S) * random.uniform(0.75, 1.25)
            try:
                response, content = self.exchange(method, target, headers, body, deadline)
            except BrokenError as error:
                failure: UnavailableError = error
                if attempt == 0 and isinstance(error.__cause__, DROPS):
                    wait = 0.0  # a server that closed an idle connection is probably still running
            else:
                if response.status < 300:
                    return content
                refusal = decode_error(self.url + target, response.status, content)
                if response.status not in RETRIED or not isinstance(refusal, UnavailableError):
                    raise refusal
                failure = refusal
                failure.retry_after_s = _retry_after_s(response.headers)
                wait = wait if failure.retry_after_s is None else failure.retry_after_s
            # A wait beyond the caller's budget is useless: report the failure now.
            if attempt == self._retries or time.monotonic() + wait >= deadline:
                raise failure
            time.sleep(wait)
            if time.monotonic() >= deadline:
                raise failure
            attempt += 1

    def exchange(
        self, method: str, target: str, headers: Headers, body: bytes | None, deadline: float
    ) -> tuple[httpcore.Response, bytes]:
        """Return the response to one attempt, and its whole body. Raises BrokenError and DeadlineError.

        With status 101 it is still to be closed: its `network_stream` has the connection, and the bytes are the first
        of the other protocol.
        """
        if self._is_closed:
            raise UsageError("the client is closed: create a new one")
        label = [] if self.label is None else [(LABEL_HEADER.encode(), self.label.encode())]
        budget_s, place = deadline - time.monotonic(), self._place
        path = place.target.rstrip(b"/") + target.encode()
        request = httpcore.Request(
            method,
            httpcore.URL(scheme=place.scheme, host=place.host, port=place.port, target=path),  # parsing it takes longer
            headers=[*self._headers, *headers, *label],
            content=body,
            extensions={"timeout": {"pool": max(budget_s, 0.0)}},
        )
        self._backend.deadline.at = deadline
        try:
            response = self._pool.handle_request(request)
            is_left_open = False
            try:
                if response.status == 101:
                    first = response.extensions["network_stream"].read(READ_BYTES)
                    is_left_open = True
                    return response, first
                return response, self._read(response, deadline)
            finally:
                if not is_left_open:
                    response.close()  # if unread, with its connection: a late answer cannot reach the next request
        except httpcore.ConnectTimeout as error:
            raise BrokenError(f"{self.url} cannot be reached within {budget_s:.3g} s", {"url": self.url}) from error
        except TIMEOUTS as error:
            raise DeadlineError(f"{self.url} did not answer within {budget_s:.3g} s") from error
        except FAILURES as error:
            what = "dropped the connection" if isinstance(error, DROPS) else "cannot be reached"
            why = str(error) or type(error).__name__
            raise BrokenError(f"{self.url} {what}: {why}", {"url": self.url}) from error

    def _read(self, response: httpcore.Response, deadline: float) -> bytes:
        content = b""
        for chunk in response.iter_stream():
            content += chunk
            if len(content) > MAX_REPLY_BYTES:
                raise TooLargeError(f"{self.url} sent more than {MAX_REPLY_BYTES >> 20} MiB: is it an rlservo server?")
        time_left(deadline)
        return content

    def _parse(self, content: bytes) -> Any:
        try:
            return orjson.loads(content)
        except ValueError as error:
            raise UnavailableError(
                f"{self.url} answered with {excerpt(content)}, which is not JSON: is it an rlservo server?"
            ) from error


def _retry_after_s(headers: Headers) -> float | None:
    """Return Retry-After in seconds; None if absent or a date, which our servers do not send."""
    try:
        seconds = float(next((value for name, value in headers if name.lower() == b"retry-after"), b""))
    except ValueError:
        return None
    return seconds if seconds >= 0 else None  # also refuses NaN
