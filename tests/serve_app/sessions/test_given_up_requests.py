"""Abandoned requests of a session: whenever they arrive, they do not affect the next episode.

Triton's clients send neither `seq` nor `timeout` unless told to; they leave only a closed connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_leaky_policy
from rlservo.bundle.bundle import read_contract
from rlservo.client.client_episode import ClientEpisode
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from storages import closing_sessions
from stores import control_of, load_store

OBS = np.random.default_rng(3).uniform(-0.3, 0.3, (8, 3)).astype(np.float32)
OTHER = np.float32([0.3, -0.3, 0.3])  # what a request that was given up has seen


class Server:
    """A server whose event loop can be held, as by other work, while requests and closed connections pile up."""

    def __init__(self, app: Any) -> None:
        self._app = app
        self._loop: asyncio.AbstractEventLoop | None = None
        self.port = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self._loop = asyncio.get_running_loop()
        await closing_sessions(self._app)(scope, receive, send)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        assert self._loop is not None
        is_held, go_on = threading.Event(), threading.Event()
        self._loop.call_soon_threadsafe(lambda: (is_held.set(), go_on.wait(10)))
        assert is_held.wait(10)
        try:
            yield
        finally:
            go_on.set()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_leaky_policy(tmp_path_factory.mktemp("leaky"))


@pytest.fixture
def server(bundle: Path, request: pytest.FixtureRequest) -> Iterator[Server]:
    settings = ServerSettings()
    if getattr(request, "param", "memory") == "redis":
        settings = ServerSettings(session_store=request.getfixturevalue("redis_server").url)
    store = load_store(bundle)
    server = Server(create_app(control_of(store), settings))
    with over_uvicorn(server) as server.port:
        yield server


@pytest.fixture
def episode(bundle: Path) -> Callable[[Any], list[float]]:
    """Return the action of each next observation of one episode, computed in process."""
    policy = Policy.load(bundle)
    return lambda obs: policy.act(obs).tolist()


def oip_body(obs: Any, *, start: bool = False, **more: Any) -> tuple[str, bytes]:
    tensor = {"name": "obs", "shape": [1, 3], "datatype": "FP32", "data": obs.tolist()}
    parameters = {"sequence_id": 7, "sequence_start": start, **more}
    return "/v2/models/leaky/infer", json.dumps({"inputs": [tensor], "parameters": parameters}).encode()


def json_body(obs: Any, *, start: bool = False, **more: Any) -> tuple[str, bytes]:
    body = {"obs": obs.tolist(), "session_id": "cell-7", "reset": start, **more}
    return "/v1/policies/leaky/act", json.dumps(body).encode()


BODIES = pytest.mark.parametrize("body", [oip_body, json_body])
STORES = pytest.mark.parametrize("server", ["memory", "redis"], indirect=True)


def raw(path: str, body: bytes) -> bytes:
    head = f"POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\ncontent-length: {len(body)}"
    return head.encode() + b"\r\n\r\n" + body


class Client:
    """A client with one connection, which stays open."""

    def __init__(self, port: int) -> None:
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)

    def send(self, path: str, body: bytes) -> None:
        self.connection.request("POST", path, body, {"content-type": "application/json"})

    def receive(self) -> tuple[int, Any]:
        reply = self.connection.getresponse()
        document = json.loads(reply.read())
        if "outputs" in document:
            document["action"] = document["outputs"][0]["data"]
        document["action"] = np.float32(document.get("action", [])).tolist()
        return reply.status, document

    def ask(self, path: str, body: bytes) -> tuple[int, Any]:
        self.send(path, body)
        return self.receive()


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    client = Client(server.port)
    with contextlib.closing(client.connection):
        yield client


def give_up(port: int, path: str, body: bytes) -> None:
    """Send a request, and close the connection without waiting for its answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(raw(path, body))


def knock(port: int) -> None:
    """Wait until a server has read what came before: it accepts connections in order."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(raw("/v1/policies/none/act", b"{}"))
        assert connection.recv(1)


@BODIES
@STORES
@pytest.mark.parametrize("more", [{}, {"seq": 9}])
def test_a_step_that_was_given_up_does_not_move_the_next_episode(
    server: Server, client: Client, episode: Callable[[Any], list[float]], body: Any, more: Any
) -> None:
    assert client.ask(*body(OBS[0], start=True))[0] == 200
    with server.held():  # the new connection is accepted after the open one has been read
        give_up(server.port, *body(OTHER, **more))
        client.send(*body(OBS[0], start=True))
    status, reply = client.receive()
    assert status == 200 and reply["action"] == episode(OBS[0])
    for obs in OBS[1:]:
        assert client.ask(*body(obs))[1]["action"] == episode(obs)


@BODIES
def test_a_step_that_came_in_part_before_its_session_began_again_is_refused(
    server: Server, client: Client, episode: Callable[[Any], list[float]], body: Any
) -> None:
    client.ask(*body(OBS[0], start=True))
    whole = raw(*body(OTHER))
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as late:
        late.sendall(whole[:-5])
        knock(server.port)
        assert client.ask(*body(OBS[0], start=True))[1]["action"] == episode(OBS[0])
        late.sendall(whole[-5:])
        answer = late.recv(65536).decode()
    assert " 409 " in answer and "belongs to an earlier episode" in answer
    for obs in OBS[1:]:
        assert client.ask(*body(obs))[1]["action"] == episode(obs)


@BODIES
@STORES
def test_a_start_that_was_given_up_does_not_begin_the_episode_after_it_again(
    server: Server, client: Client, episode: Callable[[Any], list[float]], body: Any
) -> None:
    client.ask(*body(OTHER, start=True))
    with server.held():
        give_up(server.port, *body(OTHER, start=True))
        client.send(*body(OBS[0], start=True))
    assert client.receive()[1]["action"] == episode(OBS[0])
    for obs in OBS[1:]:
        assert client.ask(*body(obs))[1]["action"] == episode(obs)


@pytest.mark.parametrize("reply", [{"session_step": 1}, {}], ids=["a session", "a label"])
def test_our_client_begins_under_another_id_after_a_start_without_an_answer(
    bundle: Path, ur5: Path, reply: dict[str, Any]
) -> None:
    contract = read_contract(bundle if reply else ur5)
    state = ClientEpisode(server_state=True, is_stream=False)
    given_up, begun = (state.request_fields(contract, ()) for _ in range(2))
    assert given_up["reset"] and begun["reset"] and given_up["session_id"] != begun["session_id"]
    state.advance(reply, [0.0, 0.0], contract)
    assert state.request_fields(contract, ()) == {"reset": False, "session_id": begun["session_id"]}


@BODIES
def test_a_start_that_came_in_part_before_another_one_is_refused(
    server: Server, client: Client, episode: Callable[[Any], list[float]], body: Any
) -> None:
    whole = raw(*body(OTHER, start=True))
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as late:
        late.sendall(whole[:-5])
        knock(server.port)
        assert client.ask(*body(OBS[0], start=True))[1]["action"] == episode(OBS[0])
        late.sendall(whole[-5:])
        assert " 503 " in late.recv(65536).decode()
    for obs in OBS[1:]:
        assert client.ask(*body(obs))[1]["action"] == episode(obs)
