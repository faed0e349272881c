"""uvicorn's WebSockets, bounded in what a client may send before it is answered.

uvicorn (0.54) takes whatever comes: 16 KB that unpack to 16 MB, again and again (`http_connections.py` turns
compression off); as many frames at once as fit a read, which the application then answers one after the other while
the event loop stands still; pings whose answers nobody reads.

A message that comes while the application waits for one is answered in the turn of the event loop that reads it, as
requests are (`http_connections.py`): no queue, and no task to wake up. Where the answer has to wait or fails, the
application wakes up after all: it waits for it, and fails as it does, before it is given any other message.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rlservo.serve_app.protocols.http_endpoint import AT_ONCE
from rlservo.serve_app.ray_serve.eager_tasks import start_at_once
from rlservo.serve_app.ray_serve.joined_writes import turn_of
from rlservo.serve_app.ray_serve.uvicorn_parts import (
    OPEN,
    WebSocketsSansIOProtocol,
    apply_mask,  # pyright: ignore[reportPrivateImportUsage]
)
from rlservo.serve_app.wire.replica_sockets import ASKER, is_unix

if TYPE_CHECKING:
    from starlette.types import Message
    from websockets.frames import Frame

UNREAD_S = 10.0
"""[s] that sent bytes may wait for a client that does not read."""
PIECE_BYTES = 16384
"""Of a WebSocket, between two checks of how much has come: uvloop reads 256 KB at once, which are 40,000 frames."""
MOST_AHEAD = 64
"""Requests of a stream that wait for those before them: request and answer alternate, a late answer lets some wait."""
# Of a frame's first two bytes (RFC 6455, 5.2): what begins one that is a whole message, or none.
BINARY, MASKED, LENGTH_FOLLOWS = 0x82, 0x80, 126
WHOLE = bytes((0x81, BINARY, 0x88, 0x89, 0x8A))
MOST_EMPTY, SMALL_BYTES = 1000, 512
"""Frames of a WebSocket in a second that complete no message: pings, pongs, small fragments."""

TOO_MUCH = 1008  # the close code "policy violation"
WAKE = "wake"  # queued for the application where an answer that was begun is not over, or has failed


class BoundedStream(WebSocketsSansIOProtocol):
    """A WebSocket that ends when its client sends more than it can be answered, and lets others have their turns."""

    _since = float("-inf")  # when the second began in which `_empty` counts
    _empty = 0
    _is_at_frame = False  # whether what is read next begins a frame
    _answer: Callable[[Message], Awaitable[Message]] | None = None  # the application's, for a message at once
    _is_awaited = False  # whether the application waits for a message
    _rest: asyncio.Task[None] | None = None  # of an answer that has to wait
    _unread_timer: asyncio.TimerHandle | None = None
    _has_sent = False  # since the last look for whether the client reads
    _failure: BaseException | None = None  # of an answer that was begun

    def __init__(self, *arguments: Any, on_lost: Callable[[], None] | None = None, **more: Any) -> None:
        """Call `on_lost` when the connection has ended."""
        super().__init__(*arguments, **more)
        self._on_lost = on_lost

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Over a Unix socket take HAProxy for who asks, and look for whether it reads, as TCP would."""
        super().connection_made(transport)
        self._polling = turn_of(self.loop).polling
        if is_unix(transport):
            self.client = ASKER
            self._check_unread(0)

    def client_id(self) -> object:
        """Return who asks: a WebSocket is one client's, through a proxy, too."""
        return id(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Say so."""
        if self._unread_timer is not None:
            self._unread_timer.cancel()
        super().connection_lost(exc)
        if self._on_lost is not None:
            self._on_lost()

    def data_received(self, data: bytes) -> None:
        """Read what has come, piece by piece, until it is too much."""
        if self.conn.state is not OPEN:  # the handshake, and what comes before it is answered
            self._is_at_frame = not self.handshake_initiated
        elif self._is_at_frame and (message := self._find_message(data)) is not None:
            event: Any = {"type": "websocket.receive", "bytes": message}
            waits = not self.queue.empty()
            if self._is_awaited and self._answer is not None and not waits:
                self._begin(self._answer, event)
                return
            self.queue.put_nowait(event)
            if waits and not self.read_paused:  # it costs two system calls, which one message is not worth
                self.read_paused = True
                self.transport.pause_reading()
            return
        for start in range(0, len(data), PIECE_BYTES):
            if self.transport.is_closing():
                return
            super().data_received(data[start : start + PIECE_BYTES])
            if self.queue.qsize() > MOST_AHEAD:
                self._end(f"more than {MOST_AHEAD} requests wait: await answers")
            elif self._empty > MOST_EMPTY:
                self._end(f"more than {MOST_EMPTY} pings or fragments in a second")

    def handle_ping(self) -> None:
        """Answer it."""
        self._count()
        super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Count it."""
        self._count()
        super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """Take a message's next fragment."""
        if not event.fin and len(event.data) < SMALL_BYTES:
            self._count()
        super().handle_cont(event)

    def _find_message(self, data: bytes) -> bytes | None:
        """Return the message that has come, where that is one binary frame and nothing else.

        Nearly all are. The library's parser takes as long for one as a small policy does, and sees all others. From
        the first on that does not end where a read does, it sees everything: nobody else knows where frames begin.
        """
        start, size, frames = 0, len(data), 0
        content = 0
        while start + 6 <= size and data[start] in WHOLE and data[start + 1] >= MASKED:
            length, content = data[start + 1] - MASKED, start + 6
            if length >= LENGTH_FOLLOWS:
                if length > LENGTH_FOLLOWS or start + 8 > size:
                    break
                length, content = data[start + 2] << 8 | data[start + 3], start + 8
            start, frames = content + length, frames + 1
        if start != size:
            self._is_at_frame = False
            return None
        if frames > 1 or data[0] != BINARY or size > PIECE_BYTES or self.close_sent:
            return None
        return apply_mask(data[content:], data[content - 4 : content])

    async def run_asgi(self) -> None:
        """Run the application, which may say how messages are answered at once."""
        scope: Any = self.scope
        scope[AT_ONCE] = self._set_answer
        try:
            await super().run_asgi()
        finally:  # what it began ends with it, and no cycle of references is left
            if self._rest is not None:
                self._rest.cancel()
            scope.pop(AT_ONCE, None)
            self._answer = None

    def _set_answer(self, answer: Callable[[Message], Awaitable[Message]]) -> None:
        self._answer = answer

    def _begin(self, answer: Callable[[Message], Awaitable[Message]], event: Message) -> None:
        self._rest = start_at_once(self._take_turn(answer, event), self.loop)
        if self._rest is not None or self._failure is not None:
            wake: Any = {"type": WAKE}
            self.queue.put_nowait(wake)

    async def _take_turn(self, answer: Callable[[Message], Awaitable[Message]], event: Message) -> None:
        try:
            await self.send(await answer(event))
        except (Exception, asyncio.CancelledError) as failure:  # for the application, as if it had answered itself
            self._failure = failure

    async def send(self, message: Any) -> None:
        """Send a message; a binary one as a frame of its own."""
        if not self.writable.is_set():  # until the client reads, or has gone
            await self.writable.wait()
        self._has_sent = True
        content = message.get("bytes")
        if content is None or self.close_sent or self.disconnected or self.conn.state is not OPEN:
            await super().send(message)
            return
        size = len(content)
        if size < LENGTH_FOLLOWS:
            head = b"\x82%c" % size
        elif size < 1 << 16:
            head = b"\x82\x7e" + size.to_bytes(2, "big")
        else:
            head = b"\x82\x7f" + size.to_bytes(8, "big")
        self.transport.write(head + content)
        self._polling.note_reply(self)  # after it: the client waits for the frame

    async def receive(self) -> Message:  # type: ignore[override]
        """Return the next message; others have their turn before one that has come already."""
        if not self.queue.empty():
            await asyncio.sleep(0)
        while True:
            self._is_awaited = True
            try:
                message: Any = await super().receive()
            finally:
                self._is_awaited = False
            if self._rest is not None:
                await self._rest
                self._rest = None
            if self._failure is not None:
                failure, self._failure = self._failure, None
                raise failure
            if message["type"] != WAKE:
                return message  # type: ignore[no-any-return]

    def _check_unread(self, before: int) -> None:
        """End the connection, however it was closed, where none of what is to be written is taken (TCP_USER_TIMEOUT).

        `before` is how many bytes that were at the last look. Where more has been sent since, some may have been taken:
        for a client that reads nothing, nothing is sent any more when enough waits.
        """
        left, has_sent, self._has_sent = self.transport.get_write_buffer_size(), self._has_sent, False
        if left >= before > 0 and not has_sent:
            self.transport.abort()
        else:
            self._unread_timer = self.loop.call_later(UNREAD_S, self._check_unread, left)

    def _count(self) -> None:
        now = self.loop.time()
        if now - self._since > 1.0:
            self._since, self._empty = now, 0
        self._empty += 1

    def _end(self, reason: str) -> None:
        if self.transport.is_closing():
            return
        while not self.queue.empty():
            self.queue.get_nowait()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": TOO_MUCH, "reason": reason})
        self.stop_keepalive()
        self.conn.fail(TOO_MUCH, reason)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = self.disconnected = True  # what the application still sends is for nobody
        self.transport.close()
