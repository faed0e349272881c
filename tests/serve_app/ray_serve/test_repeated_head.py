"""Heads that come again: what is taken for the same head the parser reads the same, and everything else goes to it."""

from __future__ import annotations

import random
from typing import Any

import httptools
import pytest

from rlservo.serve_app.ray_serve.http_connections import RepeatedHead
from rlservo.serve_app.wire.request_stamp import STAMP

Header = tuple[bytes, bytes]

LINES = (b"Host: 127.0.0.1:8000", b"Content-Type: application/json", b"Authorization: Bearer abc")
STAMPED = b"%s: 1763937000000-4a1b-77" % STAMP.encode()


class Read:
    """What uvicorn's parser makes of bytes."""

    def __init__(self, data: bytes) -> None:
        self.headers: list[Header] = []
        self.body, self.url = b"", b""
        self.ends = 0
        parser: Any = httptools.HttpRequestParser(self)
        parser.feed_data(data)
        self.method = parser.get_method()

    def on_url(self, url: bytes) -> None:
        self.url += url

    def on_header(self, name: bytes, value: bytes) -> None:
        self.headers.append((name.lower(), value))

    def on_body(self, body: bytes) -> None:
        self.body += body

    def on_message_complete(self) -> None:
        self.ends += 1


def request(body: bytes = b'{"obs":[1.5]}', *, length: bytes | None = None, lines: tuple[bytes, ...] = LINES) -> bytes:
    length = b"%d" % len(body) if length is None else length
    return b"\r\n".join((b"POST /act HTTP/1.1", *lines, b"Content-Length: " + length, STAMPED, b"", body))


def scope_of(data: bytes) -> dict[str, Any]:
    return {"http_version": "1.1", "path": "/act", "headers": Read(data).headers}


def learn(data: bytes) -> RepeatedHead:
    known = RepeatedHead.learn(data, scope_of(data))
    assert known is not None
    return known


def test_a_head_may_say_that_the_connection_is_kept() -> None:
    data = request(lines=(*LINES, b"Connection: Keep-Alive"))
    assert learn(data).read(data) == (scope_of(data), b'{"obs":[1.5]}')


def test_the_length_and_the_stamp_may_vary() -> None:
    known = learn(request())
    other = request(b'{"obs":[-1.2345]}').replace(b"0000-4a1b-77", b"0010-4a1b-912345")
    found = known.read(other)
    assert found is not None
    scope, body = found
    assert body == b'{"obs":[-1.2345]}' and scope["path"] == "/act"
    assert scope["headers"] == Read(other).headers != Read(request()).headers
    assert known.read(request()) == (scope_of(request()), b'{"obs":[1.5]}')


@pytest.mark.parametrize(
    "other",
    [
        request(lines=(*LINES[:2], b"Authorization: Bearer abd")),
        request(lines=LINES[:2]),
        request(lines=(*LINES, b"Transfer-Encoding: chunked")),
        request().replace(b"POST /act", b"POST /acu"),
        request().replace(b"HTTP/1.1", b"HTTP/1.0"),
        *(request(length=length) for length in (b"", b"-13", b"+13", b"13 ", b" 13", b"1_3", b"0xd", b"12", b"14")),
        *(request(length=length) for length in (b"1" * 200, "\u0661\u0663".encode(), b"13\r\nContent-Length: 13")),
        request().replace(b"4a1b", b"4a\x00b"),
        request().replace(b"4a1b", b"4a\nb"),
        request()[:-1],
        request() + b" ",
        request() * 2,
        b"",
    ],
)
def test_anything_else_is_for_the_parser(other: bytes) -> None:
    assert learn(request()).read(other) is None


@pytest.mark.parametrize(
    "data",
    [
        request(lines=(*LINES, b"Content-Length: 13")),
        request(lines=(*LINES, STAMPED)),
        request(lines=(*LINES, b"Expect: 100-continue")),
        request(lines=(*LINES, b"Connection: close")),
        request(lines=(*LINES, b"Connection: Upgrade", b"Upgrade: websocket")),
        request() * 2,
        request()[:-1],
    ],
)
def test_nothing_is_learnt_from_an_unusual_request(data: bytes) -> None:
    headers = [
        (name.lower(), value) for name, _, value in (line.partition(b": ") for line in data.split(b"\r\n")[1:-2])
    ]
    assert RepeatedHead.learn(data, {"http_version": "1.1", "headers": headers}) is None
    assert RepeatedHead.learn(request(), {**scope_of(request()), "http_version": "1.0"}) is None


def test_what_is_taken_for_the_same_head_the_parser_reads_the_same() -> None:
    """Bytes changed, put in and taken out at random: never a body, a header or a length that the parser has not."""
    known, draw = learn(request()), random.Random(0)
    taken = 0
    for _ in range(20_000):
        data = bytearray(request(b"[" + b"1" * draw.randrange(30) + b"]"))
        for _ in range(draw.randrange(3)):
            at = draw.randrange(len(data))
            data[at : at + draw.randrange(2)] = bytes(
                draw.choices(b"0123456789-\r\n :;aA\x00\xff", k=draw.randrange(3))
            )
        found = known.read(bytes(data))
        if found is not None:
            taken += 1
            parsed = Read(bytes(data))
            assert (parsed.ends, parsed.method, parsed.url) == (1, b"POST", b"/act")
            assert found == ({**scope_of(request()), "headers": parsed.headers}, parsed.body)
    assert taken > 5_000
