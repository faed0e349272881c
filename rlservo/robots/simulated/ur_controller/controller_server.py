"""Ports of the simulated controller, its clock, and faults of its link.

One loop in one thread serves sockets until a control cycle is due, then runs the cycle, by the wall clock. If the
machine delays the loop, the cycles are caught up at once, and the watchdog does not blame the client for the delay.
"""

from __future__ import annotations

import errno
import heapq
import logging
import math
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rlservo.robots.simulated.ur_controller import dashboard
from rlservo.robots.simulated.ur_controller.control_script import load_program
from rlservo.robots.simulated.ur_controller.controller import Controller
from rlservo.robots.simulated.ur_controller.primary import kinematics_package
from rlservo.robots.simulated.ur_controller.rtde import RtdeSession

DASHBOARD, PRIMARY, SECONDARY, REAL_TIME, RTDE = 29999, 30001, 30002, 30003, 30004
PORTS = (DASHBOARD, PRIMARY, SECONDARY, REAL_TIME, RTDE)  # clients cannot ask for other ports
LONGEST_CATCH_UP_S = 2.0  # [s] of cycles that a delayed loop catches up
HELD_UP_S = 0.02  # [s], delay after which its client's commands wait in the socket
LARGEST_BACKLOG = 64 * 1024  # [bytes] buffered for a client that does not read; beyond it samples are dropped
LARGEST_PROGRAM = 4 * 1024 * 1024
PROGRAM_END = b"\nend\n"

log = logging.getLogger("rlservo.ur_controller")


class CannotListenError(OSError):
    """The controller cannot listen on one of its ports; the message names the port and the reason."""


@dataclass
class LinkFaults:
    """Faults of the network between client and controller, in each direction."""

    latency_s: float = 0.0
    jitter_s: float = 0.0  # at most this much more, uniformly; in order, as with TCP
    drop: float = 0.0  # share of RTDE's data packages, both ways
    is_down: bool = False


@dataclass
class _Connection:
    port: int
    socket: socket.socket
    rtde: RtdeSession | None = None
    text: bytes = b""
    unsent: bytes = b""
    last_due: dict[str, float] = field(default_factory=lambda: {"in": 0.0, "out": 0.0})


class ControllerServer:
    """A controller that listens; `serve` runs it, `close` frees the ports."""

    def __init__(
        self, controller: Controller, *, host: str = "127.0.0.1", link: LinkFaults | None = None, seed: int = 0
    ) -> None:
        self.controller = controller
        self.link = link or LinkFaults()
        self.host = host
        self._rng = np.random.default_rng(seed)
        self._in_use: dict[str, RtdeSession] = {}
        self._connections: dict[socket.socket, _Connection] = {}
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []  # data delayed by the link, by due time
        self._count = 0
        self._asked: list[Callable[[], object]] = []
        self._listeners: dict[socket.socket, int] = {}
        try:
            for port in PORTS:
                self._listeners[_listen(host, port)] = port
        except OSError:
            self.close()
            raise

    def do(self, action: Callable[[], object]) -> None:
        """Run a function between two control cycles; callable from any thread."""
        self._asked.append(action)

    def serve(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        due = before = time.perf_counter()
        while not stop.is_set():
            now = time.perf_counter()
            if now < due:
                next_due = min(due, self._waiting[0][0]) if self._waiting else due
                self._pass_traffic(max(0.0, next_due - now))
                continue
            behind_s, since_s, before = now - due, now - before, now
            if behind_s > HELD_UP_S:  # a cycle that is caught up takes no time, so a client's silence in it is no fault
                self.controller.excuse(max(0.0, self.controller.dt - since_s))
            # Commands that wait for caught-up cycles are taken one per cycle: all at once they would be a jump.
            is_made_good = self.controller.dt < behind_s < LONGEST_CATCH_UP_S
            for connection in self._connections.values():
                if connection.rtde is not None:
                    connection.rtde.allowance = 1.0 if is_made_good else math.inf
            due = max(due + self.controller.dt, now - LONGEST_CATCH_UP_S)
            self._pass_traffic(0.0)
            asked, self._asked = self._asked, []
            for action in asked:
                action()
            self.controller.tick()
            self._publish()

    def close(self) -> None:
        """Close all connections and ports."""
        for opened in (*self._connections, *self._listeners):
            opened.close()
        self._connections.clear()
        self._listeners.clear()

    # -- traffic

    def _pass_traffic(self, timeout_s: float) -> None:
        """Wait for sockets at most this long, and deliver data whose delay is over."""
        readers = [] if self.link.is_down else [*self._listeners, *self._connections]
        ready, _, _ = select.select(readers, [], [], timeout_s)
        for each in ready:
            if each in self._listeners:
                self._accept(each)
            elif each in self._connections:
                self._read(self._connections[each])
        for connection in [one for one in self._connections.values() if one.rtde is not None and one.rtde.is_behind]:
            self._take(connection, b"")
        now = time.perf_counter()
        while self._waiting and self._waiting[0][0] <= now and not self.link.is_down:
            heapq.heappop(self._waiting)[2]()

    def _accept(self, listener: socket.socket) -> None:
        opened, _ = listener.accept()
        opened.setblocking(False)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = _Connection(self._listeners[listener], opened)
        if connection.port == RTDE:
            connection.rtde = RtdeSession(self.controller, self._in_use)
        self._connections[opened] = connection
        if connection.port == DASHBOARD:
            self._send(connection, f"{dashboard.GREETING}\n".encode())
        if connection.port == PRIMARY:
            self._send(connection, kinematics_package(self.controller))

    def _read(self, connection: _Connection) -> None:
        try:
            data = connection.socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
        else:
            self._delay(connection, "in", lambda: self._take(connection, data))

    def _take(self, connection: _Connection, data: bytes) -> None:
        if connection.rtde is not None:
            if self.link.drop and data[2:3] == b"U" and self._rng.random() < self.link.drop:
                return
            try:
                replies = connection.rtde.receive(data)
            except (ValueError, IndexError) as error:
                log.warning("an RTDE client was disconnected: %s", error)
                self._drop(connection)
                return
            if replies:
                self._send(connection, replies)
            return
        connection.text += data
        if connection.port == DASHBOARD:
            *lines, connection.text = connection.text.split(b"\n")
            for line in lines:
                reply = dashboard.answer(self.controller, line.decode(errors="replace"))
                self._send(connection, f"{reply}\n".encode())
                if reply == dashboard.GOODBYE:
                    self._delay(connection, "out", lambda: self._drop(connection))
        elif connection.text.endswith(PROGRAM_END) or (
            not connection.text.startswith(b"def ") and connection.text.endswith(b"\n")
        ):
            text, connection.text = connection.text.decode(errors="replace"), b""
            load_program(self.controller, text)
        if len(connection.text) > LARGEST_PROGRAM:
            log.warning("a client of port %d was disconnected: more than %d bytes", connection.port, LARGEST_PROGRAM)
            self._drop(connection)

    def _publish(self) -> None:
        for connection in [one for one in self._connections.values() if one.rtde is not None]:
            if connection.rtde is None or len(connection.unsent) > LARGEST_BACKLOG:
                self._write(connection, b"")
                continue
            package = connection.rtde.sample()
            if package and not (self.link.drop and self._rng.random() < self.link.drop):
                self._send(connection, package)
            elif connection.unsent:
                self._write(connection, b"")

    def _send(self, connection: _Connection, data: bytes) -> None:
        self._delay(connection, "out", lambda: self._write(connection, data))

    def _delay(self, connection: _Connection, way: str, deliver: Callable[[], None]) -> None:
        link = self.link
        if not (link.latency_s or link.jitter_s or link.is_down or self._waiting):
            deliver()
            return
        now = time.perf_counter()
        due = max(now + link.latency_s + link.jitter_s * self._rng.random(), connection.last_due[way])
        connection.last_due[way] = due
        self._count += 1
        heapq.heappush(self._waiting, (due, self._count, deliver))

    def _write(self, connection: _Connection, data: bytes) -> None:
        connection.unsent += data
        try:
            sent = connection.socket.send(connection.unsent)
            connection.unsent = connection.unsent[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(connection)

    def _drop(self, connection: _Connection) -> None:
        if connection.rtde is not None:
            connection.rtde.close()
        self._connections.pop(connection.socket, None)
        connection.socket.close()


def _listen(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()
    except OSError as error:
        listener.close()
        is_taken = error.errno == errno.EADDRINUSE
        reason = "the port is in use; another address such as 127.0.0.2 has its own ports" if is_taken else str(error)
        raise CannotListenError(f"cannot listen on {host}:{port}: {reason}") from error
    return listener
