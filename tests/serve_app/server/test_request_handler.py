"""A replica with more requests than it admits: some are refused at once, the others are unaffected."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.errors import OverloadedError
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.load_shedding import LoadShedding
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from stores import control_of, load_store
from streams import Stream
from waiting import wait_for

OBS = np.random.default_rng(8).standard_normal((4096, 27)).astype(np.float32)
Serve = Callable[..., AbstractContextManager[int]]


@pytest.fixture(scope="module")
def serve(policies: Path) -> Serve:
    store = load_store(policies)
    return lambda **settings: over_uvicorn(create_app(control_of(store), ServerSettings(**settings)))


def request(body: bytes, *, path: str = "/v1/policies/ur5/act") -> bytes:
    head = (
        f"POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\n"
        f"content-type: application/json\r\ncontent-length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body


def ask(obs: Any) -> bytes:
    return request(json.dumps({"obs": obs.tolist()}).encode())


def answer(connection: socket.socket) -> tuple[int, dict[str, str], Any]:
    with connection.makefile("rb") as reply:
        status = int(reply.readline().split()[1])
        headers = {}
        while (line := reply.readline().strip()) != b"":
            name, _, value = line.decode().partition(":")
            headers[name.lower()] = value.strip()
        return status, headers, json.loads(reply.read(int(headers["content-length"])))


@contextlib.contextmanager
def connections(port: int, number: int) -> Iterator[list[socket.socket]]:
    with ExitStack() as stack:
        yield [stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20)) for _ in range(number)]


def test_what_exceeds_the_queue_is_refused_at_once_and_the_rest_gets_its_own_action(serve: Serve, ur5: Path) -> None:
    with Policy.load(ur5) as policy, serve(max_ongoing_requests=16) as port, connections(port, 61) as clients:
        for _ in range(20):  # on a busy computer the loop may be done before the others have arrived
            clients[0].sendall(ask(OBS))  # 4,096 observations keep the loop busy meanwhile
            time.sleep(0.02)
            for index, client in enumerate(clients[1:], start=1):
                client.sendall(ask(OBS[index]))
            refused = 0
            assert answer(clients[0])[0] == 200
            for index, client in enumerate(clients[1:], start=1):
                status, headers, document = answer(client)
                if status == 200:
                    np.testing.assert_allclose(document["action"], policy.act(OBS[index]), rtol=1e-5, atol=1e-6)
                else:
                    assert (status, document["code"], headers["retry-after"]) == (503, "over-capacity", "1")
                    refused += 1
            assert refused <= 61 - 16  # all may have come at once
            if refused:
                break
        assert refused
        for index, client in enumerate(clients[1:], start=1):  # once it is over, all clients are served again
            client.sendall(ask(OBS[index]))
            assert answer(client)[0] == 200


def test_more_half_sent_requests_than_allowed_are_refused_and_whole_ones_still_served(serve: Serve) -> None:
    with serve(max_incoming=8, body_timeout_s=5.0) as port, connections(port, 10) as clients:
        whole = ask(OBS[0])
        for client in clients[:8]:
            client.sendall(whole[:-5])
        time.sleep(0.2)
        clients[8].sendall(whole[:-5])
        status, headers, document = answer(clients[8])
        assert (status, document["code"], headers["retry-after"]) == (503, "over-capacity", "1")
        clients[9].sendall(whole)
        assert answer(clients[9])[0] == 200
        for client in clients[:8]:
            client.sendall(whole[-5:])
            assert answer(client)[0] == 200


def test_health_is_told_when_there_is_too_much_to_do(serve: Serve) -> None:
    with serve(max_ongoing_requests=1) as port, connections(port, 2) as (busy, health):
        busy.sendall(ask(OBS))
        health.sendall(b"GET /v2/health/ready HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n")
        assert answer(health)[0] == 200
        assert answer(busy)[0] == 200


def test_a_stream_too_many_is_refused_and_one_that_closes_makes_room(serve: Serve) -> None:
    with serve(max_streams=1, default_policy="ur5") as port:

        def refusal() -> str:
            with Stream(port) as stream:
                return str(stream.metadata.get("code", ""))

        with Stream(port) as first:
            assert refusal() == "over-capacity"
            assert first.ask(obs=[0.0] * 27)["policy"] == "ur5"
        wait_for(lambda: not refusal())


def test_a_silent_stream_is_closed_and_a_busy_one_is_not(serve: Serve) -> None:
    with serve(stream_idle_s=0.5, default_policy="ur5") as port, Stream(port) as stream:
        for _ in range(8):
            time.sleep(0.1)
            assert "actions" in stream.ask(obs=[0.0] * 27)
        started = time.perf_counter()
        assert stream.close_code() == 1001
        assert 0.3 < time.perf_counter() - started < 5


def test_a_wait_in_the_queue_counts_from_the_beginning_of_the_burst() -> None:
    async def burst() -> None:
        admission = LoadShedding(
            ServerSettings(max_ongoing_requests=10, max_queue_ms=50, max_incoming=1, max_streams=1)
        )
        first = admission.enter()
        time.sleep(0.01)
        assert admission.enter() == first
        time.sleep(0.06)
        with pytest.raises(OverloadedError, match="wait longer than 50 ms"):
            admission.enter()
        await asyncio.sleep(0.01)
        assert admission.enter() > first and admission.longest == 3

    asyncio.run(burst())
