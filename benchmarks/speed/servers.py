"""A server under measurement: how it is started, seen to answer, and ended with all it started."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPConnection
from pathlib import Path

from speed.machine import MARK, Process, family

START_S = 180.0  # a cold Ray on a small machine needs most of a minute
STOP_S = 30.0
LINGER_S = 5.0  # what a server's other processes get after its first one has ended


class StartError(Exception):
    """A server that cannot be measured, and why."""


@dataclass(frozen=True)
class Exchange:
    """An HTTP request that is sent again and again."""

    method: str
    path: str
    body: bytes
    headers: tuple[tuple[str, str], ...] = (("Content-Type", "application/json"),)


@dataclass
class Server:
    """One server: a command, an address, and what it can be asked."""

    name: str
    command: list[str]
    port: int
    act: Exchange
    env: dict[str, str] = field(default_factory=dict)
    batch: Exchange | None = None
    """A large batch of observations in the binary protocol."""
    heavy: Exchange | None = None
    """A smaller one: enough work a request that what carries requests is not what several replicas wait for."""
    stream: str | None = None
    """The path of its WebSocket."""
    message: bytes = b""
    """One observation as the WebSocket takes it."""
    greets: bool = False
    """Whether the WebSocket's server speaks first."""
    grpc_port: int | None = None
    direct_port: int | None = None
    """Where its replicas listen themselves."""
    process: subprocess.Popen[bytes] | None = None
    cold_start_s: float = 0.0
    mark: str = ""

    def members(self) -> dict[int, Process]:
        """Return its processes."""
        return {} if self.process is None else family(self.process.pid, self.mark)


@contextmanager
def running(server: Server, folder: Path, mark: str) -> Iterator[None]:
    """Start the server, wait until it answers, and at the end stop it and all its processes."""
    began = time.perf_counter()
    with started(server, folder, mark) as log:
        wait_until_answering(server, log)
        server.cold_start_s = time.perf_counter() - began
        yield


@contextmanager
def started(server: Server, folder: Path, mark: str) -> Iterator[Path]:
    """Start the server, give its log, and at the end stop it and all its processes."""
    log = folder / f"{server.port}.log"
    server.mark = f"{mark}:{server.port}"
    with log.open("wb") as output:
        server.process = subprocess.Popen(
            server.command,
            env=environment(server.mark, server.env),
            cwd=folder,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        yield log
    finally:
        stop(server)


def wait_until_answering(server: Server, log: Path) -> None:
    """Return when the server has given its first action. Raises StartError with the end of its log."""
    assert server.process is not None
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and server.process.poll() is None:
        with suppress(OSError):
            status, answer = ask(server)
            if status == 200:
                return
            if status in (400, 422):  # it is up, and this benchmark asks it wrongly
                raise StartError(f"{server.name} refuses the observation: {answer[:500].decode(errors='replace')}")
        time.sleep(0.05)
    text = log.read_text(errors="replace")[-3000:]
    raise StartError(f"{server.name} did not come up; the end of its log: {text}")


def ask(server: Server) -> tuple[int, bytes]:
    """Ask for one action on a connection of its own."""
    connection = HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request(server.act.method, server.act.path, server.act.body, dict(server.act.headers))
        response = connection.getresponse()
        return response.status, response.read()
    except TimeoutError as error:
        raise OSError("no answer yet") from error
    finally:
        connection.close()


def stop(server: Server) -> None:
    """Ask with SIGTERM, wait, then end what is left of the server's processes."""
    process = server.process
    if process is None:
        return
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_S)
    deadline = time.monotonic() + LINGER_S
    while time.monotonic() < deadline and server.members():
        time.sleep(0.1)
    for pid in server.members():  # LitServe's API process stays, say
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()
    while (left := server.members()) and time.monotonic() < deadline + LINGER_S:
        time.sleep(0.1)
    if left:
        print(f"{server.name}: processes {sorted(left)} would not end", file=sys.stderr)
    server.process = None
    if listening(server.port):
        print(f"{server.name}: port {server.port} is still in use after it was stopped", file=sys.stderr)


def environment(mark: str, extra: dict[str, str]) -> dict[str, str]:
    """Return the environment of a server: the user's own RAY_* settings would not be Ray's defaults."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
    return {**kept, "PYTHONDONTWRITEBYTECODE": "1", **extra, MARK: mark}


def listening(port: int, host: str = "127.0.0.1") -> bool:
    """Whether anybody accepts connections there."""
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex((host, port)) == 0
