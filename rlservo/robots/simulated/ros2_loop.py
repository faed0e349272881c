"""Loop of a simulated robot behind ROS: its clock, its console, and faults of its link."""

from __future__ import annotations

import heapq
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from rlservo.robots.ros2.link import Publish, safely
from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults

LONGEST_CATCH_UP_S = 0.5  # [s] of cycles that a delayed loop catches up


class SimulatedRobot(Protocol):
    """A robot driven by the loop; all calls come from the loop's thread."""

    dt: float  # [s], of a control cycle
    messages: FaultyLink

    def tick(self) -> None:
        """Let one control cycle pass and publish."""
        ...

    def obey(self, line: str) -> str:
        """Carry out a line of the console and return what to print."""
        ...


class FaultyLink:
    """Messages in both directions, delayed or lost according to `faults`."""

    def __init__(self, faults: LinkFaults, seed: int = 0) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(seed)
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []
        self._count = itertools.count()
        self._lock = threading.Lock()

    def outgoing(self, publishers: Sequence[Publish]) -> Publish:
        """Return a function that publishes on all of the links."""

        def publish(values: Mapping[str, Any]) -> None:
            def send() -> None:
                for one in publishers:
                    one(values)

            self._pass(send, may_wait=True)

        return publish

    def incoming(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that passes a message to the loop's thread."""
        take = safely(take, "a command topic")
        return lambda message: self._pass(lambda: take(message), may_wait=False)

    def deliver(self) -> None:
        """Deliver the messages that are due. Only the loop's thread calls it."""
        while True:
            with self._lock:
                if not self._waiting or self._waiting[0][0] > time.monotonic():
                    return
                _, _, deliver = heapq.heappop(self._waiting)
            deliver()

    def _pass(self, deliver: Callable[[], None], *, may_wait: bool) -> None:
        faults = self.faults
        if faults.is_down or (faults.drop and self._rng.random() < faults.drop):
            return
        delay_s = faults.latency_s + (self._rng.uniform(0.0, faults.jitter_s) if faults.jitter_s else 0.0)
        if may_wait and not delay_s:
            deliver()
            return
        with self._lock:
            heapq.heappush(self._waiting, (time.monotonic() + delay_s, next(self._count), deliver))


def run(
    robot: SimulatedRobot, stop: threading.Event, on_ready: Callable[[], None], console: Iterable[str] = ()
) -> None:
    """Run a robot in real time until `stop` is set, and obey the console's lines meanwhile."""
    lines: list[str] = []

    def read_lines() -> None:
        with suppress(OSError):  # its terminal is gone
            for line in console:
                lines.append(line)  # each as it comes

    threading.Thread(target=read_lines, name="console", daemon=True).start()
    on_ready()
    due = time.monotonic()
    while not stop.is_set():
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
        due = max(due + robot.dt, now - LONGEST_CATCH_UP_S)
        while lines:
            line = lines.pop(0)
            if line.strip() and (reply := robot.obey(line)):
                sys.stdout.write(f"{reply}\n")
                sys.stdout.flush()
        robot.messages.deliver()
        robot.tick()
