"""The load: requests prepared beforehand, sent again and again, so that the client costs next to nothing.

HTTP goes through wrk. `Line` is the same idea in Python for what wrk does not speak: a socket, the bytes to send, and
the least reading that tells where an answer ends. Ratios between protocols are taken between lines, ratios between
servers from wrk.
"""

from __future__ import annotations

import base64
import os
import re
import resource
import socket
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from speed.servers import Exchange

Call = Callable[[], object]
UNITS_MS = {"us": 1e-3, "ms": 1.0, "s": 1e3}
WARM_UP = 30  # calls before a round counts
POLITE = (b"\x03\xe9", b"\x03\xf4")
INFER = "/inference.GRPCInferenceService/ModelInfer"


@dataclass(frozen=True)
class Load:
    """What one round of a load gave."""

    p50_ms: float
    p99_ms: float
    per_s: float
    count: int
    seconds: float
    generator_cpu_s: float
    p999_ms: float | None = None  # of a paced load, as the next one
    late: float | None = None  # share of the answers later than half a period


class LoadError(Exception):
    """A server that answered something else than asked for."""


class RefusedError(LoadError):
    """A server that says it has too much to do."""


class ClosedError(LoadError):
    """A server that closed a kept connection."""


class PoliteError(ClosedError):
    """A server that said why it closes a stream: going away (1001) or restarting (1012), RFC 6455 and its registry."""


def wrk(port: int, exchange: Exchange, folder: Path, *, connections: int, seconds: int) -> Load:
    """Send the exchange over so many connections. Raises LoadError unless every answer is a success."""
    script, body = folder / f"{port}.lua", folder / f"{port}.body"
    body.write_bytes(exchange.body)
    headers = "".join(f'wrk.headers["{name}"] = "{value}"\n' for name, value in exchange.headers)
    script.write_text(
        f'wrk.method = "{exchange.method}"\nlocal file = io.open("{body}", "rb")\nwrk.body = file:read("*a")\n{headers}'
    )
    url = f"http://127.0.0.1:{port}{exchange.path}"
    command = [
        "wrk",
        "-t1",
        f"-c{connections}",
        f"-d{seconds}s",
        "--latency",
        "--timeout",
        "10s",
        "-s",
        str(script),
        url,
    ]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0 or "Non-2xx" in done.stdout or "Socket errors" in done.stdout:
        raise LoadError(f"port {port} failed under wrk with {connections} connections: {done.stdout}{done.stderr}")
    total = re.search(r"(\d+) requests in ([\d.]+)s", done.stdout)
    assert total is not None, done.stdout
    count, taken = int(total[1]), float(total[2])
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Load(_percentile(done.stdout, 50), _percentile(done.stdout, 99), count / taken, count, taken, cpu)


def _percentile(text: str, which: int) -> float:
    match = re.search(rf"^\s+{which}%\s+([\d.]+)(us|ms|s) *$", text, re.MULTILINE)
    assert match is not None, text
    return float(match[1]) * UNITS_MS[match[2]]


def timed(call: Call, seconds: float) -> Load:
    """Call again and again for so many seconds."""
    for _ in range(WARM_UP):
        call()
    taken: list[float] = []
    began_cpu = time.process_time()
    now = began = time.perf_counter()
    while now < began + seconds:
        call()
        then, now = now, time.perf_counter()
        taken.append(now - then)
    p50, p99 = (float(value) * 1e3 for value in np.percentile(taken, (50, 99)))
    return Load(p50, p99, len(taken) / (now - began), len(taken), now - began, time.process_time() - began_cpu)


class Line:
    """A connection that sends the same bytes and reads one answer."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        self._socket.close()

    def _read(self, held: bytes, needed: int) -> bytes:
        """Return at least so many bytes, those held first."""
        while len(held) < needed:
            more = self._socket.recv(1 << 18)
            if not more:
                raise ClosedError("the server closed the connection")
            held += more
        return held


class HttpLine(Line):
    """HTTP/1.1 on a kept connection; the answer must announce its length."""

    def __init__(self, port: int, exchange: Exchange, *, status: int = 200) -> None:
        super().__init__(port)
        self._expected = f"http/1.1 {status}".encode()
        headers = "".join(f"{name}: {value}\r\n" for name, value in exchange.headers)
        head = f"{exchange.method} {exchange.path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{headers}"
        self._bytes = f"{head}Content-Length: {len(exchange.body)}\r\n\r\n".encode() + exchange.body
        self.ended = False
        """Whether the server has said that it closes the connection: nothing may be asked on it any more."""

    def __call__(self) -> bytes:
        """Return the answer's body. Raises LoadError unless it has the status asked for."""
        self._socket.sendall(self._bytes)
        answer = b""
        while (end := answer.find(b"\r\n\r\n")) < 0:
            answer = self._read(answer, len(answer) + 1)
        head = answer[: end + 2].lower()
        if not head.startswith(self._expected):
            raise LoadError(f"the server answered {answer[:300]!r}")
        self.ended = b"\r\nconnection: close\r\n" in head
        start = head.index(b"content-length:") + 15
        length = int(head[start : head.index(b"\r", start)])
        return self._read(answer, end + 4 + length)[end + 4 :]


class WebSocketLine(Line):
    """A WebSocket that sends one binary message and reads one; `greets`: the server speaks first."""

    def __init__(self, port: int, path: str, message: bytes, *, greets: bool = False) -> None:
        super().__init__(port)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        answer = b""
        while (end := answer.find(b"\r\n\r\n")) < 0:
            answer = self._read(answer, len(answer) + 1)
        if not answer.startswith(b"HTTP/1.1 101"):
            raise LoadError(f"the server answered {answer[:300]!r}")
        self._held = answer[end + 4 :]
        self.frame = _frame(message)
        if greets:
            self._message()

    @property
    def connection(self) -> socket.socket:
        return self._socket

    def __call__(self) -> bytes:
        """Return the answering message. Raises LoadError when it is not binary."""
        self._socket.sendall(self.frame)
        return self._message()

    def _message(self) -> bytes:
        while True:
            held = self._read(self._held, 2)
            kind, length, start = held[0] & 0x0F, held[1] & 0x7F, 2
            if length == 126:
                held, start = self._read(held, 4), 4
                length = int.from_bytes(held[2:4], "big")
            elif length == 127:
                held, start = self._read(held, 10), 10
                length = int.from_bytes(held[2:10], "big")
            held = self._read(held, start + length)
            content, self._held = held[start : start + length], held[start + length :]
            if kind == 2:
                return content
            if kind == 9:  # a ping: uvicorn closes a connection whose client does not answer
                self._socket.sendall(_frame(content, kind=0x8A))
            elif kind == 8 and content[:2] in POLITE:
                raise PoliteError(f"the server closed the stream with {int.from_bytes(content[:2], 'big')}")
            else:
                raise LoadError(f"the server sent a frame of kind {kind}: {content[:300]!r}")


def _frame(message: bytes, *, kind: int = 0x82) -> bytes:
    """Return a masked frame, binary or another; the mask is zeros, which leaves the message as it is."""
    size = len(message)
    if size < 126:
        head = struct.pack("!BB", kind, 0x80 | size)
    else:
        head = struct.pack("!BBH", kind, 0xFE, size) if size < 1 << 16 else struct.pack("!BBQ", kind, 0xFF, size)
    return head + b"\0\0\0\0" + message


class GrpcLine:
    """The Open Inference Protocol over gRPC: one prepared ModelInferRequest."""

    def __init__(self, port: int, model: str, obs: NDArray[np.float32]) -> None:
        import grpc

        # A subchannel of its own: others' failures would make it wait before it connects.
        self._channel = grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)])
        self._call: Any = self._channel.unary_unary(INFER)  # without serializers: bytes in, bytes out
        self._request = infer_request(model, obs)

    def __call__(self) -> bytes:
        """Return the serialized ModelInferResponse. Raises LoadError with the status."""
        import grpc

        try:
            answer: bytes = self._call(self._request, timeout=30)
        except grpc.RpcError as error:
            told: Any = error  # it has the call's methods, which its class does not say
            raise LoadError(f"{told.code().name}: {told.details()}") from None
        return answer

    def close(self) -> None:
        self._channel.close()


def infer_request(model: str, obs: NDArray[np.float32]) -> bytes:
    """Return a serialized ModelInferRequest: model_name = 1, inputs = 5 {name 1, datatype 2, shape 3}, raw = 7."""

    def field(number: int, content: bytes) -> bytes:
        return bytes([number << 3 | 2]) + _varint(len(content)) + content

    shape = b"".join(_varint(size) for size in obs.shape)
    tensor = field(1, b"obs") + field(2, b"FP32") + field(3, shape)
    return field(1, model.encode()) + field(5, tensor) + field(7, obs.astype("<f4").tobytes())


def _varint(value: int) -> bytes:
    digits = []
    while value > 127:
        digits.append(value & 127 | 128)
        value >>= 7
    return bytes([*digits, value])
