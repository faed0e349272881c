"""Servers for tests: an application on uvicorn, and `rlservo serve`."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from rlservo.serve_app.ray_serve.launcher import serve_policies
from rlservo.serve_app.ray_serve.processes import free_ports
from rlservo.serve_app.server.api_keys import new_key


@contextlib.contextmanager
def over_uvicorn(app: Any) -> Iterator[int]:
    """Serve an ASGI application from a thread; gives the port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(uvicorn.Config(app, log_level="critical", access_log=False, lifespan="on"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            while not server.started:
                time.sleep(0.01)
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="session")
def served() -> Callable[[Any], AbstractContextManager[int]]:
    """`over_uvicorn`."""
    return over_uvicorn


@dataclass(frozen=True)
class LiveServer:
    """A policy server on Ray Serve, with a key, gRPC and a log file."""

    port: int
    grpc_port: int
    key: str
    log: Path

    @property
    def bearer(self) -> str:
        return f"Bearer {self.key}"


@pytest.fixture(scope="session")
def live_server(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """Start `rlservo serve` once for all the tests that need nothing special of it."""
    port, grpc_port = free_ports(2)
    key, line = new_key("tests")
    log = tmp_path_factory.mktemp("log") / "server.jsonl"
    ready, stop = threading.Event(), threading.Event()
    failures: list[Exception] = []

    def serve() -> None:
        try:
            serve_policies(
                [policies],
                port=port,
                grpc_port=grpc_port,
                settings={"api_keys": line, "default_policy": "ur5", "log_file": str(log), "log_requests": True},
                on_ready=lambda _: ready.set(),
                stop=stop,
            )
        except Exception as error:
            failures.append(error)
            ready.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert ready.wait(120) and not failures, failures
        yield LiveServer(port, grpc_port, key, log)
    finally:
        stop.set()
        thread.join(60)
    assert not thread.is_alive()
