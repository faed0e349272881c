"""The time-outs of a replica's HTTP connections: every phase a client may stop in. Real uvicorn, no Ray."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import http.client
import json
import random
import runpy
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from uvicorn.protocols.http import auto, httptools_impl
from uvicorn.server import ServerState

from rlservo.serve_app.ray_serve import http_connections, uvicorn_parts, websocket_connections
from rlservo.serve_app.ray_serve.http_connections import TimedProtocol
from rlservo.serve_app.ray_serve.ingress import Ingress
from rlservo.serve_app.ray_serve.websocket_connections import BoundedStream
from rlservo.serve_app.wire.replica_sockets import ASKER

SOON_S = 10.0  # a busy machine's
HANDSHAKE = (
    "upgrade: websocket\r\nconnection: upgrade\r\nsec-websocket-version: 13\r\n"
    "sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


async def app(scope: Any, receive: Any, send: Any) -> None:
    """Echo bodies; below /unread answer without reading them, at /much with 64 MB; accept and echo WebSockets."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] == "websocket.receive":
            await send({"type": "websocket.send", "bytes": message["bytes"]})
        return
    body = b"no"
    if scope["path"] == "/much":
        body = bytes(64 << 20)
    elif not scope["path"].startswith("/unread"):
        body, more = b"", True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body, more = body + message["body"], message["more_body"]
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


@contextlib.contextmanager
def running(listener: socket.socket) -> Iterator[uvicorn.Server]:
    config = uvicorn.Config(Ingress(app), http=TimedProtocol, log_level="critical", lifespan="off")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield server
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[uvicorn.Server]:
    """A server whose phases end after a second."""
    monkeypatch.setattr(http_connections, "HEAD_S", 1.0)
    monkeypatch.setattr(TimedProtocol, "body_s", 1.0)
    monkeypatch.setattr(http_connections, "UNREAD_S", 1.0)
    monkeypatch.setattr(http_connections, "CHECK_PERIOD_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listener, running(listener) as server:
        yield server


@pytest.fixture
def port(server: uvicorn.Server) -> int:
    return int(server.servers[0].sockets[0].getsockname()[1])


def until_closed(port: int, content: bytes) -> bytes:
    """Send this, and return all that comes until the server closes; fail where it does not."""
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        connection.sendall(content)
        return rest(connection)


def rest(connection: socket.socket) -> bytes:
    answer = b""
    deadline = time.monotonic() + SOON_S
    while piece := connection.recv(65536):
        answer += piece
        assert time.monotonic() < deadline
    return answer


@pytest.mark.parametrize("content", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nhost: x\r\n", b"\r\n"])
def test_a_head_that_does_not_come_ends_the_connection(port: int, content: bytes) -> None:
    answer = until_closed(port, content)
    assert answer.startswith(b"HTTP/1.1 408")
    assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "deadline-passed"


@pytest.mark.parametrize("more", [b"GET / HT", b"\r\n\r\n"])
def test_so_does_a_further_head(port: int, more: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        connection.sendall(b"GET /a HTTP/1.1\r\nhost: x\r\n\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200")
        connection.sendall(more)
        assert rest(connection).startswith(b"HTTP/1.1 408")


def test_a_body_that_does_not_come_ends_the_connection(port: int) -> None:
    head = b"POST / HTTP/1.1\r\nhost: x\r\ncontent-length: 100000\r\n\r\n"
    assert until_closed(port, head + b"x" * 1000).startswith(b"HTTP/1.1 408")


def test_a_body_has_as_long_as_its_route_gives_it(port: int) -> None:
    http_connections.leave_time_for_bodies(60.0)  # the fixture's end takes it back
    with socket.create_connection(("127.0.0.1", port), timeout=2.0) as connection:
        connection.sendall(b"POST / HTTP/1.1\r\nhost: x\r\ncontent-length: 4\r\n\r\nab")
        with pytest.raises(TimeoutError):
            connection.recv(1)
        connection.settimeout(SOON_S)
        connection.sendall(b"cd")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("announced", ["content-length: 10000000", "transfer-encoding: chunked"])
def test_a_reply_that_does_not_wait_for_the_body_ends_the_connection(port: int, announced: str) -> None:
    sent = b"ffff\r\n" + b"x" * 5000  # less than announced, whichever way
    for _ in range(3):  # a reply in the middle of a turn of the event loop, and one at its end
        answer = until_closed(port, f"POST /unread HTTP/1.1\r\nhost: x\r\n{announced}\r\n\r\n".encode() + sent)
        assert answer.startswith(b"HTTP/1.1 200") and answer.endswith(b"no")


def test_many_replies_at_once_are_not_lost(port: int) -> None:
    head = b"POST /unread HTTP/1.1\r\nhost: x\r\ncontent-length: 100000\r\n\r\n"
    with contextlib.ExitStack() as stack:
        made = [stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=SOON_S)) for _ in range(40)]
        for connection in made:
            connection.sendall(head)
        assert all(rest(connection).endswith(b"no") for connection in made)


@pytest.mark.parametrize("closes", [False, True])
def test_nor_is_a_stream_over_a_unix_socket_kept(closes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no kernel ends it; also when it is closing, which waits for what is to be written."""
    monkeypatch.setattr(websocket_connections, "UNREAD_S", 0.5)
    mask, size = bytes(4), 1 << 20
    frame = b"\x82\xff" + size.to_bytes(8, "big") + mask + bytes(size)
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as client:
        listener.bind(str(tmp_path / "s"))
        with running(listener) as server:
            client.settimeout(SOON_S)
            client.connect(str(tmp_path / "s"))
            client.sendall(f"GET / HTTP/1.1\r\nhost: x\r\n{HANDSHAKE}\r\n".encode())
            assert client.recv(65536).startswith(b"HTTP/1.1 101")
            client.sendall(frame)
            if closes:
                client.sendall(b"\x88\x80" + mask)
            deadline = time.monotonic() + SOON_S
            while server.server_state.connections:
                assert time.monotonic() < deadline
                time.sleep(0.05)


def test_a_stream_whose_client_reads_slowly_is_kept() -> None:
    """What is taken may be as much as has been sent meanwhile."""

    class Transport(asyncio.Transport):
        aborted = False

        def get_write_buffer_size(self) -> int:
            return 70_000

        def abort(self) -> None:
            self.aborted = True

    async def run() -> None:
        config = uvicorn.Config(Ingress(app), log_level="critical", lifespan="off")
        config.load()
        stream = BoundedStream(config=config, server_state=ServerState(), app_state={})
        stream.transport = transport = Transport()
        for _ in range(3):
            stream._has_sent = True
            stream._check_unread(70_000)
        assert not transport.aborted
        stream._check_unread(70_000)
        assert transport.aborted
        assert stream._unread_timer is not None
        stream._unread_timer.cancel()

    asyncio.run(run())


@pytest.mark.parametrize(("family", "client"), [(socket.AF_INET, None), (socket.AF_UNIX, ASKER)])
@pytest.mark.parametrize("protocol", [TimedProtocol, BoundedStream])
def test_a_connection_that_was_reset_is_not_taken_for_haproxys(
    protocol: type[TimedProtocol | BoundedStream], family: socket.AddressFamily, client: Any
) -> None:
    class Reset(socket.socket):
        def getpeername(self) -> Any:
            raise OSError(errno.ENOTCONN, "not connected")

    class Transport(asyncio.Transport):
        def get_write_buffer_size(self) -> int:
            return 0

        def close(self) -> None: ...

    async def run() -> Any:
        config = uvicorn.Config(Ingress(app), log_level="critical", lifespan="off")
        config.load()
        with Reset(family) as connection:
            made = protocol(config=config, server_state=ServerState(), app_state={})
            made.connection_made(Transport({"socket": connection}))
            found = made.client
            made.connection_lost(None)
        return found

    assert asyncio.run(run()) == client


def test_a_client_that_does_not_read_is_left(port: int, server: uvicorn.Server) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        connection.sendall(b"GET /much HTTP/1.1\r\nhost: x\r\n\r\n")
        deadline = time.monotonic() + 3 * SOON_S
        while not server.server_state.connections:
            time.sleep(0.01)
        while server.server_state.connections:
            assert time.monotonic() < deadline
            time.sleep(0.1)


@pytest.mark.parametrize(
    "request_line",
    ["POST /a", "GET /a", "PUT /a"],
)
@pytest.mark.parametrize(
    "body",
    [
        "content-length: 5\r\n\r\nhello",
        "content-length: 5\r\n\r\nhe",
        "transfer-encoding: chunked\r\n\r\n5\r\nhello\r\n",
    ],
)
@pytest.mark.parametrize("upgrade", [HANDSHAKE, "upgrade: h2c\r\nconnection: upgrade, http2-settings\r\n"])
def test_an_upgrade_with_a_body_is_answered_at_once(port: int, request_line: str, body: str, upgrade: str) -> None:
    answer = until_closed(port, f"{request_line} HTTP/1.1\r\nhost: x\r\n{upgrade}{body}".encode())
    assert answer.startswith(b"HTTP/1.1 400")
    assert "Upgrade" in json.loads(answer.partition(b"\r\n\r\n")[2])["error"]


def test_a_websocket_still_begins_and_outlives_the_phases_of_a_request(port: int) -> None:
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}/a") as stream:
        time.sleep(2.5)
        stream.send(b"hello")
        assert stream.recv(timeout=SOON_S) == b"hello"


def test_an_idle_connection_outlives_the_phases_of_a_request(port: int) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)
    for _ in range(3):
        connection.request("POST", "/", b"hello")
        assert connection.getresponse().read() == b"hello"
        assert connection.sock is not None
        time.sleep(1.5)
    connection.close()


NAMES = [(part, kind) for part in (uvicorn_parts.METHODS, uvicorn_parts.FIELDS) for kind in part]


@pytest.mark.parametrize(("part", "kind"), NAMES, ids=lambda one: getattr(one, "__name__", ""))
def test_a_uvicorn_without_what_it_uses_is_refused_by_name(
    part: dict[type, tuple[str, ...]], kind: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    uvicorn_parts.check()
    monkeypatch.setitem(part, kind, (*part[kind], "_moved_elsewhere"))
    refused = rf"uvicorn {uvicorn.__version__} .* has no {kind.__name__}\._moved_elsewhere, "
    with pytest.raises(RuntimeError, match=refused):
        http_connections.install(lambda _: None)
    assert auto.AutoHTTPProtocol is not TimedProtocol


def test_so_is_one_without_what_it_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(httptools_impl, "STATUS_LINE")
    with pytest.raises(RuntimeError, match=rf"uvicorn {uvicorn.__version__} .*STATUS_LINE"):
        runpy.run_path(uvicorn_parts.__file__)


# Streams: what comes faster than it can be answered.


def masked(opcode: int, payload: bytes, *, first: int = 0x80) -> bytes:
    """A client's frame; `first` is FIN and the reserved bits."""
    size = bytes([0x80 | len(payload)]) if len(payload) < 126 else b"\xfe" + len(payload).to_bytes(2, "big")
    return bytes([first | opcode]) + size + bytes(4) + payload


@pytest.fixture
def stream(port: int) -> Iterator[socket.socket]:
    """A WebSocket after its handshake, which offers compression."""
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        offer = "sec-websocket-extensions: permessage-deflate\r\n"
        connection.sendall(f"GET / HTTP/1.1\r\nhost: x\r\n{HANDSHAKE}{offer}\r\n".encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += connection.recv(1)
        assert answer.startswith(b"HTTP/1.1 101")
        assert b"extensions" not in answer.lower()
        yield connection


def closing_code(connection: socket.socket) -> int:
    """The code of the close frame that is the last to come."""
    answer = rest(connection)
    found = answer.rfind(b"\x88")
    return int.from_bytes(answer[found + 2 : found + 4], "big")


def test_a_stream_takes_nothing_compressed(stream: socket.socket) -> None:
    import zlib

    packer = zlib.compressobj(9, zlib.DEFLATED, -12)
    bomb = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_SYNC_FLUSH)
    stream.sendall(masked(2, bomb[:-4], first=0xC0))
    assert closing_code(stream) == 1002  # a reserved bit: nothing was agreed on


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param(masked(9, b"x") * 5000, id="pings"),
        pytest.param(masked(10, b"") * 5000, id="pongs"),
        pytest.param(masked(2, b"", first=0) + masked(0, b"", first=0) * 5000, id="empty fragments"),
        pytest.param(masked(2, b"x") * 5000, id="messages"),
    ],
)
def test_a_stream_that_floods_ends(stream: socket.socket, port: int, frames: bytes) -> None:
    with contextlib.suppress(OSError):  # it may end while this is being sent
        stream.sendall(frames)
    with contextlib.suppress(ConnectionResetError):  # what was not read destroys the close frame
        assert closing_code(stream) == 1008
    assert until_closed(port, b"GET / HTTP/1.1\r\nconnection: close\r\n\r\n").startswith(b"HTTP/1.1 200")


def test_a_stream_some_requests_ahead_gets_all_answers(stream: socket.socket) -> None:
    stream.sendall(masked(2, b"x") * 60 + masked(9, b"y") * 900)
    answer = b""
    while len(answer) < 960 * 3:
        answer += stream.recv(65536)
    assert answer.count(b"\x82\x01x") == 60
    assert answer.count(b"\x8a\x01y") == 900


@pytest.mark.parametrize("seed", range(20))
def test_a_streams_messages_are_the_same_however_its_bytes_are_cut(seed: int) -> None:
    """Of whole frames the parser sees nothing; it must see the rest of one that was cut, and what belongs together."""
    draw = random.Random(seed)
    expected, frames = [], []
    for size in draw.choices((0, 1, 125, 126, 300, 20000), k=30):
        payload, mask = draw.randbytes(size), draw.randbytes(4)
        expected.append(payload)
        frame = masked(2, payload)
        head = len(frame) - len(payload)
        frame = frame[: head - 4] + mask + bytes(byte ^ mask[at % 4] for at, byte in enumerate(payload))
        kind = draw.choice(("plain", "plain", "ping", "fragments"))
        if kind == "ping":
            frames.append(masked(9, b"p"))
        elif kind == "fragments":
            frames += [masked(2, payload[:1], first=0), masked(9, b"p"), masked(0, payload[1:])]
            continue
        frames.append(frame)
    pieces, whole = [], b"".join(frames)
    while whole and seed >= 10:  # else each frame is a read
        at = draw.choice((1, 3, 7, 131, 5000))
        pieces, whole = [*pieces, whole[:at]], whole[at:]

    assert messages_of(echoed(pieces or frames, draw)) == expected


def test_a_frame_in_a_message_that_is_cut_is_no_message() -> None:
    payload = masked(2, b"inside")
    frame = masked(2, payload)
    assert messages_of(echoed([frame[: -len(payload)], payload, masked(2, b"next")], random.Random(0))) == [
        payload,
        b"next",
    ]


def test_a_message_amid_fragments_ends_a_stream(stream: socket.socket) -> None:
    stream.sendall(masked(2, b"a", first=0))
    stream.sendall(masked(2, b"b"))
    assert closing_code(stream) == 1002


def echoed(pieces: list[bytes], draw: random.Random) -> bytes:
    """What a stream writes when these pieces are read, each by itself."""

    class Transport(asyncio.Transport):
        written = b""

        def write(self, data: Any) -> None:
            self.written += data

        def is_closing(self) -> bool:
            return False

        def pause_reading(self) -> None: ...
        def resume_reading(self) -> None: ...
        def close(self) -> None: ...

    async def run() -> bytes:
        config = uvicorn.Config(app, lifespan="off", log_level="critical")
        config.load()
        transport = Transport()
        protocol = BoundedStream(config, ServerState(), {}, asyncio.get_running_loop())
        protocol.connection_made(transport)
        protocol.data_received(f"GET / HTTP/1.1\r\nhost: x\r\n{HANDSHAKE}\r\n".encode())
        while not transport.written:
            await asyncio.sleep(0)
        transport.written = b""
        for piece in pieces:
            protocol.data_received(piece)
            for _ in range(draw.randrange(6)):
                await asyncio.sleep(0)
        for _ in range(100):
            await asyncio.sleep(0)
        protocol.connection_lost(None)
        return transport.written

    return asyncio.run(run())


def messages_of(written: bytes) -> list[bytes]:
    """The binary messages in a server's bytes."""
    found = []
    while written:
        size, start = written[1], 2
        if size >= 126:
            start = 4 if size == 126 else 10
            size = int.from_bytes(written[2:start], "big")
        if written[0] == 0x82:
            found.append(written[start : start + size])
        written = written[start + size :]
    return found


@pytest.mark.parametrize("size", [0, 125, 126, 65535, 65536, 300_000])
def test_a_message_of_any_size_comes_back(stream: socket.socket, size: int) -> None:
    payload = bytes(size)
    length = size.to_bytes(8, "big")
    stream.sendall(masked(2, payload) if size < 1 << 16 else b"\x82\xff" + length + bytes(4) + payload)
    answer, head = b"", 2 if size < 126 else 4 if size < 1 << 16 else 10
    while len(answer) < head + size:
        answer += stream.recv(1 << 20)
    assert messages_of(answer) == [payload]


def test_a_frame_without_a_mask_ends_a_stream(stream: socket.socket) -> None:
    stream.sendall(b"\x82\x0aunmasked..")
    assert closing_code(stream) == 1002


def test_a_stream_with_requests_ahead_lets_others_have_their_turns() -> None:
    class Transport(asyncio.Transport):
        def pause_reading(self) -> None: ...
        def resume_reading(self) -> None: ...

    async def run() -> list[str]:
        config = uvicorn.Config(app, lifespan="off")
        config.load()
        protocol = BoundedStream(config, ServerState(), {}, asyncio.get_running_loop())
        protocol.transport = Transport()
        order: list[str] = []
        for _ in range(3):
            protocol.queue.put_nowait({"type": "websocket.receive", "bytes": b""})

        async def other() -> None:
            order.append("other")

        task = asyncio.ensure_future(other())
        for _ in range(3):
            await protocol.receive()
            order.append("message")
        await task
        return order

    assert asyncio.run(run())[0] == "other"
