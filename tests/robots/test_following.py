"""The arm's motion, recorded from outside, while its controller slows down, pauses or is blocked."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from arms import LIMITS, RunningArm, serving
from outside_arm import OutsideArm, outside_arm, recorded
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.limits import Limits
from rlservo.robots.simulated.ur_controller.controller import Controller
from rlservo.robots.simulated.ur_controller.controller_server import ControllerServer

pytest.importorskip("rtde_control")

START = np.array([0.0, -2.5, 1.5, -1.5, -1.4, 0.0])  # [rad], of the simulated controller
FASTEST = 0.1 * np.pi  # [rad/s]: a tenth of a UR5's data sheet
HARDEST = 5.0  # [rad/s^2], the limits' default
OVERSHOOT = 1.1  # of the simulated drives, and of commands that a busy machine sends in pairs


@contextmanager
def swung(host: str, **limits: float) -> Iterator[ArmProcess]:
    """An arm whose base is sent 2 rad back and forth, 20 times a second, as by a policy."""
    real = ArmProcess(host, "ur5", limits=Limits.of({**LIMITS, **limits}))
    is_over = threading.Event()

    def swing() -> None:
        side = 1.0
        while not is_over.wait(0.05):
            base = real.arm_state().positions[0]
            side = -1.0 if base > 0.9 else 1.0 if base < -0.9 else side
            real.command(START + np.array([side, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.1)

    thread = threading.Thread(target=swing)
    thread.start()
    try:
        yield real
    finally:
        is_over.set()
        thread.join()
        real.close()


@pytest.fixture
def outside() -> Iterator[OutsideArm]:
    with outside_arm() as arm:
        yield arm


@pytest.mark.parametrize(("line", "back"), [("slider 0.2", "slider 1"), ("limiter 0.05", "limiter 1")])
def test_arm_that_its_controller_slows_down_does_not_catch_up(outside: OutsideArm, line: str, back: str) -> None:
    recorder = outside.recorder
    with swung(outside.host) as real:
        recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
        outside.type(line)
        slow_s = recorder.watch(3.0) + 1.0
        slow = recorder.motion().since(slow_s)
        outside.type(back)
        released_s = recorder.watch(3.0)
        assert not real.fault
        motion = recorder.motion()
    share = float(line.split()[1])
    assert 0.0 < slow.fastest() < share * FASTEST * 1.2
    assert motion.since(released_s).fastest() > 0.9 * FASTEST
    assert motion.fastest() < OVERSHOOT * FASTEST
    assert motion.hardest() < OVERSHOOT * HARDEST


class Silent(Controller):
    """A controller that slows the arm down without a word."""

    speed_scaling = 1.0  # type: ignore[assignment]


def test_arm_that_is_blocked_without_a_word_is_a_fault_and_not_caught_up_with() -> None:
    for arm in serving(ControllerServer(Silent("ur5"), host="127.0.0.77")):
        with recorded(arm.host) as recorder, swung(arm.host) as real:
            recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
            set_limiter(arm, 0.02)
            recorder.watch(4.0)
            assert real.fault.startswith("not_following")
            set_limiter(arm, 1.0)
            released_s = recorder.watch(2.0)
        motion = recorder.motion()
        assert motion.fastest() < OVERSHOOT * FASTEST
        assert motion.since(released_s).fastest() < 0.05


@pytest.mark.parametrize("blocked_s", [0.3, 0.6])
def test_arm_that_is_blocked_for_a_moment_does_not_hurry(blocked_s: float) -> None:
    for arm in serving(ControllerServer(Silent("ur5"), host="127.0.0.77")):
        with recorded(arm.host) as recorder, swung(arm.host):
            recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
            set_limiter(arm, 0.0)
            time.sleep(blocked_s)
            set_limiter(arm, 1.0)
            recorder.watch(2.0)
        # The controller's own servo closes the gap that had opened until it was noticed.
        assert recorder.motion().fastest() < 1.75 * FASTEST


def set_limiter(arm: RunningArm, share: float) -> None:
    arm.do(lambda: setattr(arm.controller, "limiter", share))


def test_paused_program_is_a_stop(outside: OutsideArm) -> None:
    recorder = outside.recorder
    with swung(outside.host) as real:
        recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
        assert outside.dashboard("pause") == "Pausing program"
        recorder.wait_until(lambda one: one.speed() < 0.01)
        time.sleep(1.0)
        assert real.fault.startswith("program_paused")
        outside.dashboard("play")
        resumed_s = recorder.watch(2.0)
    motion = recorder.motion()
    assert motion.fastest() < OVERSHOOT * FASTEST
    assert motion.since(resumed_s).fastest() < 0.05


def test_slider_at_zero_is_a_stop(outside: OutsideArm) -> None:
    recorder = outside.recorder
    with swung(outside.host) as real:
        recorder.wait_until(lambda one: one.speed() > 0.9 * FASTEST)
        outside.type("slider 0")
        recorder.wait_until(lambda one: one.speed() < 0.01)
        time.sleep(1.0)
        assert real.fault.startswith("slider_at_zero")
        outside.type("slider 1")
        raised_s = recorder.watch(2.0)
    assert recorder.motion().since(raised_s).fastest() < 0.05
