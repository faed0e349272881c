"""The direct port: two replicas' servers on one socket beside a server that offers it. Real sockets, no Ray."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.types import Receive, Scope, Send

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.ray_serve import direct_port, direct_server, http_connections
from rlservo.serve_app.ray_serve.direct_server import DirectConnection, DirectServer
from rlservo.serve_app.ray_serve.http_connections import TimedProtocol
from rlservo.serve_app.ray_serve.ports import free_ports
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import load_policy
from rlservo.serve_app.wire.direct_offer import OFFER, find_offer, make_offer
from rlservo.serve_app.wire.request_stamp import STAMP
from servers import over_uvicorn
from stores import store_of

ACT = "/v1/policies/ur5/act"
OBS = [0.1] * 27
KEY, LINE = new_key("cell-7")
SETTINGS = ServerSettings(
    api_keys=LINE, max_connections_per_address=20, max_body_bytes=4096, body_timeout_s=0.5, max_queue_ms=200
)
SOON_S = 20.0  # a busy machine's


class Replica:
    """A replica's direct server, in a thread with an event loop of its own."""

    def __init__(self, app: Any, port: int, settings: ServerSettings) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        listener, is_shared = direct_port.open_port("127.0.0.1", port)
        self._server = DirectServer(app, listener, settings, is_shared=is_shared)
        self._run(self._start())

    async def _start(self) -> None:
        self._server.start()

    def _run(self, coroutine: Any) -> None:
        asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(SOON_S)

    def drain(self) -> None:
        self._run(self._server.drain())

    def end(self) -> None:
        self.drain()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@pytest.fixture
def app(ur5: Path) -> Any:
    store = store_of(load_policy(ur5))
    return create_app(lambda: store, SETTINGS)


@pytest.fixture
def port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A direct port, held as the launcher does."""
    (port,) = free_ports(1)
    keeper = Path(f"/tmp/direct-{port}.sock")  # a short path
    monkeypatch.setenv(direct_port.VARIABLE, str(keeper))
    monkeypatch.setattr(direct_server, "DRAIN_S", 0.3)
    with direct_port.hold_port("127.0.0.1", port, keeper):
        yield port
    keeper.unlink()


@pytest.fixture
def start(app: Any, port: int) -> Iterator[Callable[[], Replica]]:
    """Starts replicas on the port."""
    with contextlib.ExitStack() as stack:

        def start() -> Replica:
            replica = Replica(app, port, SETTINGS)
            stack.callback(replica.end)
            return replica

        yield start


@pytest.fixture(params=["ahead of Serve", "by Serve"])
def proxied(request: pytest.FixtureRequest, app: Any, port: int) -> Iterator[int]:
    """The same application where requests come by a proxy: it offers the direct port."""
    app.offer = offer_of(port)

    async def by_proxy(scope: Scope, receive: Receive, send: Send) -> None:
        is_ahead = request.param == "ahead of Serve" and scope["type"] != "lifespan"
        match = app.find_direct(scope, scope["path"]) if is_ahead else None
        if match is None:
            await app(scope, receive, send)
        else:
            await app.answer_found(match, scope, receive, send, offer=app.offer)

    with over_uvicorn(by_proxy) as port_of_proxy:
        yield port_of_proxy


def offer_of(port: int) -> tuple[tuple[bytes, bytes], ...]:
    offer = make_offer("127.0.0.1", port)
    assert offer is not None
    return ((OFFER.encode(), offer.encode()),)


def ask(port: int, path: str = ACT, body: bytes | None = None, **headers: str) -> tuple[int, Any]:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as connection:
        return ask_on(connection, path, body, **headers)


def ask_on(
    connection: http.client.HTTPConnection, path: str = ACT, body: bytes | None = None, **headers: str
) -> tuple[int, Any]:
    every = {"content-type": "application/json", "authorization": f"Bearer {KEY}"}
    every |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("POST", path, json.dumps({"obs": OBS}) if body is None else body, every)
    reply = connection.getresponse()
    return reply.status, json.loads(reply.read())


def ask_in_one_piece(connection: socket.socket, body: bytes, *, key: str = KEY) -> tuple[int, Any]:
    """As `PolicyClient` and HAProxy send a request; `http.client` sends its head first."""
    lines = (f"POST {ACT} HTTP/1.1", "host: 127.0.0.1", "content-type: application/json", f"x-api-key: {key}")
    connection.sendall("\r\n".join((*lines, f"content-length: {len(body)}", "", "")).encode() + body)
    with http.client.HTTPResponse(connection) as reply:
        reply.begin()
        return reply.status, json.loads(reply.read())


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("status", "given"),
    [
        (200, {}),
        (401, {"authorization": "Bearer no"}),
        (403, {"host": "robot.example"}),
        (403, {"origin": "http://page.example"}),
        (404, {"path": "/v1/policies/other/act"}),
        (404, {"path": "/-/routes"}),
        (413, {"body": b" " * 5000}),
        (415, {"content_type": "text/plain"}),
        (422, {"body": b'{"obs": [1]}'}),
    ],
)
def test_a_request_is_answered_as_through_the_proxy(
    start: Callable[[], Replica], port: int, proxied: int, status: int, given: dict[str, Any]
) -> None:
    start()
    found, document = ask(port, **given)
    by_proxy = ask(proxied, **given)[1]
    document.pop("infer_ms", None), by_proxy.pop("infer_ms", None)
    assert found == status and document == by_proxy


def test_what_does_not_come_or_is_too_large_ends_the_connection(
    start: Callable[[], Replica], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_connections, "HEAD_S", 0.5)
    monkeypatch.setattr(http_connections, "CHECK_PERIOD_S", 0.1)
    start()
    line = f"POST {ACT} HTTP/1.1\r\nhost: 127.0.0.1\r\n".encode()
    many = b"a: b\r\n" * 10000
    for content, status in (
        (line, 408),
        (
            line + b"content-type: application/json\r\nx-api-key: " + KEY.encode() + b"\r\ncontent-length: 9\r\n\r\n{",
            408,
        ),
        (line + b"connection: upgrade\r\nupgrade: websocket\r\ncontent-length: 2\r\n\r\n{}", 400),
        (line + many, 431),
        (line + many + b"\r\n", 431),
        (line + b"x-much: " + b"y" * 20000 + b"\r\n\r\n", 431),
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
            connection.sendall(content)
            received = b""
            with contextlib.suppress(ConnectionResetError):  # more was sent than was read
                while piece := connection.recv(65536):
                    received += piece
            assert received.startswith(b"HTTP/1.1 %d " % status), received[:200]
    assert ask(port, x_much="y" * 15000)[0] == 200


@pytest.mark.parametrize(
    ("status", "head"),
    [
        (401, "x-api-key: no\r\ncontent-length: 100\r\n"),
        (403, "host: robot.example\r\ncontent-length: 100\r\n"),
        (413, f"x-api-key: {KEY}\r\ncontent-length: 100000\r\n"),
    ],
    ids=["key", "host", "size"],
)
def test_a_refusal_before_the_body_has_come_says_that_the_connection_ends(
    start: Callable[[], Replica], port: int, status: int, head: str
) -> None:
    start()
    host = "" if "host" in head else "host: 127.0.0.1\r\n"
    request = f"POST {ACT} HTTP/1.1\r\n{host}content-type: application/json\r\n{head}\r\n".encode()
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        connection.sendall(request + b"{")
        received = b""
        while piece := connection.recv(65536):
            received += piece
            connection.sendall(b" ")  # who still sends does not lose the reply
        reply_head, _, body = received.partition(b"\r\n\r\n")
        assert reply_head.startswith(b"HTTP/1.1 %d " % status)
        assert b"\r\nconnection: close" in reply_head.lower()
        assert json.loads(body)["error"]
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        for _ in range(2):  # refused as a whole, it goes on
            line = f"POST {ACT} HTTP/1.1\r\nhost: 127.0.0.1\r\nx-api-key: no\r\n".encode()
            connection.sendall(line + b"content-length: 2\r\n\r\n{}")
            refusal = connection.recv(65536)
            assert refusal.startswith(b"HTTP/1.1 401 ") and b"connection: close" not in refusal.lower()


def test_the_connections_of_an_address_are_bounded_and_counted_until_they_end(
    start: Callable[[], Replica], port: int
) -> None:
    start()
    with contextlib.ExitStack() as stack:
        for _ in range(SETTINGS.max_connections_per_address):
            connection = stack.enter_context(closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)))
            assert ask_on(connection)[0] == 200
        status, document = ask(port)
        assert (status, document["code"]) == (429, "over-capacity")
        for _ in range(direct_server.OVER):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=SOON_S))
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            ask(port)
    until(lambda: accepted(port))
    # A stream counts until it ends as well, not until it becomes one.
    for _ in range(2 * SETTINGS.max_connections_per_address):
        with StreamClient(f"http://127.0.0.1:{port}", "ur5", api_key=KEY) as policy:
            policy.act(OBS)
    until(lambda: accepted(port))


@pytest.mark.parametrize(("already_open", "taken"), [(0, 1), (7, 1), (32, 5)])
def test_a_few_connections_are_taken_in_a_turn_where_many_are_open(
    app: Any, port: int, already_open: int, taken: int
) -> None:
    """One by one, the last of 64 that open at once would wait for 64 turns, each as long as what is open."""

    async def run() -> int:
        listener, _ = direct_port.open_port("127.0.0.1", port)
        server = DirectServer(app, listener, SETTINGS)
        server.start()
        with contextlib.ExitStack() as stack:
            for _ in range(10):
                stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=SOON_S))
            server._total = already_open
            server._take_some()
            now_open = server._total
            await server.drain()
        return now_open - already_open

    assert asyncio.run(run()) == taken


def accepted(port: int) -> bool:
    with contextlib.suppress(ConnectionError, http.client.HTTPException):
        return ask(port)[0] == 200
    return False


def test_replicas_that_come_and_go_under_load_lose_nothing(start: Callable[[], Replica], port: int) -> None:
    first = start()
    until(lambda: accepted(port))
    stop = threading.Event()
    answered = {True: 0, False: 0}

    def load(keeps: bool) -> None:
        """Ask again and again, on a kept connection until it is told to close, or on a new one each time."""
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)
        while not stop.is_set():
            assert ask_on(connection)[0] == 200
            answered[keeps] += 1
            if not keeps:
                connection.close()  # else http.client closes it when the reply says so, and connects again
        connection.close()

    with ThreadPoolExecutor(4) as pool:
        loads = [pool.submit(load, keeps) for keeps in (True, False, True, False)]
        try:
            for _ in range(3):  # a rolling update: the next one is there before the one before goes
                second = start()
                before = sum(answered.values())
                until(lambda before=before: sum(answered.values()) > before + 50)
                first.drain()
                first = second
                before = sum(answered.values())
                until(lambda before=before: sum(answered.values()) > before + 50)
        finally:
            stop.set()
        for each in loads:
            each.result(SOON_S)
    assert min(answered.values()) > 50


def test_a_request_leaves_nothing_to_the_garbage_collector(start: Callable[[], Replica], port: int) -> None:
    start()
    body = json.dumps({"obs": OBS}).encode()
    head = (
        f"POST {ACT} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\ncontent-length: {len(body)}\r\n"
    )
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        gc.collect()
        gc.disable()
        try:
            for key, status in ((KEY, 200), ("no", 401)) * 20:
                connection.sendall(f"{head}x-api-key: {key}\r\n\r\n".encode() + body)  # in one piece
                assert connection.recv(65536).startswith(b"HTTP/1.1 %d " % status)
            left = sum(type(each) is http_connections.EarlyEnd for each in gc.get_objects())
        finally:
            gc.enable()
    assert left < 10, "a collection over all of a replica takes milliseconds, in which nobody is answered"


BODIES = [
    *(json.dumps({"obs": [0.1 * number] * 27, "seq": number}).encode() for number in range(3)),
    *(b'{"obs": [1]}', b"no JSON", b"", b'{"obs": NaN}', json.dumps({"obs": [1e300] * 27}).encode(), b" " * 5000),
    *(json.dumps({"obs": values}).encode() for values in ([True] * 27, [0] * 27, ["1"] * 27, [[0.5] * 27] * 2, None)),
    json.dumps({"obs": OBS, "deadline_ms": 0}).encode(),
]


def test_a_head_that_comes_again_is_answered_as_the_first(
    start: Callable[[], Replica], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is not parsed again; whatever the body holds, the reply is that to a connection's first request."""
    start()
    repeated: list[bytes] = []
    repeat = TimedProtocol._repeat

    def counted(self: TimedProtocol, scope: Any, body: bytes) -> bool:
        repeated.append(body)
        return repeat(self, scope, body)

    monkeypatch.setattr(TimedProtocol, "_repeat", counted)
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as connection:
        for body in BODIES * 2:
            found, expected = ask_in_one_piece(connection, body), ask(port, body=body)
            for document in (found[1], expected[1]):
                document.pop("infer_ms", None)
                document.get("details", {}).pop("elapsed_ms", None)
            assert found == expected
        assert ask_in_one_piece(connection, BODIES[0], key="no")[0] == 401
        assert ask_in_one_piece(connection, BODIES[0])[0] == 200
    assert repeated == (BODIES * 2)[2:]


def test_a_key_is_checked_at_every_request(port: int, tmp_path: Path, ur5: Path) -> None:
    store = store_of(load_policy(ur5))
    limited, line = new_key("cell-8", rate=0.001, burst=3)
    keys = tmp_path / "keys"
    keys.write_text(f"{LINE}\n{line}\n")
    settings = ServerSettings(api_keys_file=str(keys))
    replica = Replica(create_app(lambda: store, settings), port, settings)
    try:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as connection:
            replies = [ask_on(connection, authorization=f"Bearer {limited}")[0] for _ in range(5)]
            assert replies == [200, 200, 200, 429, 429]
            assert [ask_on(connection)[0] for _ in range(3)] == [200] * 3
            keys.write_text(f"{line}\n")
            until(lambda: ask_on(connection)[0] == 401)
    finally:
        replica.end()


def test_requests_that_wait_are_answered_on_their_connection(ur5: Path, port: int) -> None:
    """Micro-batches: the reply comes in a later turn than the head that came again."""
    policy = load_policy(ur5, options={"*": PolicyOptions(micro_batch=8)})
    store, settings = store_of(policy), ServerSettings()
    replica = Replica(create_app(lambda: store, settings), port, settings)

    def drive(number: int) -> None:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as connection:
            for step in range(40):
                obs = [0.01 * number + 0.001 * step] * 27
                status, reply = ask_on(connection, body=json.dumps({"obs": obs}).encode())
                assert status == 200 and np.allclose(reply["action"], alone.act(obs), atol=1e-5)

    try:
        with load_policy(ur5) as alone, ThreadPoolExecutor(6) as pool:
            list(pool.map(drive, range(6)))
    finally:
        replica.end()


def test_only_an_idle_connection_is_closed(app: Any, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct_server, "KEEP_ALIVE_S", 2.0)
    monkeypatch.setattr(http_connections, "CHECK_PERIOD_S", 0.1)
    replica = Replica(app, port, SETTINGS)
    try:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as connection:
            for _ in range(8):  # for twice as long
                assert ask_on(connection)[0] == 200
                time.sleep(0.5)
            began = time.monotonic()
            assert connection.sock.recv(1) == b""
            assert 0.5 < time.monotonic() - began < SOON_S
    finally:
        replica.end()


def test_what_waited_until_a_replica_came_is_refused_as_late(start: Callable[[], Replica], port: int) -> None:
    start().drain()  # the port is open, and nobody takes connections
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as waiting:
        waiting.connect()
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=SOON_S)) as asking:
            body = json.dumps({"obs": OBS})
            headers = {"content-type": "application/json", "authorization": f"Bearer {KEY}"}
            asking.request("POST", ACT, body, headers)
            time.sleep(2 * SETTINGS.max_queue_ms / 1e3)  # that the observation grows too old
            start()
            reply = asking.getresponse()
            assert (reply.status, json.loads(reply.read())["code"]) == (503, "late")
            assert ask_on(asking)[0] == 200  # the next one is new
        assert ask_on(waiting)[0] == 200  # it is not the connection's age


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_a_client_finds_the_port_and_goes_back_to_the_proxy_when_it_is_gone(
    start: Callable[[], Replica], port: int, proxied: int, kind: type[PolicyClient] | type[StreamClient], app: Any
) -> None:
    replica = start()
    with (
        kind(f"http://127.0.0.1:{proxied}", "ur5", api_key=KEY, deadline_ms=1e3 * SOON_S) as policy,
        socket.socket() as nobody,  # has a port, which no other process can take, and does not listen
    ):
        nobody.bind(("127.0.0.1", 0))
        expected = policy.act(OBS)
        # From now on: on a busy machine a 503 sends the client to the proxy, which would offer the replica's port
        # again, and on that the launcher listens, too, when the replica is gone.
        app.offer = offer_of(nobody.getsockname()[1])
        for _ in range(5):
            assert np.array_equal(policy.act(OBS), expected)
            assert policy.is_direct
        assert policy.reconnects == 0
        replica.drain()
        for _ in range(5):
            assert np.array_equal(policy.act(OBS), expected)
        app.offer = ()
        assert np.array_equal(policy.act(OBS), expected)
        assert not policy.is_direct


def test_an_offer_holds_on_the_same_machine_alone() -> None:
    offer = make_offer("0.0.0.0", 8001)
    assert offer is not None and find_offer(offer) == ("127.0.0.1", 8001)
    assert find_offer(str(make_offer("::", 8001))) == ("::1", 8001)
    address, _, place = offer.partition(" ")
    elsewhere = ("0" if place[0] != "0" else "1") + place[1:]
    for other in (address, f"{address} {elsewhere}", f"127.0.0.1:0 {place}", f":8001 {place}", f"a:b {place}", ""):
        assert find_offer(other) is None


def test_a_port_that_is_taken_is_refused_with_a_sentence(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        number = other.getsockname()[1]
        held = direct_port.hold_port("127.0.0.1", number, tmp_path / "d")
        with pytest.raises(UsageError, match=rf"direct port {number} on 127\.0\.0\.1 cannot be"), held:
            pass
        with pytest.raises(UsageError, match=f"direct port {number}"):
            direct_port.open_port("127.0.0.1", number)


def test_a_stamp_does_not_say_here_who_asks() -> None:
    """Many connections that say the same would keep a replica awake for all of them."""
    connection = object.__new__(DirectConnection)
    connection.headers = [(STAMP.encode(), b"1764126123456-clock-4711-1")]
    assert connection.client_id() == id(connection)
    assert TimedProtocol.client_id(connection) == b"4711"
