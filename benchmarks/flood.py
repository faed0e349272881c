"""512 connections that ask at once: who is refused, how soon, and whether the others get their own action."""

from __future__ import annotations

import json
import selectors
import socket
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from speed.catalogue import Case
from speed.machine import rss_mb
from speed.rounds import session_of

MANY = 512
ROUNDS = 8
LARGE, ROWS = 2, 256
"""So many of the connections ask first, for so many observations each: meanwhile a queue forms."""
ALONE = 50
WAIT_S = 30.0


@dataclass
class Flood:
    """What came back."""

    asked: int = 0
    refused_ms: list[float] = field(default_factory=list)
    answered_ms: list[float] = field(default_factory=list)
    alone_ms: list[float] = field(default_factory=list)
    """What one request takes when nobody floods."""
    wrong: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    grown_mb: float = 0.0

    def sentence(self) -> str:
        def shown(values: list[float]) -> str:
            if not values:
                return "none"
            p50, p99 = np.percentile(values, (50, 99))
            return f"{len(values)} (p50 {p50:.0f} ms, p99 {p99:.0f} ms)"

        return (
            f"{MANY} connections, {ROUNDS} times: refused {shown(self.refused_ms)}, "
            f"answered {shown(self.answered_ms)}, alone {shown(self.alone_ms)}, replicas grew by {self.grown_mb:.1f} MB"
        )


def flood(port: int, case: Case, replicas: list[int]) -> Flood:
    """Send `MANY` requests in one go, each on its own connection with its own observations, several times."""
    found = Flood()
    batch = case.batch(MANY + ROWS)
    actions = session_of(case).run(["action"], {"obs": batch})[0]
    parts = [slice(number, number + (ROWS if number < LARGE else 1)) for number in range(MANY)]
    requests = [_request(case, batch[part]) for part in parts]
    expected = [actions[part] for part in parts]
    before = 0.0
    for _ in range(ALONE):
        with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as line:
            alone = Flood()
            _once([line], [requests[-1]], [expected[-1]], alone)
            found.alone_ms += alone.answered_ms
    for turn in range(ROUNDS):
        lines = [socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) for _ in range(MANY)]
        try:
            _once(lines, requests, expected, found)
        finally:
            for line in lines:
                line.close()
        if turn == 1:  # the first ones make allocators and caches grow
            before = sum(map(rss_mb, replicas))
    found.grown_mb = sum(map(rss_mb, replicas)) - before
    if not found.answered_ms:
        found.broken.append("nobody was answered")
    return found


def _request(case: Case, obs: object) -> bytes:
    body = json.dumps({"obs": np.asarray(obs).tolist()}).encode()
    head = (
        f"POST /v1/policies/{case.name}/act HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


def _once(lines: list[socket.socket], requests: list[bytes], expected: list[Any], found: Flood) -> None:
    selector = selectors.DefaultSelector()
    sent: dict[int, float] = {}
    ended: dict[int, float] = {}
    got: dict[int, bytearray] = {}

    def send() -> None:
        for number, line in enumerate(lines):  # the large ones first; a request fits into the socket's buffer, or waits
            sent[number] = time.perf_counter()
            line.sendall(requests[number])

    for number, line in enumerate(lines):
        selector.register(line, selectors.EVENT_READ, number)
    sender = threading.Thread(target=send)
    sender.start()
    deadline = time.monotonic() + WAIT_S
    open_lines = len(lines)
    while open_lines and time.monotonic() < deadline:
        for key, _ in selector.select(timeout=1.0):
            number = key.data
            try:
                data = lines[number].recv(1 << 18)
            except OSError as error:
                data = b""
                found.broken.append(f"a connection broke: {error}")
            if data:
                got.setdefault(number, bytearray()).extend(data)
            else:
                ended[number] = time.perf_counter()
                selector.unregister(lines[number])
                open_lines -= 1
    sender.join()
    selector.close()
    found.asked += len(lines)
    for number, when in ended.items():  # afterwards: reading answers takes time that the others' clocks would show
        _judge(number, bytes(got.get(number, b"")), 1e3 * (when - sent[number]), expected[number], found)
    if open_lines:
        found.broken.append(f"{open_lines} connections were never answered")


def _judge(number: int, answer: bytes, taken_ms: float, expected: Any, found: Flood) -> None:
    head, _, body = answer.partition(b"\r\n\r\n")
    status = head[9:12]
    try:
        document = json.loads(body)
    except ValueError:
        found.wrong.append(f"an answer that is no JSON: {answer[:200]!r}")
        return
    if status == b"503":
        if b"retry-after:" not in head.lower():
            found.wrong.append(f"a refusal without Retry-After: {head[:200]!r}")
        found.refused_ms.append(taken_ms)
    elif status == b"200":
        found.answered_ms.append(taken_ms)
        if not np.allclose(document["action"], expected, atol=1e-4):
            found.wrong.append(f"connection {number} got another action than its own")
    else:
        found.wrong.append(f"an answer with {status!r}: {body[:200]!r}")
