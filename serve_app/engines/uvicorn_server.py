"""Embedded engine: the application on uvicorn, in this process or in workers under uvicorn's supervisor.

One worker runs in the calling process. Several are processes of uvicorn's `Multiprocess`, which replaces a worker that
died or hangs, and on SIGHUP all of them, one by one. A worker exits when its parent has died.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import resource
import shutil
import signal
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors import Multiprocess
from uvicorn.supervisors.multiprocess import Process

from rlservo.client.formats.addresses import is_loopback
from rlservo.client.formats.admin_key_file import remove_key, written_key
from rlservo.errors import RlservoError, UnavailableError, UsageError
from rlservo.serve_app.engines.connection_bounds import (
    HANDLER,
    MAX_CONNECTIONS,
    BoundedHttp,
    BoundedWebSocket,
)
from rlservo.serve_app.engines.ports import BACKLOG, listen
from rlservo.serve_app.engines.server_process import running
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.repository.places import place_of
from rlservo.serve_app.server.api_keys import Role, check_exposure, new_key
from rlservo.serve_app.server.logs import configure
from rlservo.serve_app.server.metrics import FOLDER_VARIABLE, shared_by_workers
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import checked_start, not_served, plan_follower
from rlservo.serve_app.versions.computing import left_by_dead, write_to
from rlservo.serve_app.versions.deployment_plan import ServedConfig
from rlservo.serve_app.versions.policy_store import PolicyStore

logger = logging.getLogger(__name__)

KEEP_ALIVE_S = 90  # [s] that a connection may be idle
DRAIN_S = 15  # [s] for requests in progress when the server stops
HUNG_S = 30  # [s] until an unresponsive worker is replaced
START_S = 300  # [s] until one that is starting is: on a starved machine the imports alone may take a minute
PATIENCE_S = 10  # [s] until a start that takes longer is logged
RETRY_S = 10  # [s] until a worker that could not start in place of another is started again
EXIT_S = DRAIN_S + 5  # [s] for a worker to exit
DESCRIPTORS = MAX_CONNECTIONS + 256  # open files that a server at full load needs
FEWEST_DESCRIPTORS = 64  # with fewer no connection may be left
UVICORN = logging.getLogger("uvicorn.error")


@dataclass(frozen=True)
class RunningServer:
    """Addresses and policies of a server that answers requests."""

    url: str
    policies: tuple[tuple[str, str], ...]  # (name, default version)
    grpc: str | None = None  # host:port, if gRPC is served
    admin_key_file: Path | None = None  # the operator's key, for as long as the server runs
    not_served: tuple[str, ...] = ()  # a sentence for each bundle that the plan leaves out


def serve_policies(
    places: Sequence[str | Path],
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    grpc_port: int | None = None,
    workers: int = 1,
    settings: Mapping[str, Any] | None = None,
    served: Mapping[str, Any] | None = None,
    admin_key_file: Path | None = None,
    on_ready: Callable[[RunningServer], None] | None = None,
    on_stop: Callable[[], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve the policies at or below `places`, folders or URIs, until Ctrl-C, SIGTERM or `stop`.

    `served` is a `ServedConfig`: versions, aliases, canary, shadow. With an `admin_key_file`, and no admin key in the
    settings, a key for administration is written there, readable only by this user, and removed at the end. `on_ready`
    is called when the server answers requests, `on_stop` when it begins to stop. After a second Ctrl-C it does not wait
    for requests in progress.

    In the main thread this handles SIGINT, SIGTERM and SIGHUP while it runs; in another thread, which allows only one
    worker, `stop` ends it. Raises UsageError or BundleError for a fault known at the start, and UnavailableError if a
    port or a storage is not available.
    """
    if workers < 1:
        raise UsageError(f"workers must be 1 or more, got {workers}")
    in_main = threading.current_thread() is threading.main_thread()
    if workers > 1 and not in_main:
        raise UsageError(
            "several workers must be started from the main thread: only there can their supervisor handle signals"
        )
    chosen = ServerSettings.from_environment(settings)
    ServedConfig.parse(dict(served or {}))
    keys = check_exposure(host, chosen)
    if not keys.keys and not is_loopback(host):
        logger.warning(
            "listening on %s without authentication: anyone who can reach this port can request actions", host
        )
    if keys.operator is not None or any(key.role is Role.admin for key in keys.keys):
        admin_key_file = None
    _raise_descriptor_limit()
    stopping = on_stop or (lambda: None)
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(contextlib.closing(listen(host, port)))
        if grpc_port is not None:
            listen(host, grpc_port, option="--grpc-port").close()
        key, line = new_key("operator", admin=True)
        if admin_key_file is not None and stack.enter_context(written_key(admin_key_file, key)):
            chosen = chosen.model_copy(update={"operator_key": line.split()[-1]})
        else:
            admin_key_file = None
        server = EmbeddedServer(
            tuple(place_of(place) for place in places),
            host,
            grpc_port,
            workers,
            chosen,
            dict(served or {}),
            admin_key_file,
        )
        shown = "127.0.0.1" if host == "0.0.0.0" else "[::1]" if host == "::" else f"[{host}]" if ":" in host else host
        url = f"http://{shown}:{listener.getsockname()[1]}"
        grpc = None if grpc_port is None else f"{shown}:{grpc_port}"

        def ready(store: PolicyStore, left_out: Sequence[str]) -> None:
            policies = tuple((name, store.default(name)) for name in store.names)
            if on_ready is not None:
                on_ready(RunningServer(url, policies, grpc, admin_key_file, tuple(left_out)))

        if workers > 1:
            _run_workers(server, listener, ready, stopping)
            return
        server.on_ready = ready
        process = _Server(server.config(), stopping, stop)
        configure(chosen)
        UVICORN.setLevel(logging.CRITICAL)  # our exception reports a failed start
        if in_main:
            stack.enter_context(_stop_signals(lambda: setattr(process, "should_exit", True)))
        try:
            process.run(sockets=[listener])
        except SystemExit:
            raise server.failure or UnavailableError("the server could not start: see its log") from None


@dataclass
class EmbeddedServer:
    """The application with its lifespan: policies are loaded and gRPC listens before the first connection.

    It is pickled for the workers before it starts.
    """

    places: tuple[str, ...]
    host: str
    grpc_port: int | None
    workers: int
    settings: ServerSettings
    served: dict[str, Any]
    admin_key_file: Path | None = None
    """The operator's key, whose file workers remove if their supervisor has died."""
    on_ready: Callable[[PolicyStore, Sequence[str]], None] | None = None
    """Called when the policies are loaded: connections to the socket, which listens already, are answered."""
    failure: Exception | None = None
    """Reason why the start failed, in the process that serves."""
    app: ASGIApp | None = None
    """The application, once it has started."""

    def __call__(self, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        """Handle one connection, or first the server's own start and stop."""
        return (self.app or self._live)(scope, receive, send)

    async def _live(self, scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        try:
            async with contextlib.AsyncExitStack() as stack:
                await self._start(stack, scope["state"])
                await send({"type": "lifespan.startup.complete"})
                await receive()
        except (RlservoError, OSError) as error:
            self.failure = error
            if self.workers > 1:
                logger.error("a worker could not start: %s", error)
            await send({"type": "lifespan.startup.failed", "message": ""})
            return
        await send({"type": "lifespan.shutdown.complete"})

    async def _start(self, stack: contextlib.AsyncExitStack, state: dict[str, Any]) -> None:
        settings, is_worker = self.settings, self.workers > 1
        replica = str(os.getpid()) if is_worker else ""
        if is_worker:
            configure(settings, replica=replica)
            _stop_with_parent(self.admin_key_file, settings.operator_key)
            write_to(Path(os.environ[FOLDER_VARIABLE]))
        server_folder = Path(os.environ[FOLDER_VARIABLE]) if is_worker else None
        control = plan_follower(self.places, settings)
        app = create_app(control, settings, replica=replica, host=self.host, is_alone=not is_worker)
        stack.callback(app.handler.metrics.leave)
        stack.push_async_callback(app.handler.close)
        await stack.enter_async_context(running(app.handler, self.served, server_folder))
        store = app.handler.store()
        if settings.default_policy not in (None, *store.names):
            raise UsageError(
                f"the default policy '{settings.default_policy}' is not served: expected {', '.join(store.names)}"
            )
        if self.grpc_port is not None:
            from rlservo.serve_app.engines.grpc_server import GrpcServer  # takes a quarter of the start

            grpc = GrpcServer(app.handler, self.host, self.grpc_port, is_shared=is_worker)
            await grpc.start()
            stack.push_async_callback(grpc.stop)
        state[HANDLER] = app.handler
        left_out = await not_served(control) if self.on_ready is not None else []
        self.app = app
        if is_worker:
            _started(os.getpid()).touch()
        if self.on_ready is not None:
            self.on_ready(store, left_out)

    def config(self) -> uvicorn.Config:
        """Return uvicorn's configuration."""
        trusted = self.settings.trusted_proxies
        return uvicorn.Config(
            self,
            interface="asgi3",
            http=BoundedHttp,
            ws=BoundedWebSocket,
            lifespan="on",
            workers=self.workers,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=bool(trusted),
            forwarded_allow_ips=trusted or None,
            backlog=BACKLOG,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=DRAIN_S,
            timeout_worker_healthcheck=HUNG_S,
            ws_max_size=self.settings.max_body_bytes,
            ws_per_message_deflate=False,  # for messages of kilobytes it costs more than it saves
        )


def _stop_with_parent(key_file: Path | None, key_digest: str) -> None:
    """Stop this worker if its supervisor has died, and remove the files that it would have removed."""
    loop, parent = asyncio.get_running_loop(), multiprocessing.parent_process()
    if parent is None:
        return

    def stop() -> None:
        loop.remove_reader(parent.sentinel)
        if (folder := os.environ.get(FOLDER_VARIABLE)) is not None:
            shutil.rmtree(folder, ignore_errors=True)
        if key_file is not None:
            remove_key(key_file, key_digest)
        os.kill(os.getpid(), signal.SIGTERM)

    loop.add_reader(parent.sentinel, stop)


class _Server(uvicorn.Server):
    """uvicorn's server, which reports when it begins to stop, and stops on an event."""

    def __init__(self, config: uvicorn.Config, on_stop: Callable[[], None], stop: threading.Event | None) -> None:
        super().__init__(config)
        self._on_stop, self._stop = on_stop, stop

    async def on_tick(self, counter: int) -> bool:
        """Return whether to stop."""
        return await super().on_tick(counter) or (self._stop is not None and self._stop.is_set())

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer the requests in progress, and stop."""
        self._on_stop()
        await super().shutdown(sockets)


def _run_workers(
    server: EmbeddedServer,
    listener: socket.socket,
    on_ready: Callable[[PolicyStore, Sequence[str]], None],
    on_stop: Callable[[], None],
) -> None:
    # Faults of the policies are reported here, once, before any worker starts.
    store, left_out = checked_start(server.places, server.served, server.settings)
    store.close()
    configure(server.settings)
    UVICORN.setLevel(logging.INFO)
    with _stop_signals(lambda: None), shared_by_workers():  # the first restores the supervisor's signal handlers
        supervisor = _Supervisor(server.config(), listener, lambda: on_ready(store, left_out), on_stop)
        supervisor.run()
    if not supervisor.is_asked_to_stop:
        raise UnavailableError("a worker could not start: see the lines above")


def _started(pid: int | None) -> Path:
    """Return the file that a worker makes when it answers requests.

    uvicorn's own question, `Process.is_ready`, may never be answered: in a worker two threads make `Process.server`
    when they first need it, and if both do, it asks the one that does not run (0.54; one start in forty beside load).
    """
    return Path(os.environ[FOLDER_VARIABLE], f"{pid}.started")


class _Supervisor(Multiprocess):
    """uvicorn's supervisor, which reports when all workers are ready and kills those that do not exit."""

    def __init__(
        self, config: uvicorn.Config, listener: socket.socket, on_ready: Callable[[], None], on_stop: Callable[[], None]
    ) -> None:
        super().__init__(config, [listener])
        self._on_ready: Callable[[], None] | None = on_ready
        self._on_stop = on_stop
        self.is_asked_to_stop = False
        self._computing: dict[int, list[str]] = {}  # versions that dead workers were computing
        self._first_seen: dict[int | None, float] = {}  # by `time.monotonic`, of workers that are starting
        self._retry_at: dict[int | None, float] = {}  # by `time.monotonic`, of workers that could not start
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._queue_stop)

    def run(self) -> None:
        """Supervise the workers until they are stopped, or a callback raises."""
        try:
            super().run()
        except BaseException:
            self.terminate_all()  # Python's exit would wait for them
            self.join_all()
            raise

    def keep_subprocess_alive(self) -> None:
        """Replace workers that died or hang; report once when all are ready.

        uvicorn's own method stops all workers if a new one cannot start. Here those that serve keep serving: a bundle
        may have been exchanged since they started, or a file system be out of reach.
        """
        for process in self.processes:
            process.child_conn.close()  # the worker has its own: if it dies in a health check, the wait for it ends
        for index, process in enumerate(self.processes):
            began = time.monotonic()
            if self.should_exit.is_set():
                return
            if process.pid in self._retry_at:
                if began < self._retry_at[process.pid]:
                    continue
                del self._retry_at[process.pid]
            elif self._is_starting(process) or process.is_alive(timeout=HUNG_S):
                continue
            else:
                was_hung = process.exitcode is None and time.monotonic() - began >= HUNG_S  # or it died while asked
                process.kill()
                process.join()
                if process.exitcode == STARTUP_FAILURE:
                    serving = [each for each in self.processes if each.exitcode is None and _started(each.pid).exists()]
                    if not serving or self._on_ready is not None:
                        self.should_exit.set()
                        return
                    self._retry_at[process.pid] = time.monotonic() + RETRY_S
                    logger.error(
                        "worker %s cannot replace another: %d keep serving, the next try is in %d s",
                        process.pid,
                        len(serving),
                        RETRY_S,
                    )
                    continue
                self._computing |= left_by_dead(Path(os.environ[FOLDER_VARIABLE]))
                _log_death(process.pid, was_hung, process.exitcode, self._computing.pop(process.pid or 0, []))
            self.processes[index] = Process(self.config, self.sockets)
            self.processes[index].start()
        if self._on_ready is not None and all(_started(process.pid).exists() for process in self.processes):
            self._on_ready()
            self._on_ready = None

    def _is_starting(self, process: Process) -> bool:
        """Whether a worker is still on its way to its first request, in which it answers no health check for long."""
        if process.exitcode is not None or _started(process.pid).exists():
            return False
        now = time.monotonic()
        return now - self._first_seen.setdefault(process.pid, now) < START_S

    def restart_all(self) -> None:
        """Replace each worker, the next one when the new one answers requests, unless one does not start.

        Workers that die meanwhile are replaced too: to load policies may take minutes.
        """
        for index in range(len(self.processes)):
            new, began, is_said = Process(self.config, self.sockets), time.monotonic(), False
            new.start()
            while not _started(new.pid).exists():
                is_ending = self.should_exit.is_set() or self._is_told_to_stop()
                if new.exitcode is not None or is_ending:
                    new.kill()
                    new.join()
                    if not is_ending:
                        logger.error(
                            "new worker %s could not start: worker %s stays", new.pid, self.processes[index].pid
                        )
                    return
                if not is_said and time.monotonic() - began > PATIENCE_S:
                    is_said = True
                    logger.warning(
                        "new worker %s is still starting: worker %s keeps serving", new.pid, self.processes[index].pid
                    )
                time.sleep(0.1)
                self.keep_subprocess_alive()
            old, self.processes[index] = self.processes[index], new
            self._retry_at.pop(old.pid, None)
            old.terminate()
            old.join()

    def handle_term(self) -> None:
        """Stop on SIGTERM, and on Ctrl-C."""
        if not self.is_asked_to_stop:
            self._on_stop()
        self.is_asked_to_stop = True
        self.should_exit.set()

    handle_int = handle_term

    def terminate_all(self) -> None:
        """Stop the workers, also those that are stopped (SIGSTOP), as systemd does."""
        super().terminate_all()
        self._continue_all()

    def join_all(self) -> None:
        """Wait for the workers to exit, and kill those that do not; the time is for all together."""
        end = time.monotonic() + EXIT_S
        for process in self.processes:
            process.process.join(max(0.0, end - time.monotonic()))
            if process.process.exitcode is None:
                process.process.kill()
        super().join_all()

    def _queue_stop(self, number: int, _frame: FrameType | None) -> None:
        """Queue a signal; a health check in progress would wait for a worker that is stopped."""
        self.signal_queue.append(number)
        self._continue_all()

    def _is_told_to_stop(self) -> bool:
        return not {signal.SIGINT, signal.SIGTERM}.isdisjoint(self.signal_queue)

    def _continue_all(self) -> None:
        for process in self.processes:
            if process.pid is not None and process.exitcode is None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGCONT)


def _log_death(pid: int | None, was_hung: bool, code: int | None, computing: Sequence[str]) -> None:
    """Log the end of a worker that another replaces; the supervisor has killed one that was hung."""
    if was_hung:
        how = f"did not answer for {HUNG_S} s and was killed"
    elif code is not None and code < 0:
        how = f"was ended by signal {-code} ({signal.strsignal(-code)})"
        if code == -signal.SIGKILL:
            how += ", perhaps because memory ran out,"
    else:
        how = f"exited with code {code}"
    logger.error("worker %s %s while computing %s; it is replaced", pid, how, " and ".join(computing) or "nothing")


@contextlib.contextmanager
def _stop_signals(request_stop: Callable[[], None]) -> Iterator[None]:
    """Stop on SIGINT, SIGTERM and SIGHUP also before and after uvicorn handles them, and without an exception.

    uvicorn raises a signal again after shutting down. SIGHUP stays ignored if it was, as under nohup.
    """

    def handle(_number: int, _frame: FrameType | None) -> None:
        request_stop()

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _raise_descriptor_limit() -> None:
    """Raise the limit of open files to what a full server needs, as far as possible. Raises UsageError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    if hard != resource.RLIM_INFINITY and hard < FEWEST_DESCRIPTORS:
        raise UsageError(f"this process may open {hard} files, a server needs {FEWEST_DESCRIPTORS}: raise 'ulimit -n'")
    if hard != resource.RLIM_INFINITY and hard < DESCRIPTORS:
        logger.warning(
            "this process may open %d files: it takes about %d connections at once, others wait", hard, hard - 64
        )
