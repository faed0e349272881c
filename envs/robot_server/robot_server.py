"""One robot server: the robot, a bound port, and service until it is stopped.

`rlservo robot-server` runs it in the foreground. The server manager runs it as a process of its own
(`python -m rlservo.envs.robot_server.robot_server '<settings>'`), which prints its port on standard output, and ends
when its standard input does: nothing outlives the manager, whatever becomes of it.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import queue
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent import futures

import grpc

from rlservo.envs.robot_server.clock import Clock
from rlservo.envs.robot_server.connections import count_connections
from rlservo.envs.robot_server.robot_server_settings import PandaSettings, Settings, URSettings, settings_from_json
from rlservo.envs.robot_server.robots.robot import ServedRobot
from rlservo.envs.robot_server.service import RobotService

THREADS = 8  # calls at a time; one of them moves the robot
OPTIONS = [("grpc.so_reuseport", 0)]  # gRPC's default lets two servers share a port, and clients meet either
WATCH_INTERVAL_S = 2.0
READY = "ready on port "  # a manager waits for this on standard output
FAILED = "failed: "  # or this, and the reason

log = logging.getLogger("rlservo.robot_server")


class ServerAddressError(OSError):
    """The server cannot listen on the address; the message gives the reason."""


class PortInUseError(ServerAddressError):
    """The requested port is taken."""


class RobotServer:
    """A bound and started server; `stop` ends it."""

    def __init__(self, settings: Settings) -> None:
        self.robot = make_robot(settings)
        clock = "fast" if self.robot.is_real else settings.clock  # a real robot's cycles last as long as they do
        self.service = RobotService(self.robot, Clock(clock, self.robot.cycle_s), gui=settings.gui)
        self._server = grpc.server(futures.ThreadPoolExecutor(THREADS, "robot-server"), options=OPTIONS)
        self._server.add_generic_rpc_handlers((self.service.handler(),))
        self.port = bind(self._server, settings.host, settings.port)
        self._server.start()

    def stop(self) -> None:
        """Refuse new calls, abort those that run longer than a tenth of a second, and free the port."""
        self._server.stop(grace=0.1).wait(timeout=1.0)
        self.robot.close()


def make_robot(settings: Settings) -> ServedRobot:
    """Return the robot that the settings describe. MuJoCo is imported here: a manager does without it."""
    if isinstance(settings, URSettings):
        from rlservo.envs.robot_server.robots.ur import URRobot

        return URRobot(settings)
    if isinstance(settings, PandaSettings):
        from rlservo.envs.robot_server.robots.panda import PandaRobot

        return PandaRobot(settings)
    from rlservo.envs.robot_server.robots.mir100 import Mir100Robot

    return Mir100Robot(settings)


def bind(server: grpc.Server, host: str, port: int) -> int:
    """Bind a gRPC server and return the port it has.

    Raises PortInUseError when the port is taken, ServerAddressError for everything else; both name the cause.
    """
    address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    _probe(host, port, address)  # gRPC names no reason, and writes several lines to standard error
    try:
        return int(server.add_insecure_port(address))
    except RuntimeError as error:
        _probe(host, port, address)  # a resource may still be missing: a file descriptor, say
        if port:
            raise PortInUseError(f"cannot listen on {address}: the port is taken") from error
        raise ServerAddressError(f"cannot listen on {address}: gRPC failed without a reason") from error


def _probe(host: str, port: int, address: str) -> None:
    try:
        family, kind, protocol, _, resolved = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(resolved)
    except (OSError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) and not isinstance(error, socket.gaierror) else None
        if number == errno.EADDRINUSE and port:
            raise PortInUseError(f"cannot listen on {address}: the port is taken") from error
        reasons = {
            errno.EADDRINUSE: "no port is free",
            errno.EADDRNOTAVAIL: "the address is not this machine's",
            errno.EACCES: "ports below 1024 are for root",
        }
        reason = reasons.get(number or 0) or getattr(error, "strerror", None) or str(error)
        raise ServerAddressError(f"cannot listen on {address}: {reason}") from error


def stop_signals() -> queue.SimpleQueue[int]:
    """Return an object that receives SIGTERM and SIGINT from now on. Main thread only.

    Not an Event: `set` in a handler waits indefinitely when the signal interrupts its own thread inside `wait`,
    which holds the lock. A SimpleQueue's `put` may interrupt its `get`.
    """
    arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _frame: arrived.put(number))
    return arrived


def arrives(signals: queue.SimpleQueue[int], timeout_s: float | None = None) -> bool:
    """Wait for a signal, indefinitely without a time; return whether one has come.

    An endless wait is split into long ones: a signal that comes just before it begins, or to another thread, interrupts
    nothing, and its handler would not run until something did.
    """
    while True:
        try:
            signals.get(timeout=WATCH_INTERVAL_S if timeout_s is None else timeout_s)
            return True
        except queue.Empty:
            if timeout_s is not None:
                return False


def serve_robot(settings: Settings, *, on_ready: Callable[[int], None], orphan_s: float | None = None) -> None:
    """Serve until SIGTERM or SIGINT, or until no client has been connected for `orphan_s` seconds. Main thread only.

    A server that was never called waits no longer than one whose client left: robo-gym's environments connect at their
    first `reset`, and one that is made and never reset must not keep a simulator.
    """
    signals = stop_signals()
    server = RobotServer(settings)
    try:
        on_ready(server.port)
        alone_since = time.monotonic()
        while not arrives(signals, WATCH_INTERVAL_S if orphan_s is not None else None):
            if count_connections(server.port) != 0:
                alone_since = time.monotonic()
                continue
            if orphan_s is not None and time.monotonic() - alone_since > orphan_s:
                log.warning("no client for %g s: shutting down", orphan_s)
                return
    finally:
        server.stop()


def main(argv: list[str]) -> None:
    """Be the robot server of a manager; see this file's docstring."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    threading.Thread(target=_end_with_standard_input, name="lifeline", daemon=True).start()
    settings = settings_from_json(argv[0])
    orphan_s = float(argv[1]) if len(argv) > 1 else None

    def ready(port: int) -> None:
        _say(f"{READY}{port}")
        # The pipe is no longer read: later prints of libraries are discarded instead of filling it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    try:
        serve_robot(settings, on_ready=ready, orphan_s=orphan_s)
    except (ServerAddressError, ValueError) as error:
        _say(f"{FAILED}{error}")
        raise SystemExit(1) from None


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _end_with_standard_input() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    os._exit(0)  # the manager is gone; a simulator has nothing to save


if __name__ == "__main__":
    main(sys.argv[1:])
