"""A WebSocket's messages that are answered in the turn of the event loop that reads them, and those that are not."""

from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from rlservo.serve_app.protocols.http_endpoint import AT_ONCE
from rlservo.serve_app.ray_serve.busy_polling import BusyPolling
from rlservo.serve_app.ray_serve.http_connections import TimedProtocol

HANDSHAKE = (
    b"GET / HTTP/1.1\r\nhost: robot\r\nupgrade: websocket\r\nconnection: upgrade\r\nsec-websocket-version: 13\r\n"
    b"sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
Answer = Callable[[Any], Awaitable[Any]]


class Transport(asyncio.Transport):
    """Keeps what is written."""

    def __init__(self) -> None:
        super().__init__()
        self.written: list[bytes] = []
        self.is_closed = False
        self.protocol: Any = None

    def write(self, data: Any) -> None:
        self.written.append(bytes(data))

    def is_closing(self) -> bool:
        return self.is_closed

    def close(self) -> None:
        self.is_closed = True

    def set_protocol(self, protocol: Any) -> None:
        self.protocol = protocol

    def pause_reading(self) -> None: ...
    def resume_reading(self) -> None: ...


def frame(content: bytes, first: int = 0x82) -> bytes:
    return bytes((first, 0x80 | len(content), 0, 0, 0, 0)) + content


class Stream:
    """An open WebSocket, and what its application said of how it ended."""

    def __init__(self, answer: Answer | None) -> None:
        self.answer = answer
        self.received: list[Any] = []  # by the application itself
        self.ended: Any = None

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        if self.answer is not None:
            scope[AT_ONCE](self.answer)
        try:
            while (message := await receive())["type"] != "websocket.disconnect":
                self.received.append(message)
                await send(await (self.answer or echo)(message))
        except (ValueError, asyncio.CancelledError) as error:
            self.ended = error
        except OSError:
            self.ended = "before its reply was sent"
        else:
            self.ended = "by the client"

    async def open(self) -> None:
        config = uvicorn.Config(
            self.app, lifespan="off", interface="asgi3", log_level="critical", ws_ping_interval=None
        )
        config.load()
        self.transport = Transport()
        self.state = ServerState()
        protocol = TimedProtocol(config, self.state, {}, asyncio.get_running_loop())
        protocol.connection_made(self.transport)
        protocol.data_received(HANDSHAKE)
        await turns()
        assert self.transport.written[0].startswith(b"HTTP/1.1 101")
        self.transport.written.clear()

    def send(self, data: bytes) -> None:
        self.transport.protocol.data_received(data)

    @property
    def replies(self) -> list[bytes]:
        return [reply[2:] for reply in self.transport.written]


async def turns() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


async def echo(message: Any) -> Any:
    return {"type": "websocket.send", "bytes": message["bytes"]}


def test_every_reply_is_one_that_the_loop_may_stay_awake_after(monkeypatch: pytest.MonkeyPatch) -> None:
    noted: list[Any] = []
    monkeypatch.setattr(BusyPolling, "note_reply", lambda _, connection: noted.append(connection.client_id()))

    async def run() -> None:
        stream = Stream(echo)
        await stream.open()
        for number in range(3):
            stream.send(frame(b"%d" % number))
        assert len(noted) == 3 and len(set(noted)) == 1

    asyncio.run(run())


def test_a_message_is_answered_before_the_read_returns() -> None:
    async def run() -> None:
        stream = Stream(echo)
        await stream.open()
        for number in range(3):
            stream.send(frame(b"%d" % number))
            assert stream.replies == [b"%d" % each for each in range(number + 1)]
        await turns()
        assert stream.received == []
        stream.transport.protocol.connection_lost(None)
        await turns()
        assert stream.ended == "by the client"

    asyncio.run(run())


def test_without_the_applications_word_it_has_to_ask_for_each_message() -> None:
    async def run() -> None:
        stream = Stream(None)
        await stream.open()
        stream.send(frame(b"1"))
        assert stream.replies == []
        await turns()
        assert stream.replies == [b"1"] and len(stream.received) == 1

    asyncio.run(run())


def test_answers_keep_the_order_where_one_has_to_wait() -> None:
    async def run() -> None:
        go_on = asyncio.Event()

        async def answer(message: Any) -> Any:
            if message["bytes"] == b"slow":
                await go_on.wait()
            return await echo(message)

        stream = Stream(answer)
        await stream.open()
        stream.send(frame(b"slow"))
        stream.send(frame(b"second"))
        await turns()
        stream.send(frame(b"third"))
        await turns()
        assert stream.replies == []
        go_on.set()
        await turns()
        assert stream.replies == [b"slow", b"second", b"third"]
        stream.send(frame(b"at once again"))
        assert stream.replies[-1] == b"at once again"
        assert [message["bytes"] for message in stream.received] == [b"second", b"third"]

    asyncio.run(run())


def test_a_message_in_pieces_and_those_behind_it_keep_their_order() -> None:
    async def run() -> None:
        stream = Stream(echo)
        await stream.open()
        stream.send(frame(b"1") + frame(b"2"))  # two in one read
        stream.send(frame(b"3"))
        whole = frame(b"in two pieces")
        stream.send(whole[:7])
        await turns()
        stream.send(whole[7:])
        stream.send(frame(b"last"))
        await turns()
        assert stream.replies == [b"1", b"2", b"3", b"in two pieces", b"last"]

    asyncio.run(run())


@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("failure", [ValueError("no"), asyncio.CancelledError("no")], ids=["failed", "cancelled"])
def test_an_answer_that_fails_fails_in_the_application_before_another_is_given(
    waits: bool, failure: BaseException
) -> None:
    async def run() -> None:
        async def fail(message: Any) -> Any:
            if message["bytes"] != b"1":
                return await echo(message)
            if waits:
                await asyncio.sleep(0.001)
            raise failure

        stream = Stream(fail)
        await stream.open()
        for content in (b"1", b"2", b"3"):
            stream.send(frame(content))
        assert stream.replies == []
        await asyncio.sleep(0.1)
        assert stream.ended is failure and stream.received == []
        assert all(reply[:1] not in b"23" for reply in stream.replies)  # nothing but the close

    asyncio.run(run())


def test_what_the_application_began_ends_with_it() -> None:
    async def run() -> None:
        ended = False

        async def answer(_message: Any) -> Any:
            nonlocal ended
            try:
                await asyncio.sleep(60)
            finally:
                ended = True

        stream = Stream(answer)
        await stream.open()
        stream.send(frame(b"1"))
        await turns()
        (task,) = stream.state.tasks
        task.cancel()
        await turns()
        assert ended and isinstance(stream.ended, asyncio.CancelledError)

    asyncio.run(run())


def test_a_client_that_goes_while_its_reply_cannot_be_written_is_no_error_of_ours() -> None:
    async def run() -> None:
        stream = Stream(None)
        await stream.open()
        protocol = stream.transport.protocol
        protocol.pause_writing()
        stream.send(frame(b"1"))
        await turns()
        assert stream.replies == []
        stream.transport.is_closed = True
        protocol.connection_lost(None)
        await turns()
        assert stream.ended == "before its reply was sent" and stream.replies == []

    asyncio.run(run())


def test_nothing_is_left_for_the_garbage_collector() -> None:
    async def run() -> Any:
        stream = Stream(echo)
        await stream.open()
        stream.send(frame(b"1"))
        protocol = stream.transport.protocol
        stream.transport.is_closed = True
        protocol.connection_lost(None)
        stream.transport.protocol = None
        await turns()
        return weakref.ref(protocol)

    gc.collect()
    gc.disable()
    try:
        left = asyncio.run(run())
        assert left() is None
    finally:
        gc.enable()


def test_the_client_may_go_while_its_answer_waits() -> None:
    async def run() -> None:
        go_on = asyncio.Event()

        async def answer(message: Any) -> Any:
            await go_on.wait()
            return await echo(message)

        stream = Stream(answer)
        await stream.open()
        stream.send(frame(b"1"))
        stream.transport.is_closed = True
        stream.transport.protocol.connection_lost(None)
        await turns()
        assert stream.ended is None  # not before the answer is over
        go_on.set()
        await turns()
        assert stream.ended == "before its reply was sent" and stream.replies == []

    asyncio.run(run())
