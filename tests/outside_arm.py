"""An arm seen from outside: the simulated controller as a process, and a recorder that knows only UR's RTDE guide.

Nothing here comes from `rlservo`: the recorder speaks protocol version 2 over a socket (packages V, O, S and U, big
endian), the controller is the installed command.
"""

from __future__ import annotations

import itertools
import math
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

PATIENCE_S = 60.0
PORTS = (29999, 30001, 30002, 30003, 30004)
FIELDS = {  # of the guide's table of outputs, with their sizes on the wire
    "timestamp": "d", "target_q": "6d", "target_qd": "6d", "actual_q": "6d", "actual_qd": "6d",
    "runtime_state": "I", "speed_scaling": "d", "target_speed_fraction": "d",
}  # fmt: skip
_addresses = itertools.count()
# Universal Robots, "DH Parameters for calculations of kinematics and dynamics", UR10e: a, d [m] and alpha [rad] of each
# joint, in the controller's frame "base".
DH_UR10E = (
    (0.0, 0.1807, math.pi / 2), (-0.6127, 0.0, 0.0), (-0.57155, 0.0, 0.0),
    (0.0, 0.17415, math.pi / 2), (0.0, 0.11985, -math.pi / 2), (0.0, 0.11655, 0.0),
)  # fmt: skip

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """What a recorder saw, one row for each data package."""

    time_s: Vector  # the controller's own
    positions: Vector  # [rad], (n, 6), measured
    velocities: Vector  # [rad/s], (n, 6), measured
    setpoint_velocities: Vector  # [rad/s], (n, 6), of the controller's setpoint

    def since(self, time_s: float) -> Motion:
        """Return the part from a moment on."""
        rows = self.time_s >= time_s
        return Motion(self.time_s[rows], self.positions[rows], self.velocities[rows], self.setpoint_velocities[rows])

    def fastest(self) -> float:
        """Return the largest speed of a joint [rad/s]."""
        return float(np.abs(self.velocities).max(initial=0.0))

    def hardest(self, window_s: float = 0.02) -> float:
        """Return the largest change of a joint setpoint's velocity within a window, over its length [rad/s^2]."""
        rows = max(1, round(window_s / float(np.median(np.diff(self.time_s)))))
        change = np.abs(self.setpoint_velocities[rows:] - self.setpoint_velocities[:-rows])
        took = (self.time_s[rows:] - self.time_s[:-rows])[:, None]
        return float((change / took).max(initial=0.0))


def flange(joints: Vector) -> Vector:
    """Return a UR10e's flange in the controller's frame base (4, 4)."""
    pose = np.eye(4)
    for theta, (a, d, alpha) in zip(joints, DH_UR10E, strict=True):
        (ct, st), (ca, sa) = (math.cos(theta), math.sin(theta)), (math.cos(alpha), math.sin(alpha))
        pose = pose @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


class Recorder:
    """A client of RTDE that keeps every data package; `more` fields follow the usual ones."""

    def __init__(self, host: str, rate_hz: float, more: Mapping[str, str]) -> None:
        self._fields = FIELDS | dict(more)
        self._socket = socket.create_connection((host, 30004), PATIENCE_S)
        self._row = struct.Struct(">" + "".join(self._fields.values()))
        self._rows: list[tuple[float, ...]] = []
        assert self._ask("V", struct.pack(">H", 2)) == b"\x01"
        reply = self._ask("O", struct.pack(">d", rate_hz) + ",".join(self._fields).encode())
        self._recipe = reply[:1]
        assert b"NOT_FOUND" not in reply, reply
        assert self._ask("S", b"") == b"\x01"
        self._thread = threading.Thread(target=self._run, name="rtde-recorder", daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Return the newest package's time."""
        limit = time.monotonic() + PATIENCE_S
        while not self._rows:
            assert time.monotonic() < limit, "no data package came"
            time.sleep(0.01)
        return self._rows[-1][0]

    def motion(self) -> Motion:
        """Return what has been seen."""
        rows = np.array(self._rows)
        return Motion(rows[:, 0], rows[:, 13:19], rows[:, 19:25], rows[:, 7:13])

    def column(self, name: str) -> Vector:
        """Return a field of six numbers of every data package, (n, 6)."""
        names = list(self._fields)
        first = sum(6 if self._fields[one] == "6d" else 1 for one in names[: names.index(name)])
        return np.array(self._rows)[:, first : first + 6]

    def newest(self) -> dict[str, float | tuple[float, ...]]:
        """Return the newest package by names."""
        values, found = iter(self._rows[-1]), {}
        for name, kind in self._fields.items():
            found[name] = tuple(next(values) for _ in range(6)) if kind == "6d" else next(values)
        return found

    def wait_until(self, condition: Callable[[Recorder], bool]) -> None:
        limit = time.monotonic() + PATIENCE_S
        while not condition(self):
            assert time.monotonic() < limit, "the condition never came true"
            time.sleep(0.01)

    def watch(self, for_s: float) -> float:
        """Let so much of the controller's time pass; return when it began."""
        began_s = self.now_s()
        self.wait_until(lambda _: self.now_s() > began_s + for_s)
        return began_s

    def speed(self) -> float:
        """Return the present speed of the fastest joint [rad/s]."""
        self.now_s()
        return max(map(abs, self._rows[-1][19:25]))

    def base(self) -> float:
        """Return the present angle of the first joint [rad]."""
        return self._rows[-1][13]

    def close(self) -> None:
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _ask(self, kind: str, payload: bytes) -> bytes:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        answer, content = self._package()
        assert answer == kind, answer
        return content

    def _package(self) -> tuple[str, bytes]:
        size, kind = struct.unpack(">HB", self._bytes(3))
        return chr(kind), self._bytes(size - 3)

    def _bytes(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self._socket.recv(count - len(data))
            if not part:
                raise ConnectionError
            data += part
        return data

    def _run(self) -> None:
        try:
            while True:
                kind, content = self._package()
                if kind == "U" and content[:1] == self._recipe:
                    self._rows.append(self._row.unpack(content[1:]))
        except OSError:
            return


class OutsideArm:
    """The command `rlservo ur-controller`, whose console is typed at, and a recorder."""

    def __init__(self, host: str, process: subprocess.Popen[str], recorder: Recorder) -> None:
        self.host, self.process, self.recorder = host, process, recorder

    def type(self, line: str) -> None:
        """Type a line at the controller's console."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def dashboard(self, line: str) -> str:
        """Send a line to the dashboard server and return its reply."""
        with socket.create_connection((self.host, 29999), PATIENCE_S) as client, client.makefile("rw") as stream:
            stream.readline()
            stream.write(f"{line}\n")
            stream.flush()
            return stream.readline().strip()


@contextmanager
def outside_arm(model: str = "ur5", rate_hz: float = 125.0) -> Iterator[OutsideArm]:
    """Run a controller and record it."""
    # Another address than those of tests in other processes, whose ids follow each other.
    process_id = os.getpid()
    host = f"127.{1 + process_id // 250 % 250}.{process_id % 250}.{1 + next(_addresses) % 250}"
    process = subprocess.Popen(
        [sys.executable, "-m", "rlservo.deploy.cli", "ur-controller", "--model", model, "--host", host],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        limit = time.monotonic() + PATIENCE_S
        while True:
            assert process.poll() is None and time.monotonic() < limit, "the controller does not start"
            with socket.socket() as client:
                if client.connect_ex((host, PORTS[-1])) == 0:
                    break
            time.sleep(0.1)
        with recorded(host, rate_hz) as recorder:
            yield OutsideArm(host, process, recorder)
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.terminate()
        process.wait(PATIENCE_S)


@contextmanager
def recorded(host: str, rate_hz: float = 125.0, more: Mapping[str, str] = MappingProxyType({})) -> Iterator[Recorder]:
    """Record the controller at an address."""
    recorder = Recorder(host, rate_hz, more)
    try:
        yield recorder
    finally:
        recorder.close()
