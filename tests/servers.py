"""Servers for tests: an application on uvicorn, and `rlservo serve`, in a thread and in processes of its own."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import random
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import uvicorn

from rlservo.serve_app.engines.ports import listen, port_holder
from rlservo.serve_app.engines.uvicorn_server import serve_policies
from rlservo.serve_app.server.api_keys import new_key

ROOT = Path(__file__).resolve().parents[1]
# A shell's background job starts with Ctrl-C ignored, and so would all it starts, `serve run` among them. Not by
# `preexec_fn`: a fork that runs Python in a process that has a gRPC server dies of SIGABRT once in a hundred times.
HEEDING_CTRL_C = ("env", "--default-signal=INT")
RUN_ID = "RLSERVO_TEST"  # inherited by every process a test starts, however far down
STREAM_IDLE_S = 8.0  # of the live server
CONNECTIONS_PER_ADDRESS = 300

# Runs the embedded server in a process's main thread, as the command line does, and prints when it is ready.
LAUNCH = """
import json, pathlib, sys
from rlservo.errors import RlservoError
from rlservo.serve_app.engines.uvicorn_server import serve_policies
plan = json.loads(sys.argv[1])
key_file = plan.pop("admin_key_file")
try:
    serve_policies(
        **plan,
        admin_key_file=key_file and pathlib.Path(key_file),
        on_ready=lambda served: print("READY", served.url, flush=True),
    )
except RlservoError as error:
    print("FAILED", error.message, flush=True)
    sys.exit(1)
"""


PORTS = range(20_000, 30_000)  # below those of outgoing connections (Linux: 32768 and up)


def free_ports(count: int) -> list[int]:
    """Return free ports that no other process of the tests takes while this one lives.

    The system's own choice (port 0) would be one of those it also gives to outgoing connections. A claim is a Unix
    socket's name, which goes with its process.
    """
    found: list[int] = []
    for port in random.SystemRandom().sample(PORTS, len(PORTS)):
        if len(found) == count:
            return found
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0rlservo-test-{port}")
            socket.create_server(("", port)).close()
        except OSError:
            claim.close()
        else:
            claim.detach()  # open, and with it the claim, until this process ends
            found.append(port)
    raise AssertionError(f"{len(found)} of {count} ports are free")


def connected(address: int | Path, timeout_s: float) -> socket.socket:
    """Connect to a port of this machine or to a Unix socket."""
    if isinstance(address, int):
        return socket.create_connection(("127.0.0.1", address), timeout=timeout_s)
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(timeout_s)
    try:
        connection.connect(str(address))
    except OSError:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def over_uvicorn(app: Any, port: int = 0) -> Iterator[int]:
    """Serve an ASGI application from a thread; gives the port, by default a free one."""
    with socket.create_server(("127.0.0.1", port)) as listener:
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


@contextlib.contextmanager
def served_in_thread(dirs: Sequence[Path], **options: Any) -> Iterator[int]:
    """Run `serve_policies` in a thread; gives the port. An event ends it, and nothing listens there afterwards."""
    (port,) = free_ports(1)
    ready, stop = threading.Event(), threading.Event()
    failures: list[BaseException] = []

    def serve() -> None:
        try:
            with tempfile.TemporaryDirectory() as plans:
                # On a busy machine the test's own thread keeps the server's from running for a second.
                options["settings"] = {"plan": plans, "max_queue_ms": 60_000.0, **options.get("settings", {})}
                serve_policies(dirs, port=port, on_ready=lambda _: ready.set(), stop=stop, **options)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        while not ready.wait(0.1):
            assert thread.is_alive(), failures
        yield port
    finally:
        stop.set()
        thread.join(60)
    assert failures == [] and not thread.is_alive() and port_holder(port) is None


@dataclass
class Run:
    """A program with a temporary folder of its own, and all that it started."""

    process: subprocess.Popen[str]
    port: int
    run_id: str
    grpc_port: int | None = None
    key_file: Path | None = None
    output: list[str] = field(default_factory=list)
    reader: threading.Thread | None = None

    def wait_until_ready(self) -> None:
        """Wait until the server prints that it is ready; what it prints, its log, is kept in `output`."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.output.append(line)
            if line.startswith("READY"):
                # Read on, so that the pipe never fills.
                self.reader = threading.Thread(target=self.output.extend, args=(self.process.stdout,), daemon=True)
                self.reader.start()
                return
        raise AssertionError("".join(self.output))

    @property
    def folder(self) -> Path:
        return _folder(self.run_id)

    def processes(self, part: str = "") -> list[int]:
        """Return those of its processes whose command line has this in it."""
        return [pid for pid, name in processes_of(self.run_id).items() if part in name]

    def left(self) -> list[str]:
        """Return the command lines of processes this run started that still live."""
        return [name for pid, name in processes_of(self.run_id).items() if pid != self.process.pid]

    def end(self, *signals: signal.Signals, folders: bool = True) -> int:
        """Send signals, wait for the end, assert that nothing is left; return the exit code."""
        for place, number in enumerate(signals):
            time.sleep(0.3 if place else 0.0)
            self.process.send_signal(number)
        code = self.process.wait(timeout=90)
        self._nothing_is_left(folders=folders)
        return code

    def _nothing_is_left(self, *, folders: bool) -> None:
        """Assert that no process, no listener and, with `folders`, no file is left within 20 seconds."""
        deadline = time.monotonic() + 20
        while True:
            left = self.left() + ([str(path) for path in self.folder.glob("*")] if folders else [])
            if not left or time.monotonic() > deadline:
                break
            time.sleep(0.1)
        assert left == []
        assert self.key_file is None or not self.key_file.exists()
        assert port_holder(self.port) is None
        listen("127.0.0.1", self.port).close()


def processes_of(run_id: str) -> dict[int, str]:
    """Return the command lines of the processes that carry a mark."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if f"{RUN_ID}={run_id}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def _folder(run_id: str) -> Path:
    return Path(tempfile.gettempdir()) / f"t{run_id}"


@contextlib.contextmanager
def running(arguments: Sequence[str], port: int, **environment: str) -> Iterator[Run]:
    """Start a program with a temporary folder of its own, and end whatever is left of it in the end."""
    run_id = secrets.token_hex(2)
    temporary = _folder(run_id)
    temporary.mkdir()
    variables = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    plans = tempfile.mkdtemp()  # the folder of policies may be shared, and its plan would outlive this program
    variables.update({RUN_ID: run_id, "TMPDIR": str(temporary), "RLSERVO_PLAN": plans, **environment})
    process = subprocess.Popen(
        [*HEEDING_CTRL_C, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=variables,
        cwd=ROOT,
    )
    run = Run(process, port, run_id)
    try:
        yield run
    finally:
        for pid in processes_of(run_id):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait()
        if run.reader is not None:
            run.reader.join(20)
        assert process.stdout is not None
        process.stdout.close()
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(plans)


@contextlib.contextmanager
def launched(
    *dirs: Path,
    workers: int = 1,
    with_grpc: bool = False,
    with_admin_key: bool = False,
    settings: Mapping[str, Any] | None = None,
    prefix: tuple[str, ...] = (),
    **environment: str,
) -> Iterator[Run]:
    """Start `serve_policies` in processes of its own. The caller ends it, or its remains are killed."""
    port, grpc_port = free_ports(2)
    with tempfile.TemporaryDirectory() as keys:
        key_file = Path(keys, "admin.key") if with_admin_key else None
        plan = {
            "places": list(map(str, dirs)),
            "port": port,
            "grpc_port": grpc_port if with_grpc else None,
            "workers": workers,
            "settings": dict(settings or {}),
            "admin_key_file": key_file and str(key_file),
        }
        with running([*prefix, sys.executable, "-c", LAUNCH, json.dumps(plan)], port, **environment) as run:
            run.key_file, run.grpc_port = key_file, plan["grpc_port"]
            yield run


@dataclass(frozen=True)
class LiveServer:
    """An embedded server with a key, gRPC, a log file and a recording."""

    run: Run
    port: int
    grpc_port: int
    key: str
    log: Path
    recorded: Path

    @property
    def bearer(self) -> str:
        return f"Bearer {self.key}"


@pytest.fixture(scope="session")
def live_server(policies: Path, recurrent: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """`rlservo serve`, once for all the tests that need nothing special of it; no admin key.

    It is started as a shell script's background job is: with SIGINT ignored.
    SIGINT ends it, with nothing left.
    """
    key, line = new_key("tests", explore=True)
    log = tmp_path_factory.mktemp("log") / "server.jsonl"
    recorded = tmp_path_factory.mktemp("recorded")
    settings = {
        "record": str(recorded),
        "api_keys": line,
        "default_policy": "ur5",
        "log_file": str(log),
        "log_requests": True,
        "stream_idle_s": STREAM_IDLE_S,
        "max_queue_ms": 60_000.0,  # a busy machine may keep the server from its work for longer than a robot would wait
        "max_connections_per_address": CONNECTIONS_PER_ADDRESS,
    }
    ignoring = ("sh", "-c", "trap '' INT; exec \"$@\"", "sh")
    with launched(policies, recurrent, with_grpc=True, settings=settings, prefix=ignoring) as run:
        run.wait_until_ready()
        assert run.grpc_port is not None
        yield LiveServer(run, run.port, run.grpc_port, key, log, recorded)
        assert run.end(signal.SIGINT) == 0


@dataclass(frozen=True)
class ShippedServer:
    """The shipped policies behind `rlservo serve`, as a user starts it."""

    url: str
    runtime: Path  # where it keeps its operator's key


@pytest.fixture(scope="session")
def shipped_server(shipped: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShippedServer]:
    """`rlservo serve` with the policies of `shipped`. SIGTERM ends it, with nothing left."""
    (port,) = free_ports(1)
    runtime = tmp_path_factory.mktemp("runtime")
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(shipped), "--port", str(port)]
    with running(command, port, XDG_RUNTIME_DIR=str(runtime)) as run:
        assert run.process.stdout is not None
        printed: list[str] = []
        drain = threading.Thread(target=printed.extend, args=(run.process.stdout,), daemon=True)
        drain.start()  # so that the pipe never fills
        wait_until_served(run)
        yield ShippedServer(f"http://127.0.0.1:{port}", runtime)
        run.end(signal.SIGTERM)
        drain.join()
    assert list((runtime / "rlservo").iterdir()) == []  # the key went with the server


class Reply(NamedTuple):
    """A reply over HTTP."""

    status: int
    headers: dict[str, str]  # names in lower case
    content: bytes

    @property
    def document(self) -> Any:
        """The content out of JSON, or the bytes of what is none."""
        return json.loads(self.content) if self.content[:1] in (b"{", b"[") else self.content


def exchange(port: int, method: str, path: str, body: Any = None, **headers: str) -> Reply:
    """Send one request on a connection of its own; a body that is not bytes is sent as JSON."""
    content = body if body is None or isinstance(body, bytes) else json.dumps(body)
    sent = {"content-type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:
        connection.request(method, path, content, sent)
        reply = connection.getresponse()
        return Reply(reply.status, {name.lower(): value for name, value in reply.headers.items()}, reply.read())


def ask(port: int, method: str, path: str, body: Any = None, key: str = "") -> tuple[int, Any]:
    """Send one request; return the status and the document, or the bytes of what is none."""
    reply = exchange(port, method, path, body, **({"authorization": f"Bearer {key}"} if key else {}))
    return reply.status, reply.document


def wait_until_served(run: Run, output: Sequence[str] = (), timeout_s: float = 180) -> None:
    """Wait until a server answers that it is ready; `output` is what it has said until then."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline and run.process.poll() is None:
        with contextlib.suppress(OSError, http.client.HTTPException):
            if ask(run.port, "GET", "/v2/health/ready")[0] == 200:
                return
        time.sleep(0.2)
    if not output and run.process.poll() is not None and run.process.stdout is not None:
        output = [run.process.stdout.read()]
    raise AssertionError(f"the server did not become ready: {''.join(output)[-5000:]}")
