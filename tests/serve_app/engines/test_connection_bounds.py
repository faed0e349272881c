"""Clients that send too much, too slowly, or read nothing: bounded memory, one sentence, others unharmed."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from rlservo.serve_app.engines.connection_bounds import HEAD_S, MAX_HEAD_BYTES, MAX_PIPELINED
from rlservo.serve_app.server.api_keys import new_key
from servers import Run, connected, launched

BODY = json.dumps({"obs": [0.01 * i for i in range(27)]}).encode()
PATH = "/v1/policies/ur5/act"
SLACK_S = 8.0  # [s] beyond a limit, on a busy machine
BODY_S = 1.0
PER_ADDRESS = 200
KEY, LINE = new_key("robot")


@pytest.fixture(scope="module")
def server(policies: Path) -> Iterator[Run]:
    """A server in a process of its own, so that its memory can be read; it wants a key."""
    settings = {"body_timeout_s": BODY_S, "max_connections_per_address": PER_ADDRESS, "api_keys": LINE}
    with launched(policies, settings=settings) as run:
        run.wait_until_ready()
        yield run


def head(*lines: str, method: str = "POST", path: str = PATH) -> bytes:
    fields = [f"{method} {path} HTTP/1.1", "host: localhost", f"authorization: Bearer {KEY}", *lines]
    if method == "POST":
        fields.append("content-type: application/json")
    return "".join(f"{line}\r\n" for line in fields).encode() + b"\r\n"


UPGRADE = head(
    "upgrade: websocket",
    "connection: upgrade",
    "sec-websocket-version: 13",
    "sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==",
    method="GET",
    path="/v1/policies/ur5/stream",
)
WHOLE = head(f"content-length: {len(BODY)}") + BODY


def read_reply(connection: socket.socket) -> tuple[int, dict[str, str], bytes]:
    """Return (status, headers, body) of one reply. Raises OSError where the connection ends before."""
    received = b""
    while b"\r\n\r\n" not in received:
        piece = connection.recv(65536)
        if not piece:
            raise ConnectionError(f"closed after {received!r}")
        received += piece
    first, _, rest = received.partition(b"\r\n\r\n")
    lines = first.decode().split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines[1:])}
    while len(rest) < int(headers.get("content-length", 0)):
        rest += connection.recv(65536)
    return int(lines[0].split()[1]), headers, rest


def exchange(run: Run, sent: bytes, timeout_s: float = 30) -> tuple[int, bytes]:
    with contextlib.closing(connected(run.port, timeout_s)) as connection:
        connection.sendall(sent)
        status, _, body = read_reply(connection)
        return status, body


def memory_mb(run: Run) -> float:
    return float(psutil.Process(run.processes("-c")[0]).memory_info().rss) / 2**20


@contextlib.contextmanager
def others_are_answered(run: Run) -> Iterator[None]:
    """Ask over one connection all the while, and assert that every request got its action."""
    ended, failures, answered = threading.Event(), [], 0

    def ask() -> None:
        nonlocal answered
        with contextlib.closing(connected(run.port, 20)) as connection:
            while not ended.is_set():
                connection.sendall(WHOLE)
                status, _, body = read_reply(connection)
                if status != 200:
                    failures.append((status, body))
                answered += 1
                time.sleep(0.01)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield
        deadline = time.monotonic() + 20
        while answered < 10 and thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.05)
    finally:
        ended.set()
        thread.join(30)
    assert failures == [] and answered >= 10 and not thread.is_alive()


@pytest.mark.slow
def test_what_does_not_arrive_is_answered_408(server: Run) -> None:
    limits_s = {
        b"": HEAD_S,
        b"POST /v1/pol": HEAD_S,
        head("content-length: 100") + b"{": BODY_S,
        head("transfer-encoding: chunked") + b"5\r\nab": BODY_S,
    }

    def send(sent: bytes) -> tuple[int, bytes, float]:
        began = time.monotonic()
        return *exchange(server, sent), time.monotonic() - began

    with ThreadPoolExecutor() as pool:
        for limit_s, (status, body, taken_s) in zip(limits_s.values(), pool.map(send, limits_s), strict=True):
            sentence = f"the request did not arrive within {limit_s:g} s"
            assert status == 408 and json.loads(body) == {"error": sentence, "code": "deadline-passed"}
            assert limit_s <= taken_s < limit_s + SLACK_S


@pytest.mark.slow
def test_bytes_that_trickle_in_do_not_prolong_a_head(server: Run) -> None:
    with contextlib.closing(connected(server.port, 30)) as connection, others_are_answered(server):
        began = time.monotonic()
        connection.sendall(b"POST /v1/policies/ur5/act HTTP/1.1\r\n")
        with contextlib.suppress(OSError):
            while time.monotonic() - began < HEAD_S + SLACK_S:
                connection.sendall(b"x-a: b\r\n")
                time.sleep(0.2)
        assert time.monotonic() - began < HEAD_S + SLACK_S


@pytest.mark.parametrize("pieces", [1, 64], ids=["at once", "in pieces"])
def test_a_head_that_is_too_large_is_refused(server: Run, pieces: int) -> None:
    sent = b"POST / HTTP/1.1\r\nx: " + b"a" * (2 * MAX_HEAD_BYTES)
    with contextlib.closing(connected(server.port, 20)) as connection:
        with contextlib.suppress(OSError):  # it may answer before all is sent
            for start in range(0, len(sent), len(sent) // pieces):
                connection.sendall(sent[start : start + len(sent) // pieces])
        status, headers, body = read_reply(connection)
    assert (status, headers["connection"]) == (431, "close")
    assert json.loads(body)["error"] == "the request's headers are larger than 16384 bytes"


def test_a_complete_head_that_is_too_large_is_refused(server: Run) -> None:
    sent = WHOLE.replace(b"host:", b"x: " + b"a" * 30_000 + b"\r\nhost:")
    with contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(sent)
        status, _, body = read_reply(connection)
    assert status == 431 and json.loads(body)["error"] == "the request's headers are larger than 16384 bytes"


def test_a_trailer_is_not_a_header(policies: Path, server: Run) -> None:
    """Neither a key, nor a host, nor a page's origin counts there; what came before the body does."""
    chunked = b"%x\r\n%s\r\n0\r\n" % (len(BODY), BODY)
    start = (
        "POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ntransfer-encoding: chunked\r\n"
    )
    without_key = start.format(path=PATH).encode() + b"\r\n"
    key = f"authorization: Bearer {KEY}\r\n"
    assert exchange(server, without_key + chunked + f"{key}\r\n".encode())[0] == 401
    with_key = start.format(path=PATH).encode() + key.encode() + b"\r\n"
    for trailer in (b"", b"host: evil.example\r\n", b"origin: http://evil.example\r\n", b"content-type: a/b\r\n"):
        status, body = exchange(server, with_key + chunked + trailer + b"\r\n")
        assert status == 200, body


ENDLESS = {"many lines": b"x: " + b"a" * 60000 + b"\r\n", "one line": b"a" * 60000}


@pytest.mark.parametrize("piece", ENDLESS.values(), ids=ENDLESS)
def test_endless_trailers_end_the_connection(server: Run, piece: bytes) -> None:
    """At 16 KB, besides what is on its way: sockets of both sides and two reads take less than 8 MB."""
    before = memory_mb(server)
    with contextlib.closing(connected(server.port, 20)) as connection, others_are_answered(server):
        connection.sendall(head("transfer-encoding: chunked") + b"%x\r\n%s\r\n0\r\nx: " % (len(BODY), BODY))
        sent = 0
        with pytest.raises(OSError):
            while sent < 256 << 20:
                sent += connection.send(piece)
    assert sent < 8 << 20
    assert memory_mb(server) - before < 64


def test_an_endless_trailer_is_refused_with_its_bound(server: Run) -> None:
    """A body before them counts to neither bound, whether in one read or in many."""
    large = b" " * 50_000 + BODY
    chunked = head("transfer-encoding: chunked") + b"%x\r\n%s\r\n0\r\n" % (len(large), large)
    with contextlib.closing(connected(server.port, 20)) as connection:
        for start in range(0, len(chunked), 10_000):
            connection.sendall(chunked[start : start + 10_000])
            time.sleep(0.02)  # a read each
        connection.sendall(b"x: " + b"a" * 15_000 + b"\r\n\r\n")
        assert read_reply(connection)[0] == 200
        connection.sendall(chunked + b"x: ")
        for _ in range(17):
            connection.sendall(b"a" * 1000)
            time.sleep(0.02)
        status, headers, body = read_reply(connection)
    assert (status, headers["connection"]) == (400, "close")
    assert json.loads(body)["error"] == "the request's trailers are larger than 16384 bytes"


def test_a_head_after_a_large_body_in_one_read_is_not_too_large(server: Run) -> None:
    large = b" " * 50_000 + BODY
    with contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(head(f"content-length: {len(large)}") + large + WHOLE[:20])
        assert read_reply(connection)[0] == 200
        connection.sendall(WHOLE[20:])
        assert read_reply(connection)[0] == 200


def test_pipelined_requests_that_no_one_reads_take_bounded_memory(server: Run) -> None:
    """Each of 40 connections sends 20 MB of small requests and reads nothing."""
    flood = head(method="GET", path="/v1/policies") * 2000
    before = memory_mb(server)
    connections = [connected(server.port, 1) for _ in range(40)]
    try:
        with others_are_answered(server):
            for connection in connections:
                with contextlib.suppress(OSError):
                    for _ in range(100):
                        connection.sendall(flood)
            assert memory_mb(server) - before < 128
    finally:
        for connection in connections:
            connection.close()


def test_a_few_pipelined_requests_are_answered_in_order(server: Run) -> None:
    with contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(WHOLE * MAX_PIPELINED)
        replies = connection.makefile("rb")
        for _ in range(MAX_PIPELINED):
            assert replies.readline().startswith(b"HTTP/1.1 200")
            length = 0
            while (line := replies.readline()) != b"\r\n":
                if line.lower().startswith(b"content-length"):
                    length = int(line.partition(b":")[2])
            assert b"action" in replies.read(length)


def test_more_pipelined_requests_are_refused(server: Run) -> None:
    with others_are_answered(server), contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(WHOLE * (MAX_PIPELINED + 2))
        received = b"".join(iter(lambda: connection.recv(65536), b""))
        assert b"more than 32 requests were sent before the first one was answered" in received


def test_a_refusal_before_the_body_reaches_a_client_that_still_sends(server: Run) -> None:
    """An early 401 neither loses its own reply nor anybody else's."""
    without_key = f"POST {PATH} HTTP/1.1\r\nhost: localhost\r\ncontent-length: 3000000\r\n\r\n".encode()
    with others_are_answered(server):
        for _ in range(20):
            with contextlib.closing(connected(server.port, 20)) as connection:
                connection.sendall(without_key + b"a" * 100_000)
                status, _, body = read_reply(connection)
                assert status == 401 and json.loads(body)["code"] == "unauthenticated"


@pytest.mark.slow
def test_the_rest_of_a_refused_body_is_not_awaited_indefinitely(server: Run) -> None:
    without_key = f"POST {PATH} HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n".encode()
    with contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(without_key)
        assert read_reply(connection)[0] == 401
        began = time.monotonic()
        with pytest.raises(OSError):
            while time.monotonic() - began < BODY_S + SLACK_S:
                connection.sendall(b"5\r\naaaaa\r\n")
                time.sleep(0.05)


def test_a_body_that_is_too_large_is_refused_and_takes_no_memory(server: Run) -> None:
    before = memory_mb(server)
    status, body = exchange(server, head("content-length: 3000000000"))
    assert status == 413 and "larger than 4194304 bytes" in json.loads(body)["error"]
    with contextlib.closing(connected(server.port, 20)) as connection, contextlib.suppress(OSError):
        connection.sendall(head("transfer-encoding: chunked"))
        for _ in range(200):
            connection.sendall(b"100000\r\n" + b"a" * 0x100000 + b"\r\n")
    assert memory_mb(server) - before < 64


@pytest.mark.parametrize(
    "sent",
    [
        head("content-length: 5", "transfer-encoding: chunked") + b"0\r\n\r\n",
        head("content-length: 5", "content-length: 6") + b"aaaaaa",
        head("content-length: +5") + b"aaaaa",
        head("transfer-encoding: xchunked") + b"0\r\n\r\n",
        head("transfer-encoding: chunked") + b"5;\x00\r\naaaaa\r\n0\r\n\r\n",
        b"POST / HTTP/1.1\r\nhost: a\r\ncontent-length : 5\r\n\r\naaaaa",
        head("upgrade: websocket", "connection: upgrade", "content-length: 5") + b"aaaaa",
        head("upgrade: h2c", "connection: upgrade, http2-settings", "http2-settings: AAMAAABkAAQAAP__"),
        b"CONNECT 127.0.0.1:80 HTTP/1.1\r\nhost: a\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    ],
)
def test_ambiguous_requests_end_their_connection(server: Run, sent: bytes) -> None:
    """What follows such a request on its connection is never taken for another one."""
    with contextlib.closing(connected(server.port, 20)) as connection:
        connection.sendall(sent + WHOLE)
        received = b""
        with contextlib.suppress(OSError):
            while piece := connection.recv(65536):
                received += piece
    assert received.startswith(b"HTTP/1.1 400") and b'"action"' not in received, received


def test_connections_of_one_address_are_bounded(server: Run) -> None:
    connections = []
    try:
        for _ in range(PER_ADDRESS):
            connections.append(connected(server.port, 20))
        time.sleep(0.2)
        status, body = exchange(server, WHOLE)
        assert status == 429 and json.loads(body)["code"] == "over-capacity"
        assert "more than 200 connections" in json.loads(body)["error"]
    finally:
        for connection in connections:
            connection.close()
    deadline = time.monotonic() + 10
    while (answer := exchange(server, WHOLE))[0] != 200:
        assert time.monotonic() < deadline, answer
        time.sleep(0.1)


def test_connections_that_ended_do_not_count_and_other_addresses_do_not_either(server: Run) -> None:
    """Ended as HTTP or as a WebSocket, by either side, and also while the connection is upgraded."""
    for sent in (b"", WHOLE, b"\x16\x03", UPGRADE, UPGRADE + frame(0x8, b"")):
        for _ in range(PER_ADDRESS):
            with contextlib.closing(connected(server.port, 20)) as connection:
                connection.sendall(sent)
                if sent == UPGRADE:
                    assert connection.recv(1000).startswith(b"HTTP/1.1 101")
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset
    others = [
        socket.create_connection(("127.0.0.1", server.port), 20, source_address=("127.0.0.2", 0))
        for _ in range(PER_ADDRESS)
    ]
    try:
        deadline = time.monotonic() + 10
        while (answer := exchange(server, WHOLE))[0] != 200:
            assert time.monotonic() < deadline, answer
            time.sleep(0.1)
        own = []
        with contextlib.ExitStack() as stack:
            for _ in range(PER_ADDRESS):
                own.append(stack.enter_context(contextlib.closing(connected(server.port, 20))))
            own[-1].sendall(WHOLE)
            assert read_reply(own[-1])[0] == 200
    finally:
        for connection in others:
            connection.close()


def test_what_connections_are_refused_for_is_counted(server: Run) -> None:
    exchange(server, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + os.urandom(8))
    _, text = exchange(server, head(method="GET", path="/metrics"))
    assert b'code="bad-request"' in text


def frame(opcode: int, payload: bytes, *, final: bool = True) -> bytes:
    """Return a client's frame, masked with zeros: the payload as it is."""
    assert len(payload) < 126
    return bytes([opcode | (0x80 if final else 0), 0x80 | len(payload)]) + bytes(4) + payload


@contextlib.contextmanager
def web_socket(run: Run, **options: int) -> Iterator[socket.socket]:
    """Open a WebSocket; `options` are the TCP socket's."""
    with socket.socket() as connection:
        for name, value in options.items():
            level = socket.IPPROTO_TCP if name.startswith("TCP_") else socket.SOL_SOCKET
            connection.setsockopt(level, getattr(socket, name), value)
        connection.settimeout(20)
        connection.connect(("127.0.0.1", run.port))
        connection.sendall(UPGRADE)
        received = b""
        while b"\r\n\r\n" not in received:
            received += connection.recv(65536)
        assert received.startswith(b"HTTP/1.1 101")
        yield connection


@pytest.mark.parametrize(
    ("flood", "reason"),
    [
        (frame(0x9, b""), b"more than 1000 pings, pongs or fragments in a second"),
        (frame(0xA, b""), b"more than 1000 pings, pongs or fragments in a second"),
        (frame(0x2, b"a"), b"more than 64 requests are unanswered"),
    ],
    ids=["pings", "pongs", "messages"],
)
def test_a_flood_of_frames_ends_the_stream_with_the_reason(server: Run, flood: bytes, reason: bytes) -> None:
    before = memory_mb(server)
    with others_are_answered(server), web_socket(server) as stream:
        with contextlib.suppress(OSError):
            for _ in range(50):
                stream.sendall(flood * 20_000)
        received = b""
        with contextlib.suppress(OSError):
            while piece := stream.recv(65536):
                received += piece
        assert reason in received
    assert memory_mb(server) - before < 64


def test_pings_of_a_client_that_reads_no_pong_are_not_read_either(server: Run) -> None:
    """They come slower than the bound on frames, and the kernel's buffers are small."""
    with (
        web_socket(server, TCP_MAXSEG=536, SO_RCVBUF=4096, SO_SNDBUF=4096) as stream,
        others_are_answered(server),
        pytest.raises(TimeoutError),
    ):
        stream.settimeout(1.0)
        for _ in range(400):
            stream.sendall(frame(0x9, b"a" * 125) * 20)
            time.sleep(0.045)


def test_a_message_too_large_is_closed_with_its_code(server: Run) -> None:
    with web_socket(server) as stream:
        size = (50 << 20).to_bytes(8, "big")
        with contextlib.suppress(OSError):
            stream.sendall(b"\x82\xff" + size + bytes(4) + bytes(50 << 20))
        received = b""
        with contextlib.suppress(OSError):
            while piece := stream.recv(65536):
                received += piece
    assert (1009).to_bytes(2, "big") in received
