"""Loop of a simulated robot behind ROS: its clock, its console, and faults of its link."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.envs.ros2.link import Publish, safely
from rlservo.envs.ur_controller.console import read_console
from rlservo.envs.ur_controller.server import Link as LinkFaults

if TYPE_CHECKING:
    from rlservo.envs.ros2.simulated_arm import SimulatedArm
    from rlservo.envs.ros2.simulated_base import SimulatedBase

LONGEST_CATCH_UP_S = 0.5  # [s] of cycles that a delayed loop catches up


class FaultyLink:
    """Messages in both directions, delayed or lost according to `faults`."""

    def __init__(self) -> None:
        self.faults = LinkFaults()
        self._rng = np.random.default_rng(0)
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
    robot: SimulatedArm | SimulatedBase, stop: threading.Event, on_ready: Callable[[], None], lines: Iterable[str] = ()
) -> None:
    """Run a robot in real time until `stop` is set, and obey the console's lines meanwhile, all in this thread."""
    asked: list[Callable[[], object]] = []
    read_console(lines, asked.append, robot.obey)
    on_ready()
    due = time.monotonic()
    while not stop.is_set():
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
        due = max(due + robot.dt, now - LONGEST_CATCH_UP_S)
        while asked:
            asked.pop(0)()
        robot.messages.deliver()
        robot.tick()
