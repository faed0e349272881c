"""Connections on which heads come again: whatever bytes come, the replies are those of one that parses every head."""

from __future__ import annotations

import asyncio
import functools
import json
import random
from collections.abc import Callable
from typing import Any

import pytest
import uvicorn
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware
from uvicorn.server import ServerState

from rlservo.serve_app.protocols.http_endpoint import REPLY
from rlservo.serve_app.ray_serve import ingress
from rlservo.serve_app.ray_serve.busy_polling import BusyPolling
from rlservo.serve_app.ray_serve.http_connections import RepeatedHead, TimedProtocol
from rlservo.serve_app.wire.request_stamp import STAMP, clock_id

IDLE_S = 60
OUTSIDE = b"by another way"


class Transport(asyncio.Transport):
    """A connection's bytes, in memory."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 50000)})
        self.written = b""
        self.is_closed = False

    def write(self, data: Any) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return self.is_closed

    def close(self) -> None:
        self.is_closed = True

    def write_eof(self) -> None:
        self.written += b"<end>"

    def pause_reading(self) -> None: ...
    def resume_reading(self) -> None: ...


async def tell(scope: Any, receive: Any, send: Any) -> None:
    """Reply with the request; wait first or leave the body where its path says so."""
    body = b""
    if scope["path"] == "/wait":
        await asyncio.sleep(0)
    if scope["path"] != "/unread":
        body = (await receive())["body"]
    headers = [[name.decode("latin-1"), value.decode("latin-1")] for name, value in scope["headers"]]
    keys = sorted(key for key in scope if not key.startswith("rlservo."))
    asked = [scope["path"], scope["query_string"].decode(), headers, scope["client"], scope["scheme"], keys]
    told = json.dumps([*asked, body.decode("latin-1")]).encode()
    lines = [(b"content-length", b"%d" % len(told))]
    if REPLY in scope and scope[REPLY](200, lines, told):
        return
    await send({"type": "http.response.start", "status": 200, "headers": lines})
    await send({"type": "http.response.body", "body": told})


async def outside(scope: Any, receive: Any, send: Any) -> None:
    """What answers requests that nothing answers at once; at /early before the body has come."""
    while scope["path"] != "/early" and (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 404, "headers": [(b"content-length", b"%d" % len(OUTSIDE))]})
    await send({"type": "http.response.body", "body": OUTSIDE})


async def answer(scope: Any, receive: Any, send: Any) -> None:
    """Tell what is answered at once from the rest."""
    await (tell if REPLY in scope else outside)(scope, receive, send)


def request(body: bytes, path: str = "/act", *lines: str, method: str = "POST") -> bytes:
    head = (f"{method} {path} HTTP/1.1", "host: robot", *lines, f"content-length: {len(body)}", "", "")
    return "\r\n".join(head).encode() + body


def replies(
    pieces: list[bytes], turns: list[int], *, app: Any = answer, then: Callable[[TimedProtocol], None] | None = None
) -> bytes:
    """What a connection writes when these pieces are read, each with so many turns of the event loop after it."""

    async def run() -> bytes:
        config = uvicorn.Config(app, lifespan="off", log_level="critical", timeout_keep_alive=IDLE_S)
        config.load()
        transport = Transport()
        protocol = TimedProtocol(config, ServerState(), {}, asyncio.get_running_loop())
        protocol.connection_made(transport)
        for piece, count in zip(pieces, turns, strict=True):
            if transport.is_closed:
                break
            protocol.data_received(piece)
            for _ in range(count):
                await asyncio.sleep(0)
        for _ in range(50):
            await asyncio.sleep(0)
        if then is not None:
            then(protocol)
        written = transport.written + (b"<closed>" if transport.is_closed else b"")
        protocol.connection_lost(None)
        return written

    return asyncio.run(run())


@pytest.fixture(autouse=True)
def repeated(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The bodies that were answered without parsing their heads."""
    found: list[bytes] = []
    repeat = TimedProtocol._repeat

    def counted(self: TimedProtocol, scope: Any, body: bytes) -> bool:
        found.append(body)
        return repeat(self, scope, body)

    monkeypatch.setattr(TimedProtocol, "_repeat", counted)

    def find(self: TimedProtocol, scope: Any) -> Any:
        app: Any = self.app
        return None if scope["path"] in ("/other", "/early") else app.app  # without what looks for a proxy's client

    monkeypatch.setattr(TimedProtocol, "find_app", find)
    return found


def parsed(monkeypatch: pytest.MonkeyPatch, pieces: list[bytes], turns: list[int]) -> bytes:
    """What is written where every head is parsed."""
    with monkeypatch.context() as patch:
        patch.setattr(RepeatedHead, "learn", lambda *_: None)
        return replies(pieces, turns)


def test_the_third_request_is_not_parsed_again(repeated: list[bytes]) -> None:
    written = replies([request(b"%d" % number) for number in range(5)], [1] * 5)
    assert written.count(b"200 OK") == 5 and repeated == [b"2", b"3", b"4"]


def test_the_client_that_a_proxy_names_is_that_of_every_request(
    repeated: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def forwarded(body: bytes, client: str, *lines: str) -> bytes:
        return request(body, "/act", f"x-forwarded-for: {client}", *lines)

    first, other, https = "192.0.2.7", "192.0.2.8", "x-forwarded-proto: https"
    pieces = [*(forwarded(b"%d" % number, first) for number in range(4)), forwarded(b"4", other)]
    pieces += [*(forwarded(b"%d" % number, other, https) for number in range(5, 9)), forwarded(b"9", first)]
    turns = [1] * len(pieces)
    written = replies(pieces, turns)
    assert repeated == [b"2", b"3", b"6", b"7", b"8"]
    assert [written.count(f'["{client}", 0]'.encode()) for client in (first, other)] == [5, 5]
    assert written.count(b'["192.0.2.8", 0], "https"') == 4
    assert written == parsed(monkeypatch, pieces, turns)


def test_a_head_that_comes_again_is_not_searched_for_a_client_again(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[str] = []
    call = ProxyHeadersMiddleware.__call__

    async def counted(self: ProxyHeadersMiddleware, scope: Any, receive: Any, send: Any) -> None:
        searched.append(scope["path"])
        await call(self, scope, receive, send)

    monkeypatch.setattr(ProxyHeadersMiddleware, "__call__", counted)
    written = replies([request(b"%d" % number) for number in range(5)], [1] * 5)
    assert written.count(b"200 OK") == 5 and len(searched) == 2


def test_every_reply_is_one_that_the_loop_may_stay_awake_after(monkeypatch: pytest.MonkeyPatch) -> None:
    noted: list[Any] = []
    monkeypatch.setattr(BusyPolling, "note_reply", lambda _, connection: noted.append(connection.client_id()))
    pieces = [request(b"%d" % number) for number in range(4)]
    assert replies(pieces, [1] * 4).count(b"200 OK") == len(noted) == 4 and len(set(noted)) == 1
    noted.clear()
    stamps = [f"{STAMP}: {1764126123456 + at}-{clock_id()}-{port}-{at}" for at, port in enumerate([4711] * 4 + [4712])]
    pieces = [request(b"1", "/act", stamp) for stamp in stamps]
    assert replies(pieces, [1] * 5).count(b"200 OK") == 5  # of a proxy, whose client the stamp tells
    assert noted == [b"4711"] * 4 + [b"4712"]


def test_requests_sent_ahead_are_all_answered(repeated: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    pieces = [request(b"1"), request(b"2"), request(b"3"), request(b"4") * 4, request(b"5"), request(b"6")]
    written = replies(pieces, [3] * 6)
    assert written.count(b"200 OK") == 6 and written.count(OUTSIDE) == 3 and repeated == [b"3", b"6"]
    assert written == parsed(monkeypatch, pieces, [3] * 6)


@pytest.mark.parametrize(
    "begun", ["POST /other HTTP/1.1\r\nx-pad: ", "POST /other HTTP/1.1\r\ncontent-length: 60\r\n\r\n"]
)
def test_a_request_inside_another_is_no_request(
    begun: str, repeated: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy takes these bytes for one request's: what they look like must not be answered as another's."""
    pieces = [request(b"1"), request(b"2"), request(b"3") + begun.encode(), request(b"inside")]
    written = replies(pieces, [3] * 4)
    assert repeated == [] and b"inside" not in written
    assert written == parsed(monkeypatch, pieces, [3] * 4)


def test_nor_is_one_inside_a_body_that_was_not_waited_for(
    repeated: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = [request(b"1"), request(b"2"), request(b"x" * 200, "/early")[:-150], request(b"inside"), request(b"4")]
    written = replies(pieces, [3] * 5)
    assert repeated == [] and b"inside" not in written and OUTSIDE in written
    assert written == parsed(monkeypatch, pieces, [3] * 5)


def test_a_reply_that_ends_the_connection_ends_it(repeated: list[bytes]) -> None:
    pieces = [request(b"1"), request(b"2"), request(b"3"), request(b"4", "/act", "connection: close"), request(b"5")]
    written = replies(pieces, [1] * 5)
    assert repeated == [b"3"] and written.endswith(b"<closed>") and written.count(b"200 OK") == 4
    assert b"connection: close" in written


def test_an_idle_connection_ends_without_a_word_when_its_time_is_over(repeated: list[bytes]) -> None:
    def wait(protocol: TimedProtocol) -> None:
        assert protocol._idle_since is not None
        protocol._check_phase()
        assert not protocol.transport.is_closing()
        protocol._idle_since -= IDLE_S + 1
        protocol._check_phase()

    written = replies([request(b"1")] * 6, [1] * 6, then=wait)
    assert len(repeated) == 4 and written.count(b"HTTP/1.1") == 6 and written.endswith(b"<closed>")


def test_a_connection_has_one_timer_and_a_lost_one_none(repeated: list[bytes]) -> None:
    timers: list[Any] = []
    replies([request(b"1")] * 6, [1] * 6, then=lambda protocol: timers.append(protocol._timer))
    assert len(repeated) == 4 and timers[0].cancelled()


def test_one_object_serves_the_requests_that_come_again(repeated: list[bytes]) -> None:
    cycles: list[Any] = []
    repeat = TimedProtocol._repeat

    def kept(self: TimedProtocol, scope: Any, body: bytes) -> bool:
        done = repeat(self, scope, body)
        cycles.append(self.cycle)
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TimedProtocol, "_repeat", kept)
        pieces = [request(b"%d" % number) for number in range(4)]
        pieces += [request(b"4", "/wait"), request(b"5", "/wait"), request(b"6", "/wait"), request(b"7", "/wait")]
        written = replies(pieces, [1] * 4 + [5] * 4)
    assert written.count(b"200 OK") == 8
    assert cycles[0] is cycles[1]  # answered at once
    assert len({id(cycle) for cycle in cycles[2:]}) == len(cycles) - 2  # the others had to wait


def test_an_answer_that_goes_on_after_its_reply_keeps_its_object(repeated: list[bytes]) -> None:
    async def act(scope: Any, receive: Any, send: Any) -> None:
        body = (await receive())["body"]
        if body == b"slow":
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert scope[REPLY](200, [(b"content-length", b"4")], body)
        if body == b"long":
            await asyncio.sleep(0)

    pieces = [request(body) for body in (b"fast", b"fast", b"fast", b"fast", b"long", b"slow", b"fast")]
    written = replies(pieces, [1, 1, 1, 1, 0, 5, 1], app=act)
    assert [part[-4:] for part in written.split(b"HTTP/1.1 200 OK")[1:]] == [piece[-4:] for piece in pieces]
    assert len(repeated) == 5 and b"500" not in written


def test_a_reply_that_is_held_comes_before_the_error_that_ends_its_connection(repeated: list[bytes]) -> None:
    async def run() -> list[bytes]:
        config = uvicorn.Config(answer, lifespan="off", log_level="critical")
        config.load()
        both = []
        for _ in range(2):
            transport = Transport()
            protocol = TimedProtocol(config, ServerState(), {}, asyncio.get_running_loop())
            protocol.connection_made(transport)
            both.append((protocol, transport))
        for last in (b"", b"no HTTP at all\r\n\r\n"):  # in the first turn both are answered: the second holds replies
            for number, (protocol, _) in enumerate(both):
                protocol.data_received(request(b"1") + last * number)
            await asyncio.sleep(0)
        await asyncio.sleep(0)
        for protocol, _ in both:
            protocol.connection_lost(None)
        return [transport.written for _, transport in both]

    first, second = asyncio.run(run())
    assert first.count(b"200 OK") == second.count(b"200 OK") == 2
    assert second.index(b"400 Bad Request") > second.rindex(b"200 OK")


def test_it_is_not_idle_while_a_request_is_answered(repeated: list[bytes]) -> None:
    def ask(protocol: TimedProtocol) -> None:
        assert protocol._idle_since is not None
        protocol.data_received(request(b"1", "/wait"))
        assert protocol._idle_since is None
        protocol._check_phase()
        assert not protocol.transport.is_closing()

    replies([request(b"1", "/wait")] * 3, [5] * 3, then=ask)
    assert len(repeated) == 2


@pytest.mark.parametrize("cut", [0, 3])
def test_a_request_that_is_turned_away_is_counted_once(cut: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where its body comes later than its head."""
    turned: list[str] = []

    class Full:
        def find_ahead(self, scope: Any) -> Any:
            return scope["path"]

        def admit_ahead(self) -> bool:
            turned.append("away")
            return False

        async def answer_ahead(self, match: Any, scope: Any, receive: Any, send: Any) -> None:
            raise AssertionError

    class Bypass(ingress.ServeBypass):
        def find(self, scope: Any) -> Any:
            return functools.partial(ingress._answer, Full(), scope["path"])

    monkeypatch.setattr(ingress, "bypass", Bypass())
    ingress.bypass.answers = True
    monkeypatch.setattr(TimedProtocol, "find_app", lambda _, scope: ingress.find_at_once(scope))
    content = request(b"body")
    pieces = [content[: len(content) - cut], content[len(content) - cut :]]
    written = replies(pieces, [3, 3], app=ingress.Ingress(outside))
    assert written.count(b" 503 ") == 1 and turned == ["away"]


def test_a_reply_that_is_held_is_written_before_the_server_stops() -> None:
    """Under load replies wait for the end of the turn; the requests have been answered, sessions have moved."""

    async def run() -> list[int]:
        config = uvicorn.Config(answer, lifespan="off", log_level="critical")
        config.load()
        connections = []
        for _ in range(3):
            connections.append((TimedProtocol(config, ServerState(), {}, asyncio.get_running_loop()), Transport()))
            connections[-1][0].connection_made(connections[-1][1])
        for _ in range(2):  # the second turn holds: the one before had several
            await asyncio.sleep(0)
            for protocol, _ in connections:
                protocol.data_received(request(b"1"))
        for protocol, _ in connections:
            protocol.shutdown()
            protocol.connection_lost(None)
        return [transport.written.count(b"200 OK") for _, transport in connections]

    assert asyncio.run(run()) == [2, 2, 2]


@pytest.mark.parametrize("seed", range(8))
def test_replies_are_the_same_however_bytes_come(
    seed: int, repeated: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = random.Random(seed)
    usual = [lambda: request(draw.randbytes(draw.randrange(30)))] * 40
    unusual: list[Callable[[], bytes]] = [
        lambda: request(b"a", "/wait"),
        lambda: request(b"b", "/unread"),
        lambda: request(b"c", "/other"),
        lambda: request(b"early", "/early"),
        lambda: request(b"d", "/act?q=1", "x-more: yes"),
        lambda: request(request(b"inside"), "/other"),
        lambda: request(b"", "/act", method="GET"),
        lambda: (
            request(b"e", "/act", "transfer-encoding: chunked").replace(b"content-length: 1\r\n", b"")[:-1]
            + b"3\r\nabc\r\n0\r\n\r\n"
        ),
        lambda: b"\r\n",
        lambda: request(b"f", "/act", "connection: close") if draw.random() < 0.1 else b"",
        lambda: request(b"g").replace(b"1\r\n\r\n", b"99\r\n\r\n") if draw.random() < 0.1 else b"",
        lambda: b"\x00" if draw.random() < 0.1 else b"",
    ]
    for _ in range(150):
        pieces: list[bytes] = []
        for _ in range(draw.randrange(4, 20)):
            piece = b"".join(draw.choice(usual + unusual)() for _ in range(draw.choice((1,) * 9 + (2, 3))))
            at = draw.randrange(len(piece) + 1) if draw.random() < 0.2 else len(piece)
            pieces += [part for part in (piece[:at], piece[at:]) if part]
        turns = draw.choices((0, 1, 4), k=len(pieces))
        assert replies(pieces, turns) == parsed(monkeypatch, pieces, turns), (pieces, turns)
    assert len(repeated) > 100
