"""A request's way through our files, in a process that is put together as a replica is."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import uvicorn
from onnxruntime import InferenceSession

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.ray_serve import ingress as ingress_module
from rlservo.serve_app.ray_serve.http_connections import TimedProtocol
from rlservo.serve_app.ray_serve.ingress import Ingress, ServeBypass
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.request_stamp import STAMP, clock_id
from stores import store_of

ROOT = Path(__file__).resolve().parents[3]
OURS = (str(ROOT / "serve_app"), str(ROOT / "export"), str(ROOT / "deploy"))
MOST_FILES = 9  # of ours, between the socket and the network
BODY = json.dumps({"obs": [0.1] * 27}).encode()


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
            self.files.setdefault(str(Path(frame.f_code.co_filename).relative_to(ROOT)))


@pytest.fixture
def bypass(monkeypatch: pytest.MonkeyPatch) -> Iterator[ServeBypass]:
    """The process's bypass, for one test."""
    monkeypatch.setattr(ingress_module, "bypass", ServeBypass())
    yield ingress_module.bypass


def request() -> bytes:
    """Return a request as HAProxy passes it on."""
    headers = [
        "POST /v1/policies/ur5/act HTTP/1.1",
        "host: 127.0.0.1",
        "content-type: application/json",
        f"content-length: {len(BODY)}",
        f"{STAMP}: {time.time() * 1e3:.0f}-{clock_id()}",
        "x-forwarded-for: 127.0.0.1",
    ]
    return "\r\n".join([*headers, "", ""]).encode() + BODY


def test_a_json_request_passes_at_most_nine_files_between_socket_and_network(ur5: Path, bypass: ServeBypass) -> None:
    async def scenario() -> PassedFiles:
        store = store_of(Policy.load(ur5))
        app = create_app(lambda: store, ServerSettings())
        bypass.install(app)
        config = uvicorn.Config(
            Ingress(app), http=TimedProtocol, log_level="critical", lifespan="off", access_log=False
        )
        server = uvicorn.Server(config)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            serving = asyncio.create_task(server.serve(sockets=[listener]))
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            passed = PassedFiles()
            for number in range(3):  # the first tells the prefix, by way of Serve
                content = request()
                sys.setprofile(passed if number == 2 else None)
                try:
                    writer.write(content)
                    status = await reader.readline()
                    await reader.readuntil(b"}")
                finally:
                    sys.setprofile(None)
                assert b" 200 " in status
            writer.close()
            server.should_exit = True
            await serving
        return passed

    passed = asyncio.run(scenario())
    assert passed.reached_network
    assert len(passed.files) <= MOST_FILES, list(passed.files)
    assert list(passed.files)[-1] == "serve_app/runtime/leaf_observations.py"  # what is nearest to the network
