"""A request's way through our files, in a process that is put together as a replica is."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import uvicorn
from onnxruntime import InferenceSession

from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.ray_serve import ingress as ingress_module
from rlservo.serve_app.ray_serve.busy_polling import AWAKE_S
from rlservo.serve_app.ray_serve.http_connections import RepeatedHead, TimedProtocol
from rlservo.serve_app.ray_serve.ingress import Ingress, ServeBypass
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.request_stamp import STAMP, clock_id
from stores import store_of

HOME = Path(ingress_module.__file__).parents[2]  # as this Python imports them, which may be by a link
OURS = (str(HOME / "serve_app"), str(HOME / "export"), str(HOME / "deploy"))
TEN = [
    "serve_app/ray_serve/http_connections.py",
    "serve_app/ray_serve/eager_tasks.py",
    "serve_app/ray_serve/ingress.py",
    "serve_app/protocols/http_endpoint.py",
    "serve_app/server/access_checks.py",
    "serve_app/server/request_path.py",
    "serve_app/protocols/json_codec.py",
    "serve_app/versions/policy_store.py",
    "serve_app/runtime/policy.py",
    "serve_app/runtime/leaf_observations.py",
]
"""Files of ours between the socket and the network, which DESIGN.md lists."""
OBS = [0.1] * 27
KEY, LINE = new_key("robot")
CLOCK = clock_id()

Ask = Callable[[], Awaitable[None]]


class PassedFiles:
    """A profiler that notes our files in which something is called, until onnxruntime's `run` is."""

    def __init__(self) -> None:
        self.files: dict[str, None] = {}
        self.reached_network = False

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        if event != "call" or self.reached_network:
            return
        if frame.f_code is InferenceSession.run.__code__:
            self.reached_network = True
        elif frame.f_code.co_filename.startswith(OURS):
            self.files.setdefault(str(Path(frame.f_code.co_filename).relative_to(HOME)))


@pytest.fixture
def bypass(monkeypatch: pytest.MonkeyPatch) -> Iterator[ServeBypass]:
    """The process's bypass, for one test, and what connections of replicas answer at once by it."""
    monkeypatch.setattr(ingress_module, "bypass", ServeBypass())
    monkeypatch.setattr(TimedProtocol, "find_app", staticmethod(ingress_module.find_at_once))
    yield ingress_module.bypass


async def pass_through(
    ur5: Path, bypass: ServeBypass, listener: socket.socket, ask: Ask, lines: str
) -> list[list[str]]:
    """Return our files that each of a connection's later requests passes, in the order of the first call in each.

    `lines` are the server's keys.
    """
    store = store_of(Policy.load(ur5))
    app = create_app(lambda: store, ServerSettings(api_keys=lines))
    bypass.install(app)
    config = uvicorn.Config(Ingress(app), http=TimedProtocol, log_level="critical", lifespan="off", access_log=False)
    server = uvicorn.Server(config)
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    await ask()  # by way of Serve: it tells the prefix
    each = [PassedFiles() for _ in range(4)]
    for passed in each:
        await asyncio.sleep(10 * AWAKE_S)  # in which the loop looks for a request
        sys.setprofile(passed)  # of this thread, and so not of a client in another
        try:
            await ask()
        finally:
            sys.setprofile(None)
    server.should_exit = True
    await serving
    assert all(passed.reached_network for passed in each)
    return [list(passed.files) for passed in each]


@pytest.mark.parametrize("key", [False, True], ids=["open", "keyed"])
def test_a_json_request_passes_ten_files_between_socket_and_network(ur5: Path, bypass: ServeBypass, key: bool) -> None:
    """Of nothing but an observation, as HAProxy passes it on."""
    body = json.dumps({"obs": OBS}).encode()

    def post() -> bytes:
        """In one piece: one that comes in two is answered later than in the turn that reads its head."""
        lines = [
            "POST /v1/policies/ur5/act HTTP/1.1",
            "host: 127.0.0.1",
            "content-type: application/json",
            f"content-length: {len(body)}",
            f"{STAMP}: {time.time() * 1e3:.0f}-{CLOCK}",
            "x-forwarded-for: 127.0.0.1",
            *([f"authorization: Bearer {KEY}"] if key else []),
        ]
        connection.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        return connection.recv(65536)

    async def ask() -> None:
        assert (await asyncio.to_thread(post)).startswith(b"HTTP/1.1 200")

    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname(), timeout=60) as connection,
    ):
        requests = asyncio.run(pass_through(ur5, bypass, listener, ask, LINE if key else ""))
    for files in requests:
        assert sorted(files) == sorted(TEN)
        assert files[0] == TEN[0]
        assert files[-1] == TEN[-1]  # what is nearest to the network


def test_so_does_one_of_our_client(ur5: Path, bypass: ServeBypass, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has a number, a deadline, its episode's label and a key, and from the third on a head that is known."""
    repeated = 0
    read = RepeatedHead.read

    def counted(self: RepeatedHead, data: bytes) -> Any:
        nonlocal repeated
        found = read(self, data)
        repeated += found is not None
        return found

    monkeypatch.setattr(RepeatedHead, "read", counted)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        PolicyClient(f"http://127.0.0.1:{listener.getsockname()[1]}", "ur5", api_key=KEY) as client,
    ):

        async def ask() -> None:
            await asyncio.to_thread(client.act, np.array(OBS, np.float32))

        requests = asyncio.run(pass_through(ur5, bypass, listener, ask, LINE))
    for files in requests:
        assert sorted(files) == sorted(TEN)
    assert repeated >= 2
