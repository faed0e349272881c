"""Simulated UR controllers: one at its own address of 127.0.0.0/8 for each test that uses it."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from rlservo.robots.simulated.ur_controller.controller import Controller, Sample
from rlservo.robots.simulated.ur_controller.controller_server import CannotListenError, ControllerServer

PATIENCE_S = 60.0
# Of a real arm in tests. The machine may be busy: the product's watchdog_hz is 10.
LIMITS = {"watchdog_hz": 1.0, "start_speed": 1.0, "blend_s": 0.1}
_counter = itertools.count(os.getpid())


@dataclass
class RunningArm:
    """A controller that serves in a thread of this process."""

    server: ControllerServer

    @property
    def host(self) -> str:
        return self.server.host

    @property
    def controller(self) -> Controller:
        return self.server.controller

    def do(self, action: Callable[[], object]) -> None:
        """Run something between two control cycles, and wait until it has."""
        done = threading.Event()
        self.server.do(lambda: (action(), done.set()))
        assert done.wait(PATIENCE_S)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < limit, "the condition never came true"
            time.sleep(0.02)

    def last_motion(self) -> Sample:
        """Return the last control cycle in which a joint moved faster than 0.01 rad/s; the first one where none did."""
        samples = list(self.controller.trace)
        return next((one for one in reversed(samples) if abs(one.velocities).max() > 0.01), samples[0])


def run_arm(model: str = "ur5e", **options: Any) -> Iterator[RunningArm]:
    """Serve a controller until the generator is closed; the options are the controller's."""
    while True:
        number = next(_counter)
        try:
            host = f"127.{1 + number // 62500 % 250}.{number // 250 % 250}.{1 + number % 250}"
            server = ControllerServer(Controller(model, **options), host=host)
            break
        except CannotListenError:
            continue
    yield from serving(server)


def serving(server: ControllerServer) -> Iterator[RunningArm]:
    """Run a controller that listens until the generator is closed."""
    stop = threading.Event()
    thread = threading.Thread(target=server.serve, args=(stop,), name="ur-controller")
    thread.start()
    try:
        yield RunningArm(server)
    finally:
        stop.set()
        thread.join()
        server.close()


@pytest.fixture
def arm() -> Iterator[RunningArm]:
    """A CB3 arm: at 125 Hz it costs a third of an e-Series' time."""
    yield from run_arm("ur5")
