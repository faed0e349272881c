"""Storages: moto's S3, a proxy in front of it that returns false data, and Redis."""

from __future__ import annotations

import contextlib
import functools
import http.client
import http.server
import itertools
import logging
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

SECRET = "moto-secret-key-that-must-not-be-shown"
SIGNED = "AWS4-HMAC-SHA256 Credential=moto/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0"
Lie = Callable[[str, int, dict[str, str], bytes], tuple[int, dict[str, str], bytes] | None]
"""From a path and what the storage replied to what is sent; None: the connection is closed without a word."""

ENDLESS = bytes(1 << 16)
"""As a reply's body: it is sent again and again, until the client hangs up."""
MOST_SENT = 96 << 20  # [bytes] and then it ends after all, so that a client without a bound fills no machine's memory
# Checksums are left out: botocore would see a lie before we do, and not every storage sends them.
DROPPED = {"content-length", "connection", "transfer-encoding", "date", "server", "x-amz-checksum-crc32"}
_buckets = itertools.count(1)


class Cut(bytes):
    """A reply's body of which three quarters come: then the connection breaks."""


class Drip(bytes):
    """A reply's body that comes byte by byte, ten in a second: no read of it ever waits for long."""


@dataclass
class Storage:
    """One bucket, reached through a proxy whose `lie` a test may set."""

    uri: str
    endpoint: str
    environment: dict[str, str]
    proxy: _Proxy
    requests: list[str] = field(default_factory=list)

    def tell(self, lie: Lie | None) -> None:
        self.proxy.lie = lie

    def go_away(self) -> None:
        """From now on every connection is closed at once."""
        self.proxy.lie = lambda *_: None

    def gets(self, end: str) -> int:
        """Number of reads of an object whose name ends so."""
        return sum(line.startswith("GET ") and line.endswith(end) for line in self.proxy.requests)

    def make(self, bucket: str) -> None:
        """Make another bucket; it may be there."""
        _make_bucket(self.proxy.upstream, bucket)

    def change(self, method: str, name: str, content: bytes = b"") -> None:
        """Write or delete an object without the server's knowledge."""
        path = self.uri.removeprefix("s3:/") + "/" + name
        assert _ask(self.proxy.upstream, method, path, {"authorization": SIGNED}, content)[0] < 300


class _Proxy(http.server.ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    lie: Lie | None = None

    def __init__(self, upstream: int) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.upstream = upstream
        self.requests: list[str] = []
        self.sent = 0  # [bytes] of replies without an end
        self.stopped = threading.Event()

    def handle_error(self, *_: Any) -> None:
        """A client that gave up is what is tested."""


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Proxy
    protocol_version = "HTTP/1.1"

    def _pass_on(self) -> None:
        content = self.rfile.read(int(self.headers.get("content-length") or 0))
        self.server.requests.append(f"{self.command} {self.path.partition('?')[0]}")
        lie = self.server.lie
        status, headers, body = _ask(self.server.upstream, self.command, self.path, dict(self.headers), content)
        answer = (status, headers, body) if lie is None else lie(self.path, status, headers, body)
        if answer is None:
            self.close_connection = True
            return
        status, headers, body = answer
        self.send_response(status)
        for name, value in headers.items():
            if name.lower() not in DROPPED:
                self.send_header(name, value)
        if body is not ENDLESS:
            self.send_header("content-length", str(len(body)))
            self.end_headers()
            self.close_connection = isinstance(body, Cut)
            if isinstance(body, Drip):
                for number in range(len(body)):
                    self.wfile.write(body[number : number + 1])
                    time.sleep(0.1)
            else:
                self.wfile.write(body[: len(body) * 3 // 4] if isinstance(body, Cut) else body)
            return
        self.close_connection = True  # which is the only end of such a reply
        self.end_headers()
        while self.server.sent < MOST_SENT:
            self.wfile.write(ENDLESS)
            self.server.sent += len(ENDLESS)

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _pass_on

    def log_message(self, *_: Any) -> None:
        pass


def _ask(
    port: int, method: str, path: str, headers: dict[str, str], content: bytes
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request(method, path, content, {k: v for k, v in headers.items() if k.lower() != "accept-encoding"})
        reply = connection.getresponse()
        return reply.status, dict(reply.headers), reply.read()
    finally:
        connection.close()


@pytest.fixture(scope="session")
def moto() -> Iterator[int]:
    """The port of an S3."""
    from botocore.loaders import JSONFileLoader

    # Each test's client would parse S3's own description again, megabytes of it: a third of their time.
    patch = pytest.MonkeyPatch()
    load = functools.cache(functools.partial(JSONFileLoader.load_file, JSONFileLoader()))
    patch.setattr(JSONFileLoader, "load_file", lambda _, path: load(path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from moto.server import ThreadedMotoServer

        server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        server.start()
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
    yield server.get_host_and_port()[1]
    server.stop()
    patch.undo()


def _make_bucket(port: int, name: str) -> None:
    assert _ask(port, "PUT", f"/{name}", {}, b"")[0] == 200


@pytest.fixture
def storage(moto: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Storage]:
    """A bucket of its own, and the environment to reach it through a proxy."""
    proxy = _Proxy(moto)
    thread = threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    bucket = f"policies-{os.getpid()}-{next(_buckets)}"
    _make_bucket(moto, bucket)
    environment = {
        "AWS_ACCESS_KEY_ID": "moto",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{proxy.server_address[1]}",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    yield Storage(f"s3://{bucket}/policies", environment["AWS_ENDPOINT_URL"], environment, proxy)
    proxy.stopped.set()
    proxy.shutdown()
    proxy.server_close()
    thread.join()


def only(end: str, lie: Lie) -> Lie:
    """A lie about objects whose name ends so, and the truth about all others."""
    return lambda path, *reply: lie(path, *reply) if path.partition("?")[0].endswith(end) else reply


def late(seconds: float) -> Lie:
    """Every reply comes so late."""

    def wait(_path: str, *reply: Any) -> tuple[int, dict[str, str], bytes]:
        time.sleep(seconds)
        return reply  # type: ignore[return-value]

    return wait


class RedisServer:
    """A redis-server of our own on a Unix socket. It can be killed and started again with the files that it wrote."""

    def __init__(self, folder: Path) -> None:
        assert shutil.which("redis-server") is not None, "no Redis (Debian: apt-get install redis-server)"
        self._folder = folder
        self._socket = folder / "redis.sock"
        self.url = f"unix://{self._socket}?db=0"
        self.start()

    def start(self) -> None:
        options = {"port": "0", "unixsocket": self._socket, "dir": self._folder, "save": "", "loglevel": "warning"}
        arguments = [str(part) for name, value in options.items() for part in (f"--{name}", value)]
        self.process = subprocess.Popen(["redis-server", *arguments], stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 30
        while True:
            try:
                assert self.command("PING") == b"PONG\n"
                return
            except subprocess.CalledProcessError:
                assert time.monotonic() < deadline
                time.sleep(0.02)

    def command(self, *words: str) -> bytes:
        """Return what redis-cli prints."""
        return subprocess.run(
            ["redis-cli", "-s", str(self._socket), "-e", *words], check=True, capture_output=True
        ).stdout

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(30)
        self._socket.unlink(missing_ok=True)


@contextlib.contextmanager
def running_redis() -> Iterator[RedisServer]:
    """A Redis that keeps nothing by itself; `SAVE` writes a file, which the next start reads."""
    with tempfile.TemporaryDirectory(prefix="redis") as folder:  # sockets need a short path
        server = RedisServer(Path(folder))
        try:
            yield server
        finally:
            server.kill()


@pytest.fixture
def redis_server() -> Iterator[RedisServer]:
    """`running_redis`."""
    with running_redis() as server:
        yield server


def closing_sessions(app: Any) -> Any:
    """Close an application's connections to Redis with it, as an engine does."""

    async def run(scope: Any, receive: Any, send: Any) -> None:
        await app(scope, receive, send)
        if scope["type"] == "lifespan":
            await app.handler.close()

    return run
