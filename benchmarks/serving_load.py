"""Load for one server, in a process of its own: requests one after the other, robots at a fixed rate, a WebSocket.

    python benchmarks/serving_load.py PLAN

`PLAN` is a `Plan` as JSON. Prints a `Result` as JSON. Raw sockets: an HTTP library would take longer than the server.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import re
import socket
import struct
import sys
import time
from dataclasses import asdict, dataclass, field

import numpy as np

LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.I)
REPLY_S = 20.0  # [s] for one reply; a server that takes longer has failed
WARM_UP_S = 0.3


@dataclass(frozen=True)
class Plan:
    port: int
    request: str  # base64: a whole HTTP request, or for a WebSocket one message
    seconds: float
    connections: int = 1
    rate_hz: float = 0.0  # of each robot; 0: the next request follows the reply
    stream: str = ""  # path of a WebSocket
    greets: bool = False  # the WebSocket's server sends a message first


@dataclass
class Result:
    """Answered requests, and milliseconds from a request to its reply."""

    requests: int = 0
    per_second: float = 0.0
    p50: float = 0.0
    p99: float = 0.0
    p999: float = 0.0
    failed: int = 0  # replies other than 200, and connections that broke
    skipped: int = 0  # ticks of robots whose last reply had not come yet


@dataclass
class Times:
    """Durations of the requests after the warm-up [s]."""

    starts_at: float
    ends_at: float
    durations: list[float] = field(default_factory=list)
    failed: int = 0
    skipped: int = 0

    def add(self, began: float, ended: float) -> None:
        if self.starts_at <= began and ended <= self.ends_at:
            self.durations.append(ended - began)

    def result(self) -> Result:
        if not self.durations:
            return Result(failed=self.failed or 1, skipped=self.skipped)
        p50, p99, p999 = (round(1e3 * float(v), 4) for v in np.percentile(self.durations, (50, 99, 99.9)))
        rate = len(self.durations) / (self.ends_at - self.starts_at)
        return Result(len(self.durations), round(rate, 1), p50, p99, p999, self.failed, self.skipped)


def end_of_reply(data: bytes | bytearray) -> int:
    """Return the length of the reply that `data` begins with, 0 while it is not complete."""
    head = data.find(b"\r\n\r\n")
    if head < 0:
        return 0
    length = LENGTH.search(data, 0, head)
    if length is not None:
        end = head + 4 + int(length[1])
        return end if len(data) >= end else 0
    return len(data) if data.endswith(b"0\r\n\r\n") else 0  # chunked: one reply at a time


class Robot(asyncio.Protocol):
    """A connection that sends requests at its rate, or as soon as it is answered."""

    def __init__(self, request: bytes, times: Times, period_s: float, offset_s: float) -> None:
        self._request, self._times, self._period_s = request, times, period_s
        self._offset_s = offset_s
        self._buffer = bytearray()
        self._began = 0.0  # 0: no request is pending
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport) or hasattr(transport, "write")
        self._transport: asyncio.Transport = transport  # type: ignore[assignment]  # uvloop's is not a subclass
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._loop = asyncio.get_running_loop()
        if self._period_s:
            self._next = self._loop.time() + self._offset_s
            self._timer = self._loop.call_at(self._next, self._tick)
        else:
            self._ask()

    def _tick(self) -> None:
        self._next += self._period_s
        self._timer = self._loop.call_at(self._next, self._tick)
        if self._began:
            self._times.skipped += 1
        else:
            self._ask()

    def _ask(self) -> None:
        self._began = time.perf_counter()
        self._transport.write(self._request)

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        end = end_of_reply(self._buffer)
        if not end:
            return
        now = time.perf_counter()
        self._times.failed += not self._buffer.startswith(b"HTTP/1.1 200")
        self._times.add(self._began, now)
        del self._buffer[:end]
        self._began = 0.0
        if not self._period_s and now < self._times.ends_at:
            self._ask()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        self._times.failed += time.perf_counter() < self._times.ends_at
        if self._timer is not None:
            self._timer.cancel()


async def ask_by_robots(plan: Plan, request: bytes, times: Times) -> None:
    """Run all connections until the end."""
    loop, period = asyncio.get_running_loop(), 1 / plan.rate_hz if plan.rate_hz else 0.0
    made = []
    for number in range(plan.connections):
        robot = Robot(request, times, period, period * number / plan.connections)
        made.append((await loop.create_connection(lambda robot=robot: robot, "127.0.0.1", plan.port))[0])  # type: ignore[misc]
    await asyncio.sleep(max(0.0, times.ends_at - time.perf_counter()) + 0.05)
    for transport in made:
        transport.abort()


def ask_one_by_one(plan: Plan, request: bytes, times: Times) -> None:
    """Run one connection without an event loop, whose overhead would count."""
    with connect(plan.port) as connection:
        while (began := time.perf_counter()) < times.ends_at:
            connection.sendall(request)
            reply = connection.recv(65536)
            while not end_of_reply(reply):
                reply += receive(connection)
            times.add(began, time.perf_counter())
            times.failed += not reply.startswith(b"HTTP/1.1 200")


def stream(plan: Plan, message: bytes, times: Times) -> None:
    key, mask = base64.b64encode(os.urandom(16)).decode(), os.urandom(4)
    repeated = np.frombuffer((mask * (len(message) // 4 + 1))[: len(message)], np.uint8)
    payload = (np.frombuffer(message, np.uint8) ^ repeated).tobytes()
    size = bytes([0x80 | len(message)]) if len(message) < 126 else b"\xfe" + struct.pack(">H", len(message))
    frame = b"\x82" + size + mask + payload
    with connect(plan.port) as connection:
        connection.sendall(
            f"GET {plan.stream} HTTP/1.1\r\nHost: 127.0.0.1:{plan.port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        data = b""
        while b"\r\n\r\n" not in data:
            data += receive(connection)
        if not data.startswith(b"HTTP/1.1 101"):
            raise ConnectionError(data[:80])
        data = data.partition(b"\r\n\r\n")[2]
        if plan.greets:
            data = next_frame(connection, data)
        while (began := time.perf_counter()) < times.ends_at:
            connection.sendall(frame)
            data = next_frame(connection, data)
            times.add(began, time.perf_counter())


def next_frame(connection: socket.socket, data: bytes) -> bytes:
    """Read one binary frame; return the bytes after it."""
    while len(data) < 4:
        data += receive(connection)
    if data[0] != 0x82:
        raise ConnectionError(f"a frame of kind {data[0]:#x}: {data[:200]!r}")
    size, start = data[1], 2
    if size == 126:
        size, start = struct.unpack(">H", data[2:4])[0], 4
    while len(data) < start + size:
        data += receive(connection)
    return data[start + size :]


def connect(port: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=REPLY_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def receive(connection: socket.socket) -> bytes:
    data = connection.recv(65536)
    if not data:
        raise ConnectionResetError("closed by the server")
    return data


def measure(plan: Plan) -> Result:
    begin = time.perf_counter() + WARM_UP_S
    times, content = Times(begin, begin + plan.seconds), base64.b64decode(plan.request)
    with contextlib.suppress(OSError):  # replies until then count, and the failure
        if plan.stream:
            stream(plan, content, times)
        elif plan.connections == 1 and not plan.rate_hz:
            ask_one_by_one(plan, content, times)
        else:
            import uvloop

            uvloop.run(ask_by_robots(plan, content, times))
        return times.result()
    times.failed += 1
    return times.result()


if __name__ == "__main__":
    print(json.dumps(asdict(measure(Plan(**json.loads(sys.argv[1]))))))
