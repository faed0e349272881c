"""robo-gym's server manager without ROS: starts robot servers, each a process of its own, and ends them all."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable
from concurrent import futures
from typing import Any

import grpc

from rlservo.envs.robot_server.launch_line import parse_launch_line
from rlservo.envs.robot_server.robo_gym_messages import SERVER_MANAGER, ManagerStatus, ServerRequest
from rlservo.envs.robot_server.robot_server import OPTIONS, PortInUseError, arrives, bind, stop_signals
from rlservo.envs.robot_server.robot_server_process import ServerProcess
from rlservo.envs.robot_server.robot_server_settings import PandaSettings, Settings, URSettings
from rlservo.envs.robot_server.robots.robot import CLOCKS
from rlservo.envs.robot_server.rpc_handler import rpc_handler

MANAGER_PORTS = range(50100, 50200)  # robo-gym's clients look for a manager here, in this order
MAX_SERVERS = 100
ORPHAN_S = 120.0  # [s] without any connection, after which a robot server ends itself
WATCH_INTERVAL_S = 0.2
THREADS = 32

log = logging.getLogger("rlservo.server_manager")


class RobotServers:
    """The robot servers of one manager, by port. A thread watches them; `close` ends them all."""

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        clock: str = "fast",
        max_servers: int = MAX_SERVERS,
        orphan_s: float | None = ORPHAN_S,
    ) -> None:
        if clock not in CLOCKS:
            raise ValueError(f"clock {clock!r} does not exist: expected one of {', '.join(CLOCKS)}")
        self._host, self._clock, self._max_servers, self._orphan_s = host, clock, max_servers, orphan_s
        self._lock = threading.Lock()
        self._running: dict[int, ServerProcess] = {}
        self._starting = 0
        # Ports of servers that ended without a `kill` of their own: they crashed, or everything was killed. A client
        # kills its own before it starts another, tries ten times, and fails if that does not succeed (robo-gym 2.0.1).
        self._dead_ports: set[int] = set()
        self._closing = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="watch-robot-servers", daemon=True)
        self._watcher.start()

    @property
    def running(self) -> dict[int, int]:
        """Port and process id of every robot server."""
        with self._lock:
            return {port: server.pid for port, server in self._running.items()}

    def start(self, line: str, *, gui: bool = False) -> int:
        """Start the robot server of a roslaunch line and return its port, once it answers.

        Raises ValueError for an impossible line, for too many servers, and when it does not come up.
        """
        settings = parse_launch_line(line, gui=gui, clock=self._clock, host=self._host)
        with self._lock:
            if self._closing.is_set():
                raise ValueError("this server manager is shutting down")
            if len(self._running) + self._starting >= self._max_servers:
                raise ValueError(f"{self._max_servers} robot servers are running, which is this manager's limit")
            self._starting += 1
        try:
            server = self._start_off_the_managers_ports(settings)
        except OSError as error:
            raise ValueError(f"the robot server's process could not be started: {error}") from error
        finally:
            with self._lock:
                self._starting -= 1
        with self._lock:
            if not self._closing.is_set():
                self._dead_ports.discard(server.port)
                self._running[server.port] = server
                log.info("%s on port %d (process %d)", _title(settings), server.port, server.pid)
                return server.port
        server.end()
        raise ValueError("this server manager is shutting down")

    def kill(self, port: int) -> None:
        """End the robot server on `port`; one that has ended already is no error. Raises ValueError for other ports."""
        with self._lock:
            server = self._running.pop(port, None)
            has_ended = port in self._dead_ports
            self._dead_ports.discard(port)
            ports = ", ".join(str(number) for number in sorted(self._running)) or "none"
        if server is not None:
            server.end()
            log.info("%s on port %d ended", _title(server.settings), port)
        elif not has_ended:
            raise ValueError(f"there is no robot server on port {port}; running: {ports}")

    def kill_all(self) -> None:
        """End all robot servers in parallel."""
        with self._lock:
            servers = list(self._running.values())
            self._dead_ports.update(self._running)
            self._running.clear()
        if servers:
            with futures.ThreadPoolExecutor(len(servers)) as pool:
                list(pool.map(ServerProcess.end, servers))
            log.info("%d robot servers ended", len(servers))

    def close(self) -> None:
        """End everything and start nothing more."""
        with self._lock:
            self._closing.set()
        self._watcher.join()
        self.kill_all()

    def _start_off_the_managers_ports(self, settings: Settings) -> ServerProcess:
        """Start a server; start it again if the system gave it a port that it must not have.

        Clients look for a manager on some ports; on others a former server's last client may still ask for its end.
        """
        rejects: list[ServerProcess] = []
        try:
            while True:
                server = ServerProcess(settings, orphan_s=self._orphan_s)
                if settings.port or not (server.port in MANAGER_PORTS or server.port in self._dead_ports):
                    return server
                rejects.append(server)  # ended only after the next has a port, or that would be the same one
        finally:
            for server in rejects:
                server.end()

    def _watch(self) -> None:
        while not self._closing.wait(WATCH_INTERVAL_S):
            with self._lock:
                exits = [(port, server) for port, server in self._running.items() if server.exit_code is not None]
                for port, _ in exits:
                    del self._running[port]
                    self._dead_ports.add(port)
            for port, server in exits:
                server.kill()  # collects the process and its pipes
                log.warning(
                    "%s on port %d exited unexpectedly: %s", _title(server.settings), port, _why(server.exit_code)
                )


class ManagerService:
    """The four calls of robo-gym's ServerManager."""

    def __init__(self, servers: RobotServers) -> None:
        self._servers = servers

    def handler(self) -> grpc.GenericRpcHandler:
        """Return the handler for a gRPC server."""
        calls: dict[str, Callable[[bytes], Any]] = {
            "StartNewServer": self._start,
            "KillServer": self._kill,
            "KillAllServers": self._kill_all,
            "VerifyConnection": lambda _: ManagerStatus(alive=True),
        }
        return rpc_handler(SERVER_MANAGER, calls, lambda _name, reason: ServerRequest(success=False, info=reason), log)

    def _start(self, request: bytes) -> Any:
        message = ServerRequest.FromString(request)
        return ServerRequest(success=True, port=self._servers.start(message.cmd, gui=message.gui))

    def _kill(self, request: bytes) -> Any:
        self._servers.kill(ServerRequest.FromString(request).port)
        return ServerRequest(success=True)

    def _kill_all(self, request: bytes) -> Any:
        ServerRequest.FromString(request)
        self._servers.kill_all()
        return ServerRequest(success=True)


class ServerManager:
    """A bound and started manager; `close` ends it and every robot server."""

    def __init__(self, *, host: str = "127.0.0.1", port: int | None = None, servers: RobotServers) -> None:
        self.servers = servers
        self._server = grpc.server(futures.ThreadPoolExecutor(THREADS, "server-manager"), options=OPTIONS)
        self._server.add_generic_rpc_handlers((ManagerService(servers).handler(),))
        self.port = _bind_first(self._server, host, MANAGER_PORTS if port is None else (port,))
        self._server.start()

    def close(self) -> None:
        """End everything."""
        self._server.stop(grace=None)
        self.servers.close()


def serve_manager(
    *,
    host: str,
    port: int | None,
    clock: str,
    max_servers: int,
    orphan_s: float | None,
    on_ready: Callable[[int], None],
) -> None:
    """Run a manager until SIGTERM or SIGINT; nothing is left running. Main thread only."""
    signals = stop_signals()
    servers = RobotServers(host=host, clock=clock, max_servers=max_servers, orphan_s=orphan_s)
    try:
        manager = ServerManager(host=host, port=port, servers=servers)
    except BaseException:
        servers.close()
        raise
    try:
        on_ready(manager.port)
        arrives(signals)
    finally:
        manager.close()


def _bind_first(server: grpc.Server, host: str, ports: range | tuple[int, ...]) -> int:
    for port in ports:
        try:
            return bind(server, host, port)
        except PortInUseError:
            if len(ports) == 1:
                raise
    raise PortInUseError(
        f"every port from {ports[0]} to {ports[-1]} on {host} is taken: stop another manager, or give a port "
        "(robo-gym's clients look for a manager on these)"
    )


def _title(settings: Settings) -> str:
    if isinstance(settings, URSettings):
        return f"robot server {settings.ur_model}"
    return f"robot server {'panda' if isinstance(settings, PandaSettings) else 'mir100'}"


def _why(exit_code: int | None) -> str:
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    return f"killed by {signal.Signals(-exit_code).name}"
