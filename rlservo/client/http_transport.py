"""HTTP calls to a policy server: JSON both ways, one time budget, bounded retries, rlservo's errors.

A call takes `timeout_s` at most, including retries and waits, even if the server's bytes trickle in slowly; an answer
that is incomplete by then is never returned.
"""

from __future__ import annotations

import functools
import os
import random
import sys
import time
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
import orjson

from rlservo.client.formats.addresses import parse_address
from rlservo.client.formats.http_connection import Connection, NotHttpError, ServerRoute, time_left
from rlservo.client.formats.request_names import LABEL_HEADER
from rlservo.client.replies import decode_error, excerpt
from rlservo.errors import DeadlineError, TooLargeError, UnavailableError, UsageError

FIRST_WAIT_S = 0.05  # before the second attempt; doubled each time
LONGEST_WAIT_S = 2.0
MAX_REPLY_BYTES = 64 << 20  # far above any action or contract; a wrong URL must not fill the memory
KEEPALIVE_S = 5.0  # that an idle connection is kept
SCHEMES = {"http": "http", "https": "https"}
RETRIED = (500, 502, 503)  # the first two without an error of ours: a gateway, whose server has died (HAProxy, nginx)
# Replies are a few hundred bytes: compressing them costs more than it saves.
FIELDS = b"accept: application/json\r\naccept-encoding: identity\r\nuser-agent: rlservo-client\r\n"
TYPE = b"content-type: application/json\r\n"
LABEL = LABEL_HEADER.encode()


class BrokenError(UnavailableError):
    """The connection is missing or closed, so there is no answer."""

    was_connected = False


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
        if api_key is not None and not (api_key.isascii() and api_key.isprintable()):
            raise UsageError("the API key has characters that no key has: expected printable ASCII")
        self._route = ServerRoute.to(self.url, os.environ.get("SSL_CERT_FILE"))
        self._path = urlsplit(self.url).path.encode()
        self._fields = FIELDS + (b"" if api_key is None else f"authorization: Api-Key {api_key}\r\n".encode())
        self._idle: list[Connection] = []
        self._connections = 0
        self._is_closed = False
        self.label: str | None = None
        """Label of later requests, for the server's recording."""

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return max(0, self._connections - 1)

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
        while self._idle:
            self._idle.pop().close()

    def _call(self, method: str, path: tuple[str, ...], body: bytes | None, timeout_s: float | None) -> bytes:
        """Try until there is an answer, no time or no retry left; return the content.

        Raises DeadlineError if the answer did not come in time (never retried: the server may still be working),
        UnavailableError if the server cannot be reached or keeps answering 503, or a gateway 500 or 502, and otherwise
        the error that the server names.
        """
        target = _target(path)
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        attempt = 0
        while True:
            wait: float | None = None
            try:
                response = self.exchange(method, target, TYPE if body is not None else b"", body, deadline)
            except BrokenError as error:
                failure: UnavailableError = error
                if attempt == 0 and error.was_connected:
                    wait = 0.0  # a server that closed an idle connection is probably still running
            else:
                status, headers, content = response.status, response.headers, bytes(response.body)
                if response.is_reusable and not self._is_closed:
                    self._idle.append(response)  # from here on another thread may use it
                else:
                    response.close()
                if status < 300:
                    return content
                refusal = decode_error(self.url + target, status, content)
                if status not in RETRIED or not isinstance(refusal, UnavailableError):
                    raise refusal
                failure = refusal
                wait = failure.retry_after_s = _retry_after_s(headers)
            # Jitter keeps a fleet of robots from retrying at once.
            backoff_s = min(FIRST_WAIT_S * 2**attempt, LONGEST_WAIT_S) * random.uniform(0.75, 1.25)
            wait_s = backoff_s if wait is None else wait
            # A wait beyond the caller's budget is useless: report the failure now.
            if attempt == self._retries or time.monotonic() + wait_s >= deadline:
                raise failure
            time.sleep(wait_s)
            if time.monotonic() >= deadline:
                raise failure
            attempt += 1

    def exchange(self, method: str, target: str, fields: bytes, body: bytes | None, deadline: float) -> Connection:
        """Return the connection with the whole response to one attempt, for the caller to close or to use again.

        Raises BrokenError and DeadlineError.
        """
        if self._is_closed:
            raise UsageError("the client is closed: create a new one")
        budget_s = deadline - time.monotonic()
        if self.label is not None:
            fields = b"%s%s: %s\r\n" % (fields, LABEL, self.label.encode())
        if (tracing := sys.modules.get("opentelemetry.trace")) is not None:  # only if the caller uses it
            span = tracing.get_current_span().get_span_context()
            if span.is_valid:
                parent = f"traceparent: 00-{span.trace_id:032x}-{span.span_id:016x}-{span.trace_flags:02x}\r\n"
                fields += parent.encode()
        request = self._route.request(method, self._path + target.encode(), self._fields + fields, body)
        connection = self._connection(deadline, budget_s)
        is_whole = False
        try:
            connection.ask(request, deadline)
            while not connection.is_complete:
                connection.receive(deadline)
                if len(connection.body) > MAX_REPLY_BYTES:
                    raise TooLargeError(
                        f"{self.url} sent more than {MAX_REPLY_BYTES >> 20} MiB: is it an rlservo server?"
                    )
            time_left(deadline)
            is_whole = True
            return connection
        except TimeoutError as error:
            raise DeadlineError(f"{self.url} did not answer within {budget_s:.3g} s") from error
        except NotHttpError as error:
            raise UnavailableError(f"{self.url} cannot be understood ({error}): is it an rlservo server?") from error
        except ConnectionError as error:
            broken = BrokenError(f"{self.url} dropped the connection: {error}", {"url": self.url})
            broken.was_connected = True
            raise broken from error
        finally:
            if not is_whole:
                connection.close()  # a late answer cannot reach the next request

    def _connection(self, deadline: float, budget_s: float) -> Connection:
        """Return an idle connection, or a new one."""
        while self._idle:
            try:
                connection = self._idle.pop()
            except IndexError:  # another thread was faster
                break
            if time.monotonic() - connection.used_at < KEEPALIVE_S and connection.is_quiet:
                return connection
            connection.close()
        try:
            connection = Connection(self._route, deadline)
        except TimeoutError as error:
            raise BrokenError(f"{self.url} cannot be reached within {budget_s:.3g} s", {"url": self.url}) from error
        except ConnectionError as error:
            raise BrokenError(f"{self.url} cannot be reached: {error}", {"url": self.url}) from error
        self._connections += 1
        return connection

    def _parse(self, content: bytes) -> Any:
        try:
            return orjson.loads(content)
        except ValueError as error:
            raise UnavailableError(
                f"{self.url} answered with {excerpt(content)}, which is not JSON: is it an rlservo server?"
            ) from error


@functools.lru_cache(256)
def _target(path: tuple[str, ...]) -> str:
    return "".join(f"/{quote(part, safe='')}" for part in path)


def _retry_after_s(headers: list[tuple[bytes, bytes]]) -> float | None:
    """Return Retry-After in seconds; None if absent or a date, which our servers do not send."""
    try:
        seconds = float(dict(headers).get(b"retry-after", b""))
    except ValueError:
        return None
    return seconds if seconds >= 0 else None  # also refuses NaN
