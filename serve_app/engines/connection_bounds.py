"""Bounds on HTTP connections and WebSockets: heads, bodies, trailers, pipelining, pings, connections of one address.

uvicorn (0.54) waits indefinitely for a request's head and body, reads heads and trailers of any size, treats a trailer
as a header, queues any number of pipelined requests, and answers pings of a client that reads nothing. `BoundedHttp`
and `BoundedWebSocket` are uvicorn's connections with limits, passed in its options `http` and `ws`. They override
methods of `asyncio.Protocol`, callbacks of httptools' parser and uvicorn's frame handlers.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Awaitable
from typing import Any, NoReturn

from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rlservo.errors import DeadlineError, OverloadedError, RequestError, RlservoError
from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, error_answer, send_reply
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.sessions.request import Request

HANDLER = "rlservo.handler"  # in the application's lifespan state, which uvicorn hands to each connection
ADDRESSES = "rlservo.addresses"  # likewise
HEAD_S = 5.0  # [s] for a request's head, from the connection's start or the head's first byte
MAX_HEAD_BYTES = 16384  # of a head, or of trailers
MAX_PIPELINED = 32  # requests that a connection may send before the first one is answered
MAX_CONNECTIONS = 4096  # of one process
SPARE = 32  # connections from an address beyond its bound that get 429; further ones are closed at once
UNREAD_MS = 30_000  # [ms] that a client may leave a reply unread
SLICE_BYTES = 4096  # of a WebSocket's data that is read before its bounds are checked again
LINGER_S = 5.0  # [s] for which a refused client's further data is read and dropped
MAX_UNANSWERED = 64  # messages of a WebSocket
MAX_FRAMES = 1000  # pings, pongs and fragments of a WebSocket per second
VIOLATION = 1008  # WebSocket's close code for a client that violates the server's rules
CHECK_S = 1.0  # [s] between two checks of a connection's phase


class _Refused(Exception):
    """A request is refused in a callback of the parser; httptools and uvicorn answer 400 for any exception in one."""


class _Addresses:
    """Open connections of one process by client address, from their start as HTTP; some end as WebSockets."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._of: dict[asyncio.BaseTransport, str] = {}

    @classmethod
    def of(cls, app_state: dict[str, Any]) -> _Addresses:
        """Return those of a process, given its lifespan state."""
        addresses: _Addresses = app_state.setdefault(ADDRESSES, cls())
        return addresses

    def add(self, transport: asyncio.BaseTransport, address: str) -> None:
        self._of[transport] = address
        self.counts[address] += 1

    def remove(self, transport: asyncio.BaseTransport) -> None:
        address = self._of.pop(transport, None)
        if address is not None:
            self.counts[address] -= 1
            if not self.counts[address]:
                del self.counts[address]


class _JoinedWrites(asyncio.Transport):
    """A connection's transport for one reply, whose head it writes together with the beginning of the body.

    uvicorn writes them separately: the client, woken by the head, would take the processor before the body is sent.
    """

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport, self._head = transport, b""
        self.is_closing, self.close = transport.is_closing, transport.close  # type: ignore[method-assign]

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep the first piece for the second."""
        if self._head:
            self._transport.write(self._head + data)
            self.write = self._transport.write  # type: ignore[method-assign]
        else:
            self._head = bytes(data)


class BoundedHttp(HttpToolsProtocol):
    """A connection that ends when a client sends too much or takes too long."""

    _phase_limit_s: float | None = HEAD_S  # [s] None while nothing is awaited from the client
    _is_late = False  # whether the phase was beyond its limit at the last check
    _in_body = False
    _field_bytes = 0  # of the complete fields of a head or of trailers
    _unparsed_bytes = 0  # of whole reads without a byte of a body: of a head, trailers or a chunk's first line
    _refusal = ("the request is not valid HTTP/1.1", 400)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Count the connection, and begin to wait for the first head."""
        super().connection_made(transport)
        self._handler: RequestHandler = self.app_state[HANDLER]
        if self.client is not None:
            _Addresses.of(self.app_state).add(transport, self.client[0])
        self._since = self.loop.time()
        connection = transport.get_extra_info("socket")
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # the kernel closes it if a reply stays unread, also on a WebSocket
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREAD_MS)
        self.loop.call_later(CHECK_S, self._check)
        excess = self._excess()
        if excess >= SPARE:
            transport.abort()
        elif excess > 0:
            self.app = self._refuse_connection

    def _excess(self) -> int:
        """Return the number of connections by which this address, or the process, exceeds its bound."""
        most = self._handler.settings.max_connections_per_address
        own = _Addresses.of(self.app_state).counts[self.client[0]] if most and self.client is not None else 0
        return max(own - most, len(self.connections) - MAX_CONNECTIONS)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection no longer."""
        super().connection_lost(exc)
        _Addresses.of(self.app_state).remove(self.transport)

    def data_received(self, data: bytes) -> None:
        """Read the data; of a head or trailers, no more than is allowed: the parser keeps a field until it ends."""
        self._unparsed_bytes += len(data)
        super().data_received(data)
        is_awaited = self._phase_limit_s is not None and not self.transport.is_closing()
        if is_awaited and self._unparsed_bytes > MAX_HEAD_BYTES:
            sentence, status = self._fields_too_large()
            self._end(RequestError(sentence), status)

    # Callbacks of the parser

    def on_message_begin(self) -> None:
        """Start to wait for a head."""
        super().on_message_begin()
        self._await(HEAD_S)
        self._field_bytes = 0

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header. After the body it is a trailer, which is ignored. Both are bounded."""
        self._field_bytes += len(name) + len(value)
        if self._field_bytes > MAX_HEAD_BYTES:
            self._refuse(*self._fields_too_large())
        if not self._in_body:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Start to wait for the body."""
        parser: Any = self.parser
        if parser.should_upgrade():
            self._check_upgrade(parser.get_method())
        if len(self.pipeline) >= MAX_PIPELINED:
            self._refuse(f"more than {MAX_PIPELINED} requests were sent before the first one was answered")
        self._in_body = True
        self._field_bytes = self._unparsed_bytes = 0
        self._await(self._handler.settings.body_timeout_s)
        before = self.cycle
        super().on_headers_complete()
        if self.cycle is not before and self.scope["method"] != "HEAD" and not self.expect_100_continue:
            self.cycle.transport = _JoinedWrites(self.transport)

    def on_body(self, body: bytes) -> None:
        """Take a part of the body, which is bounded elsewhere."""
        self._unparsed_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Await nothing more of this request."""
        super().on_message_complete()
        self._in_body = False
        self._unparsed_bytes = 0
        self._await(None)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002
        """Answer a request that the parser or one of its callbacks refused, and close."""
        sentence, status = self._refusal
        self._end(RequestError(sentence), status)

    # Ours

    def _await(self, limit_s: float | None) -> None:
        self._phase_limit_s, self._since, self._is_late = limit_s, self.loop.time(), False

    def _check(self) -> None:
        if self.transport.is_closing() or self.transport.get_protocol() is not self:  # a WebSocket has its own bounds
            return
        self.loop.call_later(CHECK_S, self._check)
        if self._phase_limit_s is None or self.loop.time() - self._since <= self._phase_limit_s:
            return
        if not self._is_late:  # a starved process may still have to read data that came in time
            self._is_late = True
        elif self.cycle is not None and self._in_body and self.cycle.response_started:
            self.transport.abort()  # it was answered, and the rest of its body never came
        else:
            self._end(DeadlineError(f"the request did not arrive within {self._phase_limit_s:g} s"))

    def _check_upgrade(self, method: bytes) -> None:
        """Refuse any Upgrade except a WebSocket's without a body, since uvicorn would drop the body."""
        headers = dict(self.headers)
        is_websocket = headers.get(b"upgrade", b"").lower() == b"websocket" and method == b"GET"
        has_body = headers.get(b"content-length", b"0") != b"0" or b"transfer-encoding" in headers
        if not is_websocket or has_body:
            self._refuse("the header Upgrade is supported only for a WebSocket, which begins with a GET without a body")

    def _fields_too_large(self) -> tuple[str, int]:
        fields, status = ("trailers", 400) if self._in_body else ("headers", 431)
        return f"the request's {fields} are larger than {MAX_HEAD_BYTES} bytes", status

    def _refuse(self, sentence: str, status: int = 400) -> NoReturn:
        self._refusal = sentence, status
        raise _Refused

    def _end(self, error: RlservoError, other_status: int | None = None) -> None:
        """Answer with an error in place of the application, and close the connection."""
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True  # a later reply of the application is dropped
            self.cycle.message_event.set()
        status, content = self._answer_to(error)
        self.transport.write(
            b"HTTP/1.1 %d \r\ncontent-type: application/json\r\nconnection: close\r\ncontent-length: %d\r\n\r\n%s"
            % (other_status or status, len(content), content)
        )
        self.transport.close()

    def _answer_to(self, error: RlservoError) -> tuple[int, bytes]:
        """Return (status, body) for a request that the application does not get; count and log it."""
        request = Request("http", peer=self.client and self.client[0])
        self._handler.record_failure(request, error)
        return error_answer(error)[:2]

    def _refuse_connection(self, _scope: Scope, _receive: Receive, send: Send) -> Awaitable[None]:
        count = self._handler.settings.max_connections_per_address
        sentence = f"your address has more than {count} connections, or all clients have {MAX_CONNECTIONS}: close some"
        _, content = self._answer_to(OverloadedError(sentence))
        return send_reply(send, 429, content, (*JSON_HEADERS, (b"retry-after", b"1"), (b"connection", b"close")))


class BoundedWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that closes if its client sends too much, and pauses reading while the client reads nothing."""

    _frames = 0
    _second = 0.0
    _is_refused = False

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection, which began as HTTP, no longer."""
        super().connection_lost(exc)
        _Addresses.of(self.app_state).remove(self.transport)

    def data_received(self, data: bytes) -> None:
        """Read the data, as long as the client keeps to the bounds."""
        for start in range(0, len(data), SLICE_BYTES):
            if self._is_refused or self.transport.is_closing():
                return
            super().data_received(data[start : start + SLICE_BYTES])
            if self.queue.qsize() > MAX_UNANSWERED:
                self._end(f"more than {MAX_UNANSWERED} requests are unanswered")

    def handle_parser_exception(self) -> None:
        """Send the close code, and drop further data from the client.

        If it were closed with unread data, the connection would be reset, and the client would lose the close code.
        """
        closed = self.conn.close_sent
        assert closed is not None
        self.queue.put_nowait({"type": "websocket.disconnect", "code": closed.code, "reason": closed.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = self._is_refused = True
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.transport.resume_reading()
        self.close_timer = self.loop.call_later(LINGER_S, self.transport.close)

    def handle_ping(self) -> None:
        """Answer a ping."""
        super().handle_ping()
        self._count_frame()

    def handle_pong(self, event: Any) -> None:
        """Take a pong."""
        super().handle_pong(event)
        self._count_frame()

    def handle_cont(self, event: Any) -> None:
        """Take a fragment."""
        super().handle_cont(event)
        self._count_frame()

    def pause_writing(self) -> None:
        """Stop reading while the client does not read."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Continue reading, unless a message still waits for the application."""
        super().resume_writing()
        if not self.read_paused:
            self.transport.resume_reading()

    def _count_frame(self) -> None:
        now = self.loop.time()
        if now - self._second > 1.0:
            self._second, self._frames = now, 0
        self._frames += 1
        if self._frames == MAX_FRAMES:
            self._end(f"more than {MAX_FRAMES} pings, pongs or fragments in a second")

    def _end(self, reason: str) -> None:
        if self.close_sent or self.transport.is_closing():
            return
        self.conn.fail(VIOLATION, reason)
        self.handle_parser_exception()
