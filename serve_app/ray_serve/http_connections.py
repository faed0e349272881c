"""uvicorn's HTTP connections with a time-out for every phase.

uvicorn (0.54) bounds one phase of a connection, the idle time after a reply. For the others it waits for ever:

- for a request's head, the first one and each further one;
- for the rest of a body whose reply has been sent, and for the body of a route that sets no time of its own;
- for a client that does not read its reply, also after the connection has been closed;
- for nothing: `Upgrade: websocket` with a body is handed to the WebSocket protocol without that body.

And it takes a head of any size. Of WebSockets see `websocket_connections.py`.

A request for an action that came whole is answered at once where nothing has to wait, in the turn of the event loop
that reads it, and its reply is written in one piece. A head that comes again is not parsed again, and the object that
uvicorn makes for each request serves it again.

`install` puts subclasses in place of the classes that uvicorn chooses, in each of Serve's processes that serves HTTP
(`ingress.py`). One timer a connection checks its phase, the idle time too, for which uvicorn has a timer a reply; a
request costs three assignments. In front of the replicas
HAProxy has time-outs of its own (`haproxy/configuration.py`).
"""

from __future__ import annotations

import asyncio
import functools
import re
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from rlservo.serve_app.protocols.http_endpoint import REPLY, WholeBody
from rlservo.serve_app.ray_serve import uvicorn_parts
from rlservo.serve_app.ray_serve.eager_tasks import start_at_once
from rlservo.serve_app.ray_serve.joined_writes import JoinedWrites, Turn, turn_of
from rlservo.serve_app.ray_serve.uvicorn_parts import (
    STATUS_LINE,
    HttpToolsProtocol,
    RequestResponseCycle,
    auto,
)
from rlservo.serve_app.ray_serve.websocket_connections import UNREAD_S, BoundedStream
from rlservo.serve_app.wire.replica_sockets import ASKER, is_unix
from rlservo.serve_app.wire.request_stamp import STAMP, client_of

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

HEAD_S = 5.0
"""[s] for a request's head, from the connection's begin or the head's first byte on."""
MAX_HEAD_BYTES = 16384
"""Of a request's head, as in HAProxy's buffer."""
BODY_S = 30.0
"""[s] for a body, where a route has no time of its own (`body_timeout_s`); never less (`leave_time_for_bodies`)."""
LINGER_S = 1.0
"""[s] in which a client that still sends may take the reply: closed at once, what it sends would destroy the reply."""
MOST_LESSONS = 8
"""Heads of a connection that are looked at for whether the next is the same: a client may change it every time."""
CHECK_PERIOD_S = 1.0
"""[s] between two checks of a connection's phase."""

LENGTH = b"content-length"  # of a repeated head, as all of these
VARYING = (LENGTH, STAMP.encode())
VALUES = re.compile(rb"(?<=\r\n)(%s|%s): ?([^\r\n]+)(?=\r\n)" % VARYING, re.IGNORECASE)
LONGEST_VALUE = 128  # of such a value
CHANGING = frozenset({b"transfer-encoding", b"expect", b"upgrade", b"connection"})
"""Headers that change how a body is read, or what becomes of the connection."""
KEEP_ALIVE = (b"connection", b"keep-alive")  # which changes nothing

LATE = b'{"error":"the request did not arrive in time","code":"deadline-passed"}'
LATE_REPLY = (
    b"HTTP/1.1 408 Request Timeout\r\ncontent-type: application/json\r\nconnection: close\r\n"
    b"content-length: %d\r\n\r\n%s" % (len(LATE), LATE)
)
NO_UPGRADE = (
    b'{"error":"the header Upgrade is understood for a WebSocket alone, which begins with a GET without a body: '
    b'leave it out","code":"bad-request"}'
)
HEAD_TOO_LARGE = b'{"error":"the request\'s headers are larger than %d bytes","code":"bad-request"}' % MAX_HEAD_BYTES
LARGE_REPLY = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\ncontent-type: application/json\r\nconnection: close\r\n"
    b"content-length: %d\r\n\r\n%s" % (len(HEAD_TOO_LARGE), HEAD_TOO_LARGE)
)


class RepeatedHead(NamedTuple):
    """What was made of a head by the parser, and by uvicorn's look for the client that a proxy names.

    A robot asks a hundred times a second, and only the body's length varies; reading a head costs more than all else
    that a connection does: a dozen calls from the parser into Python. It holds for every other that is the same byte by
    byte, but for two values whose places are kept: how long the body is, and a proxy's stamp. All other requests are
    for the parser.
    """

    begin: bytes
    """Up to the first of them."""
    values: tuple[tuple[int, bytes, bytes], ...]
    """Of each: its header's place and name, and the bytes from its end to the next one, or to the body."""
    scope: dict[str, Any]
    """Of the request that had it, as the application was given it."""

    @classmethod
    def learn(cls, data: bytes, scope: Any) -> RepeatedHead | None:
        """Return what is known of the head of `data`, a whole request of this `scope`; None for an unusual one."""
        headers = scope["headers"]
        names = [name for name, _ in headers]
        end = data.find(b"\r\n\r\n") + 4
        matches = list(VALUES.finditer(data, 0, end - 2))
        found = [(match[1].lower(), match[2]) for match in matches]
        odd = not CHANGING.isdisjoint(name for name, value in headers if (name, value.lower()) != KEEP_ALIVE)
        if odd or scope["http_version"] != "1.1":
            return None
        if found != [header for header in headers if header[0] in VARYING]:
            return None
        if len(dict(found)) != len(found) or LENGTH not in dict(found):  # twice the same would be at one place
            return None
        starts = [match.start(2) for match in matches] + [end]
        ends = [0] + [match.end(2) for match in matches]
        begin, *rests = (data[since:until] for since, until in zip(ends, starts, strict=True))
        values = tuple((names.index(name), name, rest) for (name, _), rest in zip(found, rests, strict=True))
        known = cls(begin, values, {**scope, "headers": [*headers]})
        return known if known.read(data) else None

    def read(self, data: bytes) -> tuple[dict[str, Any], bytes] | None:
        """Return (scope, body) of `data` where that is one whole request with this head."""
        if not data.startswith(self.begin):
            return None
        at, length, headers = len(self.begin), -1, self.scope["headers"].copy()
        for place, name, rest in self.values:
            end = data.find(b"\r", at, at + LONGEST_VALUE)
            if end < 0 or not data.startswith(rest, end):
                return None
            value = data[at:end]
            if name == LENGTH:
                if not value.isdigit():
                    return None
                length = int(value)
            elif not value.replace(b"-", b"").isalnum():
                return None
            headers[place] = (name, value)
            at = end + len(rest)
        if len(data) - at != length:
            return None
        return {**self.scope, "headers": headers}, data[at:]


class EarlyEnd(RequestResponseCycle):
    """A request whose connection ends, and says so, when it is answered before all of it has come."""

    ends_early = False

    def begin_again(self, scope: Any, default_headers: Any, on_response: Callable[[], None]) -> None:
        """Serve another request: the last is answered, and nothing uses it any more.

        What is not set here is as it was made: `TimedProtocol._repeat` takes a whole request with a head that changes
        nothing, and an object whose connection stays open.
        """
        self.scope, self.default_headers, self.on_response = scope, default_headers, on_response
        self.response_started = self.response_complete = False
        self.chunked_encoding, self.expected_content_length = None, 0
        self.message_event.clear()

    async def send(self, message: Any) -> None:
        """Write a part of the reply."""
        if self.response_started or not self.more_body:
            await super().send(message)
            return
        self.ends_early, self.keep_alive = True, False  # the head says `Connection: close`
        await super().send(message)
        self.keep_alive = True  # closed at once, the client that still sends would lose the reply: `_linger`


class TimedProtocol(HttpToolsProtocol):
    """A connection that ends when one of its phases takes too long, and writes each reply at once."""

    body_s = BODY_S
    find_app: Callable[[Scope], ASGIApp | None] = staticmethod(lambda _: None)
    """Finds what answers a request, once it is whole, without waiting for anything; None for all others."""
    _head_since: float | None = None  # since when a head is awaited; None while something else is
    _idle_since: float | None = None  # since when nothing has come after a reply
    _body_since = 0.0  # since when the request's body is awaited
    _timer: asyncio.TimerHandle | None = None
    _turn: Turn
    _replies: JoinedWrites
    _unread = 0  # bytes that came since the last request was complete, so at least those of the head that is read
    _refuse: ASGIApp | None = None  # answers the next request instead of the application, and ends the connection
    _on_lost: Callable[[], None] | None = None
    _is_first = False  # of the requests that are being read: those after it let other connections have their turn
    _awaited: Any = None  # the cycle of a request that is answered at once when it is whole
    _known: RepeatedHead | None = None  # the head that is expected to come again
    _lessons = MOST_LESSONS
    _answered: Any = None  # the scope of the request that was answered at once in this read
    _spare: EarlyEnd | None = None  # of a known request that was answered at once, for the next one

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first head."""
        super().connection_made(transport)
        connection = transport.get_extra_info("socket")
        if is_unix(transport):
            self.client = ASKER
        elif connection is not None and hasattr(socket, "TCP_USER_TIMEOUT"):
            # The kernel ends the connection, whoever else still holds it: uvicorn's WebSockets, too.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(UNREAD_S * 1000))
        self._turn = turn_of(self.loop)
        self._replies = JoinedWrites(self, transport, self._turn)
        self._head_since = self.loop.time()
        self._timer = self.loop.call_later(CHECK_PERIOD_S, self._check_phase)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop()
        super().connection_lost(exc)
        if self._on_lost is not None:
            self._on_lost()

    def data_received(self, data: bytes) -> None:
        """Read what has come; of a head, not more than may be."""
        is_between = self._is_between()
        if is_between and self._known is not None:
            found = self._known.read(data)
            if found is not None and self._repeat(*found):
                return
        self._unread += len(data)
        self._is_first, self._answered = True, None
        super().data_received(data)
        self._is_first = False
        if is_between and self._answered is not None:
            self._lessons -= 1
            self._known = RepeatedHead.learn(data, self._answered)
        if self._awaited is not None:  # more of it is to come
            cycle, self._awaited = self._awaited, None
            super()._start_asgi_task(cycle, cast("Any", self.app))
        if self._unread > MAX_HEAD_BYTES and self._head_since is not None and not self.transport.is_closing():
            self._end_with(LARGE_REPLY)

    def _is_between(self) -> bool:
        """Whether a request has come whole and been answered, and the parser is in no other: a head may begin here."""
        cycle = self.cycle
        return cycle is not None and cycle.response_complete and not cycle.more_body and self._head_since is None

    def _repeat(self, scope: Any, body: bytes) -> bool:
        """Answer a request whose head need not be parsed; return False where it is to take the ordinary way."""
        if (app := self.find_app(scope)) is None:
            return False
        self._idle_since = None
        self._replies.head = None
        self.scope, self.headers = scope, scope["headers"]
        cycle = self._spare
        if cycle is not None and cycle is self.cycle and cycle.keep_alive:
            cycle.begin_again(scope, self.server_state.default_headers, self.on_response_complete)
        else:
            self.cycle = cycle = EarlyEnd(
                scope=scope,
                transport=cast("asyncio.Transport", self._replies),
                flow=self.flow,
                logger=self.logger,
                access_logger=self.access_logger,
                access_log=self.access_log,
                default_headers=self.server_state.default_headers,
                message_event=asyncio.Event(),
                expect_100_continue=False,
                keep_alive=True,
                on_response=self.on_response_complete,
            )
            cycle.more_body = False
        self._spare = cycle if self._answer(cycle, body, app) else None
        return True

    def handle_websocket_upgrade(self) -> None:
        """Leave the connection to the WebSocket protocol, which sends pings."""
        self._stop()
        self.ws_protocol_class = functools.partial(BoundedStream, on_lost=self._on_lost)  # type: ignore[assignment]
        # A robot's numbers hardly compress, and what unpacks to a thousand times its size is nobody's observation.
        self.config.ws_per_message_deflate = False
        super().handle_websocket_upgrade()

    def on_message_begin(self) -> None:
        """Begin to wait for this head."""
        self._head_since = self.loop.time()
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Begin to wait for the body."""
        self._body_since, self._head_since = self._head_since or 0.0, None
        if self._unread > MAX_HEAD_BYTES:
            size = len(self.url) + sum(len(name) + len(value) for name, value in self.headers)
            if size > MAX_HEAD_BYTES:
                self._refuse = refusal(431, HEAD_TOO_LARGE)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Begin to count the next head."""
        self._unread = 0
        super().on_message_complete()
        if self._awaited is not None:
            cycle, self._awaited, self._is_first = self._awaited, None, False
            scope = self._answered = {**cycle.scope} if self._lessons else None
            self._answer(cycle, bytes(cycle.body), cast("Any", self.app))
            if scope is not None:  # whom a proxy named
                scope["client"], scope["scheme"] = cycle.scope["client"], cycle.scope["scheme"]

    def send_400_response(self, msg: str) -> None:
        """End the connection, whose bytes are no HTTP."""
        self._turn.flush()
        super().send_400_response(msg)

    def _end_with(self, reply: bytes) -> None:
        self._turn.flush()  # a reply that is held was before this one
        self.transport.write(reply)
        self.transport.close()

    def _unset_keepalive_if_required(self) -> None:
        self._idle_since = None  # uvicorn calls it when something comes

    def on_response_complete(self) -> None:
        """Begin to wait for the next request; give a client that is still sending a moment to take its reply.

        The first half is uvicorn's (0.54) without its timer.
        """
        self.server_state.total_requests += 1
        if self.transport.is_closing():
            return
        self.flow.resume_reading()
        if self.pipeline:
            self._start_asgi_task(*self.pipeline.pop())
        else:
            self._idle_since = self.loop.time()
        cycle: Any = self.cycle
        if cycle.response_complete and cycle.ends_early and not self.transport.is_closing():
            self._stop()
            self.loop.call_soon(self._linger)  # the reply may be held until the end of this turn (`joined_writes.py`)

    def shutdown(self) -> None:
        """End the connection when what is being answered is written."""
        self._turn.flush()  # a reply that is held counts as written
        super().shutdown()

    def _linger(self) -> None:
        if not self.transport.is_closing():
            self.transport.write_eof()
            self.loop.call_later(LINGER_S, self.transport.close)

    def _should_upgrade(self) -> bool:
        return super()._should_upgrade() and not _has_body(self.scope) and self._refuse is None

    def _start_asgi_task(self, cycle: Any, app: Any) -> None:
        cycle.__class__ = EarlyEnd  # uvicorn's class is not the protocol's to choose
        # The parser has stopped at this head: a body is lost, and so is the next request.
        parser: Any = self.parser
        if parser.should_upgrade() and any(name == b"upgrade" for name, _ in cycle.scope["headers"]):
            cycle.keep_alive = False
            if _has_body(cycle.scope):
                app = refusal(400, NO_UPGRADE)
        if self._refuse is not None:
            cycle.keep_alive = False
            app = self._refuse
        if cycle.scope["method"] == "POST":  # of a HEAD there would be no body for its head to wait for
            self._replies.head = None
            cycle.transport = self._replies
            if cycle.more_body and self._is_first and app is self.app and self.find_app(cycle.scope) is not None:
                self._awaited = cycle
                return
        super()._start_asgi_task(cycle, app)

    def _answer(self, cycle: Any, body: bytes, app: ASGIApp) -> bool:
        """Answer a request that is whole; return whether that is over, and nothing uses `cycle` any more."""

        def answer(scope: Scope, receive: Receive, send: Send) -> Any:
            return app(scope, WholeBody(body, receive), send)

        # The cycle leads to its scope, and this back: left there, every request would be for the garbage collector.
        cycle.scope[REPLY] = functools.partial(self._reply, cycle)
        task = start_at_once(cycle.run_asgi(answer), self.loop)
        if task is None:
            cycle.scope.pop(REPLY, None)
            return True
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)
        return False

    def client_id(self) -> object:
        """Return who asked last: of a proxy's requests the stamp says so, since any may come over any connection."""
        for name, value in self.headers:
            if name == VARYING[1]:
                return client_of(value)
        return id(self)

    def _reply(self, cycle: Any, status: int, headers: Any, body: bytes) -> bool:
        """Write a whole reply; return False where that has to wait, since the client does not read."""
        if cycle.disconnected or cycle.response_started or cycle.flow.write_paused:
            return bool(cycle.disconnected)
        pieces = [STATUS_LINE[status]]
        for name, value in (*cycle.default_headers, *headers):
            pieces += (name, b": ", value, b"\r\n")
        pieces += (b"\r\n" if cycle.keep_alive else b"connection: close\r\n\r\n", body)
        cycle.response_started = cycle.response_complete = True
        self._turn.write(self, self.transport, b"".join(pieces))
        cycle.message_event.set()
        if not cycle.keep_alive:
            self._turn.flush()
            self.transport.close()
        cycle.on_response()
        return True

    def _check_phase(self) -> None:
        if self.transport.is_closing():
            return
        now, cycle = self.loop.time(), self.cycle
        if self._head_since is not None:
            late = now - self._head_since > HEAD_S
        elif cycle.response_complete:
            late = False
            if self._idle_since is None:  # something came, but no head began: blank lines
                self._head_since = now
            elif now - self._idle_since > self.timeout_keep_alive:
                self.transport.close()
                return
        else:
            late = cycle.more_body and now - self._body_since > self.body_s
        if not late:
            self._timer = self.loop.call_later(CHECK_PERIOD_S, self._check_phase)
            return
        self._end_with(LATE_REPLY if cycle is None or cycle.response_complete or not cycle.response_started else b"")

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _has_body(scope: Any) -> bool:
    """Whether a request that asks for an upgrade is anything else than a handshake."""
    if scope["method"] != "GET":
        return True
    return any(
        name == b"transfer-encoding" or (name == b"content-length" and value.strip() != b"0")
        for name, value in scope["headers"]
    )


def refusal(status: int, body: bytes, *more: tuple[bytes, bytes]) -> ASGIApp:
    """Return an application that answers every request so, in JSON; `more` are further headers."""
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body)), *more]

    async def refuse(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    return refuse


def leave_time_for_bodies(seconds: float) -> None:
    """Let connections of this process wait at least so long for a body: its route says when it has waited enough."""
    TimedProtocol.body_s = max(BODY_S, seconds)


def install(find: Callable[[Scope], ASGIApp | None]) -> None:
    """Let uvicorn's servers of this process use it; `find` knows what answers the requests that need not wait.

    Raises RuntimeError for another uvicorn than is known here.
    """
    if auto.AutoHTTPProtocol is TimedProtocol:
        return
    uvicorn_parts.check()
    TimedProtocol.find_app = staticmethod(find)
    auto.AutoHTTPProtocol = TimedProtocol
