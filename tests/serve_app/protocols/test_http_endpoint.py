"""A body and its time: what arrived in time is read, however late the process gets to it; what did not is refused."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from stores import load_store

TIME_S = 0.3
HEAD = (
    b"POST /v1/policies/ur5/act HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    b"content-type: application/json\r\ncontent-length: %d\r\n\r\n"
)
BODY = json.dumps({"obs": [0.1] * 27}).encode()


class Server:
    """The policy server on a loop of its own, which can be made to stand still."""

    def __init__(self, store: PolicyStore, loop: str) -> None:
        self._app = create_app(lambda: store, ServerSettings(body_timeout_s=TIME_S))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._began = threading.Event()
        config = uvicorn.Config(
            self._call,
            log_level="critical",
            lifespan="off",
            interface="asgi3",
            loop=loop,  # type: ignore[arg-type]
        )
        self.server = uvicorn.Server(config)

    async def _call(self, scope: Any, receive: Any, send: Any) -> None:
        self._loop = asyncio.get_running_loop()
        self._began.set()
        await self._app(scope, receive, send)

    def stand_still(self, seconds: float) -> None:
        """Keep the loop from everything, once a request has begun."""
        assert self._began.wait(10) and self._loop is not None
        self._loop.call_soon_threadsafe(time.sleep, seconds)


@pytest.fixture(scope="module")
def store(ur5: Path) -> PolicyStore:
    return load_store(ur5)


@pytest.fixture(params=["asyncio", "uvloop"])
def connected(request: pytest.FixtureRequest, store: PolicyStore) -> Iterator[tuple[Server, socket.socket]]:
    if request.param == "uvloop":
        pytest.importorskip("uvloop")
    server = Server(store, request.param)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            with socket.create_connection(listener.getsockname(), timeout=20) as client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                yield server, client
        finally:
            server.server.should_exit = True
            thread.join()


def status_of(client: socket.socket) -> int:
    return int(client.recv(65536).split(b" ")[1])


Connected = tuple[Server, socket.socket]


@pytest.mark.parametrize("pieces", [1, 40])
def test_a_body_that_came_while_the_process_stood_still_is_not_late(connected: Connected, pieces: int) -> None:
    server, client = connected
    body = BODY + b" " * (200_000 if pieces > 1 else 0)  # more than is read at once
    client.sendall(HEAD % len(body) + body[:10])
    server.stand_still(3 * TIME_S)
    time.sleep(TIME_S / 3)
    size = -(-(len(body) - 10) // pieces)
    for start in range(10, len(body), size):
        client.sendall(body[start : start + size])
    assert status_of(client) == 200


def drip(client: socket.socket, every_s: float, for_s: float) -> None:
    with contextlib.suppress(OSError):
        for _ in range(int(for_s / every_s)):
            client.sendall(b" ")
            time.sleep(every_s)


@pytest.mark.parametrize("every_s", [0.001, 0.08])
def test_a_body_that_comes_in_drops_is_late_all_the_same(connected: Connected, every_s: float) -> None:
    _, client = connected
    client.sendall(HEAD % 1_000_000)
    dripping = threading.Thread(target=drip, args=(client, every_s, 40 * TIME_S))
    began = time.monotonic()
    dripping.start()
    assert status_of(client) == 408
    taken = time.monotonic() - began
    client.shutdown(socket.SHUT_RDWR)
    dripping.join()
    assert TIME_S * 0.9 <= taken < 20 * TIME_S  # twice the time, and what a busy computer adds


def test_a_body_that_never_comes_is_late(connected: Connected) -> None:
    _, client = connected
    client.sendall(HEAD % 10)
    assert status_of(client) == 408
