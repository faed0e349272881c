"""Paced load: robots that ask at a fixed rate, whose latency counts from when each should have asked.

A generator that waits for an answer before it asks again asks a slow server less, and hides what a robot would have
waited ("coordinated omission"). Here a robot whose answer is late asks at once when it has come, and the wait counts.
"""

from __future__ import annotations

import heapq
import queue
import random
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from speed.loads import INFER, Load, LoadError, RefusedError, WebSocketLine, infer_request
from speed.servers import Exchange

SETTLE_S = 1.0  # before answers count
CONNECT_S = 0.003  # for each robot; ours ends a connection that asks nothing for 5 s, also while the others connect


class Robot:
    """One connection with a request for every period."""

    def __init__(
        self, connection: socket.socket, request: bytes, is_whole: Callable[[bytes], bool], due: float
    ) -> None:
        self.connection = connection
        self.connection.setblocking(False)
        self.due = due
        self.is_waiting = False
        self._request, self._is_whole, self._held = request, is_whole, b""

    def ask(self) -> None:
        self.is_waiting = True
        if self.connection.send(self._request) != len(self._request):
            raise LoadError("a request did not fit a socket's buffer")

    def read(self) -> bool:
        """Read what has come; return whether the answer is whole."""
        piece = self.connection.recv(65536)
        if not piece:
            raise LoadError("the server closed a connection")
        self._held += piece
        if not self._is_whole(self._held):
            return False
        self._held, self.is_waiting = b"", False
        return True


def http_robot(port: int, exchange: Exchange, due: float) -> Robot:
    """Return a robot that asks over HTTP."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=30)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    headers = "".join(f"{name}: {value}\r\n" for name, value in exchange.headers)
    head = f"{exchange.method} {exchange.path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{headers}"
    request = f"{head}Content-Length: {len(exchange.body)}\r\n\r\n".encode() + exchange.body

    def is_whole(held: bytes) -> bool:
        head, ended, body = held.partition(b"\r\n\r\n")
        if not ended:
            return False
        if head.startswith(b"HTTP/1.1 503"):
            raise RefusedError("the server has too much to do")
        if not head.startswith(b"HTTP/1.1 200"):
            raise LoadError(f"the server answered {held[:300]!r}")
        length = int(head.lower().partition(b"content-length:")[2].partition(b"\r")[0])
        return len(body) >= length

    return Robot(connection, request, is_whole, due)


def stream_robot(port: int, path: str, message: bytes, greets: bool, due: float) -> Robot:
    """Return a robot that asks over a WebSocket, whose answers are below 64 KB."""
    line = WebSocketLine(port, path, message, greets=greets)

    def is_whole(held: bytes) -> bool:
        if len(held) < 4:
            return False
        length, start = held[1] & 0x7F, 2
        if length == 126:
            length, start = int.from_bytes(held[2:4], "big"), 4
        if held[0] & 0x0F != 2:
            raise LoadError(f"the server sent a frame of kind {held[0] & 0x0F}: {held[:300]!r}")
        return len(held) >= start + length

    return Robot(line.connection, line.frame, is_whole, due)


def paced(make: Callable[[float], Robot], *, robots: int, rate_hz: float, seconds: float) -> Load:
    """Let so many robots ask at the rate, each at a phase of its own. Raises LoadError."""
    period, began = 1 / rate_hz, time.perf_counter() + 0.1 + CONNECT_S * robots
    fleet = [make(began + random.random() * period) for _ in range(robots)]
    by_socket = {robot.connection: robot for robot in fleet}
    taken: list[float] = []
    until, counted = began + SETTLE_S + seconds, began + SETTLE_S
    began_cpu = time.process_time()
    try:
        while (now := time.perf_counter()) < until:
            for robot in fleet:
                if not robot.is_waiting and robot.due <= now:
                    robot.ask()
            soonest = min((robot.due for robot in fleet if not robot.is_waiting), default=until)
            # select, since poll and epoll round up to milliseconds.
            ready, _, _ = select.select(by_socket, (), (), max(0.0, min(soonest, until) - time.perf_counter()))
            for connection in ready:
                robot = by_socket[connection]
                if robot.read():
                    at = time.perf_counter()
                    if at >= counted:
                        taken.append(at - robot.due)
                    robot.due += period
    finally:
        for robot in fleet:
            robot.connection.close()
    return _load(taken, period, seconds, began_cpu)


def paced_calls(
    port: int, model: str, obs: NDArray[np.float32], *, robots: int, rate_hz: float, seconds: float
) -> Load:
    """Let robots ask over gRPC, each on a connection of its own. Raises LoadError."""
    import grpc

    period, request = 1 / rate_hz, infer_request(model, obs)
    # A subchannel of its own is a connection of its own.
    channels = [
        grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)]) for _ in range(robots)
    ]
    calls: list[Any] = [channel.unary_unary(INFER) for channel in channels]
    answered: queue.SimpleQueue[tuple[float, int, Any]] = queue.SimpleQueue()
    try:
        for call in calls:
            call(request, timeout=30)  # connects
        began, began_cpu = time.perf_counter(), time.process_time()
        until, counted = began + SETTLE_S + seconds, began + SETTLE_S
        waiting = [(began + random.random() * period, number) for number in range(robots)]
        heapq.heapify(waiting)
        due_of = dict.fromkeys(range(robots), 0.0)
        taken: list[float] = []

        def ask(number: int) -> None:
            future = calls[number].future(request, timeout=30)
            future.add_done_callback(lambda done: answered.put((time.perf_counter(), number, done)))

        while (now := time.perf_counter()) < until:
            while waiting and waiting[0][0] <= now:
                due, number = heapq.heappop(waiting)
                due_of[number] = due
                ask(number)
            soonest = min(waiting[0][0], until) if waiting else until
            with suppress(queue.Empty):
                at, number, done = answered.get(timeout=max(0.0, soonest - time.perf_counter()))
                if done.exception() is not None:
                    raise LoadError(f"gRPC: {done.exception()}")
                if at >= counted:
                    taken.append(at - due_of[number])
                heapq.heappush(waiting, (due_of[number] + period, number))
    except grpc.RpcError as error:
        raise LoadError(f"gRPC: {error}") from None
    finally:
        for channel in channels:
            channel.close()
    return _load(taken, period, seconds, began_cpu)


def _load(taken: list[float], period: float, seconds: float, began_cpu: float) -> Load:
    if not taken:
        raise LoadError(f"nothing was answered within {seconds:g} s")
    p50, p99, p999 = (float(value) * 1e3 for value in np.percentile(taken, (50, 99, 99.9)))
    late = float(np.mean(np.array(taken) > period / 2))
    cpu_s = time.process_time() - began_cpu
    return Load(p50, p99, len(taken) / seconds, len(taken), seconds, cpu_s, p999, late)
