"""The writes of replies, on our connections with a transport that records them."""

from __future__ import annotations

import asyncio
from typing import Any

import uvicorn
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from rlservo.serve_app.ray_serve.http_connections import TimedProtocol
from rlservo.serve_app.ray_serve.joined_writes import Turn, turn_of


class Recorder(asyncio.Transport):
    """A transport that keeps what is written, write by write."""

    def __init__(self, events: list[str] | None = None) -> None:
        super().__init__()
        self.writes: list[bytes] = []
        self.closed = False
        self._events = [] if events is None else events

    def write(self, data: Any) -> None:
        assert not self.closed
        self.writes.append(bytes(data))
        if data:
            self._events.append("written")

    def close(self) -> None:
        self.closed = True

    def is_closing(self) -> bool:
        return self.closed

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return ("127.0.0.1", 1) if name in ("peername", "sockname") else default

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...

    def set_protocol(self, protocol: Any) -> None: ...


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer with the body, in the two messages of every ASGI answer."""
    body = (await receive()).get("body", b"")
    headers = [(b"content-length", b"%d" % len(body))]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def fails_after_the_head(scope: Scope, receive: Receive, send: Send) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"5")]})
    raise ValueError("the application's own fault")


async def streams(scope: Scope, receive: Receive, send: Send) -> None:
    async def parts() -> Any:
        for part in ("one", "two", "three"):
            yield part

    await StreamingResponse(parts())(scope, receive, send)


def exchange(app: Any, *pieces: bytes) -> Recorder:
    """Feed a request, piece by piece, to a connection; return what it wrote."""

    async def run() -> Recorder:
        config = uvicorn.Config(app, lifespan="off", log_level="critical", access_log=False)
        config.load()
        state = ServerState()
        connection = TimedProtocol(config=config, server_state=state, app_state={})
        transport = Recorder()
        connection.connection_made(transport)
        for piece in pieces:
            connection.data_received(piece)
            for _ in range(3):
                await asyncio.sleep(0)
        while state.tasks:
            await asyncio.gather(*state.tasks)
        connection.connection_lost(None)  # stops its keep-alive timer, too
        return transport

    return asyncio.run(run())


def post(body: bytes, *headers: bytes) -> bytes:
    lines = [b"POST /act HTTP/1.1", b"host: x", b"content-length: %d" % len(body), *headers, b"", body]
    return b"\r\n".join(lines)


def test_a_reply_to_post_is_one_write() -> None:
    writes = exchange(echo, post(b"hello")).writes
    assert b"".join(writes).startswith(b"HTTP/1.1 200") and b"".join(writes).endswith(b"\r\n\r\nhello")
    assert len([write for write in writes if write]) == 1


def test_every_reply_of_a_kept_connection_is_joined() -> None:
    writes = exchange(echo, post(b"first"), post(b"second")).writes
    assert [write.rpartition(b"\r\n\r\n")[2] for write in writes if write] == [b"first", b"second"]


def test_a_client_that_waits_for_100_continue_gets_it_at_once() -> None:
    request = post(b"hello", b"expect: 100-continue")
    writes = exchange(echo, request[:-5], request[-5:]).writes
    assert writes[0].startswith(b"HTTP/1.1 100") and b"".join(writes[1:]).endswith(b"hello")


def test_a_head_without_a_body_is_written_before_the_connection_closes() -> None:
    transport = exchange(fails_after_the_head, post(b"hello"))
    assert b"".join(transport.writes).startswith(b"HTTP/1.1 200") and transport.closed


def test_an_empty_body_does_not_hold_the_head_back() -> None:
    assert b"".join(exchange(echo, post(b"")).writes).startswith(b"HTTP/1.1 200")


def test_head_requests_and_streamed_replies_arrive_whole() -> None:
    head = exchange(echo, b"HEAD / HTTP/1.1\r\nhost: x\r\n\r\n").writes
    assert b"".join(head).startswith(b"HTTP/1.1 200")
    streamed = b"".join(exchange(streams, post(b"x")).writes)
    assert all(part in streamed for part in (b"HTTP/1.1 200", b"one", b"two", b"three", b"0\r\n\r\n"))


def crowd(app: Any, rounds: int, number: int = 4) -> tuple[list[str], list[Recorder]]:
    """Ask over so many connections at the same time, again and again; return what happened in the last round."""

    async def run() -> tuple[list[str], list[Recorder]]:
        events: list[str] = []

        async def noted(scope: Scope, receive: Receive, send: Send) -> None:
            events.append("asked")
            await app(scope, receive, send)

        config = uvicorn.Config(noted, lifespan="off", log_level="critical", access_log=False)
        config.load()
        state = ServerState()
        connections = [TimedProtocol(config=config, server_state=state, app_state={}) for _ in range(number)]
        recorders = [Recorder(events) for _ in connections]
        for connection, recorder in zip(connections, recorders, strict=True):
            connection.connection_made(recorder)
        for turn in range(rounds):
            events.clear()
            for number_, connection in enumerate(connections):
                connection.data_received(post(b"%d/%d" % (number_, turn)))
            for _ in range(6):
                await asyncio.sleep(0)
        for connection in connections:
            connection.connection_lost(None)
        return events, recorders

    return asyncio.run(run())


def test_in_a_crowd_the_replies_of_a_turn_are_written_after_all_were_computed() -> None:
    events, _ = crowd(echo, rounds=1)
    assert events == ["asked", "written"] * 4
    events, recorders = crowd(echo, rounds=2)
    assert events == ["asked"] * 4 + ["written"] * 4
    for number, recorder in enumerate(recorders):
        bodies = [write.rpartition(b"\r\n\r\n")[2] for write in recorder.writes if write]
        assert bodies == [b"%d/0" % number, b"%d/1" % number]


def test_no_more_than_sixteen_replies_are_held() -> None:
    events, _ = crowd(echo, rounds=2, number=20)
    assert events == ["asked"] * 16 + ["written"] * 16 + ["asked"] * 4 + ["written"] * 4


def test_all_connections_of_an_event_loop_share_a_turn_and_another_loop_has_another() -> None:
    async def find() -> list[Turn]:
        return [turn_of(asyncio.get_running_loop()) for _ in range(2)]

    (first, again), (other, _) = asyncio.run(find()), asyncio.run(find())
    assert first is again and first is not other


def test_in_a_crowd_a_stream_keeps_its_order_and_a_failure_its_head() -> None:
    for recorder in crowd(streams, rounds=3)[1]:
        assert b"".join(recorder.writes).count(b"3\r\none\r\n3\r\ntwo\r\n5\r\nthree\r\n0\r\n\r\n") == 3
    for recorder in crowd(fails_after_the_head, rounds=1)[1]:
        assert b"".join(recorder.writes).startswith(b"HTTP/1.1 200") and recorder.closed


def test_what_is_held_is_written_before_its_connection_closes() -> None:
    async def last(scope: Scope, receive: Receive, send: Send) -> None:
        body = (await receive())["body"]
        length = (b"content-length", b"%d" % len(body))
        headers = [length, (b"connection", b"close")] if body.endswith(b"/1") else [length]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    for number, recorder in enumerate(crowd(last, rounds=2)[1]):
        assert b"".join(recorder.writes).endswith(b"%d/1" % number) and recorder.closed
