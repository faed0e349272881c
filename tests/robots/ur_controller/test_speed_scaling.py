"""Slider, trajectory limiter and pause of the simulated controller, as UR's RTDE guide and dashboard describe them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from outside_arm import OutsideArm, outside_arm

rtde_control = pytest.importorskip("rtde_control")

HOME = [0.0, -2.5, 1.5, -1.5, -1.4, 0.0]  # [rad]
AWAY = [0.1, -2.5, 1.5, -1.5, -1.4, 0.0]
PLAYING, PAUSED = 2, 4


@pytest.fixture
def arm() -> Iterator[OutsideArm]:
    with outside_arm() as arm:
        yield arm


def servo_time(arm: OutsideArm) -> float:
    """Return how long servoj takes for the first 63% of a step [s]."""
    control = rtde_control.RTDEControlInterface(arm.host, 125.0)
    try:
        assert control.moveJ(HOME, 1.0, 2.0)
        began_s = arm.recorder.now_s()
        for _ in range(8):
            assert control.servoJ(AWAY, 0.0, 0.0, 0.008, 0.2, 300.0)
        arm.recorder.wait_until(lambda one: one.base() > 0.095)
    finally:
        control.stopScript()
        control.disconnect()
    motion = arm.recorder.motion().since(began_s)
    base = motion.positions[:, 0]
    return float(motion.time_s[(base > 0.063).argmax()] - motion.time_s[(base > 0.001).argmax()])


def test_servoj_takes_as_much_longer_as_the_speed_is_scaled(arm: OutsideArm) -> None:
    full_s = servo_time(arm)
    arm.type("slider 0.25")
    assert servo_time(arm) == pytest.approx(4.0 * full_s, rel=0.2)
    arm.type("limiter 0.5")
    assert servo_time(arm) == pytest.approx(8.0 * full_s, rel=0.2)


def test_slider_and_limiter_are_reported_apart_and_a_pause_holds_the_program(arm: OutsideArm) -> None:
    recorder = arm.recorder
    recorder.now_s()
    assert recorder.newest()["speed_scaling"] == 0.0
    control = rtde_control.RTDEControlInterface(arm.host, 125.0)
    arm.type("slider 0.5")
    recorder.wait_until(lambda one: one.newest()["target_speed_fraction"] == 0.5)
    assert (recorder.newest()["speed_scaling"], recorder.newest()["runtime_state"]) == (1.0, PLAYING)
    assert control.moveJ(AWAY, 0.2, 0.5, True)
    recorder.wait_until(lambda one: one.speed() > 0.09)
    assert recorder.speed() < 0.11
    assert arm.dashboard("pause") == "Pausing program"
    recorder.wait_until(lambda one: one.newest()["runtime_state"] == PAUSED)
    recorder.wait_until(lambda one: one.speed() < 1e-3)
    where = recorder.base()
    recorder.watch(0.5)
    assert recorder.base() == pytest.approx(where, abs=1e-3)
    assert arm.dashboard("play") == "Starting program"
    recorder.wait_until(lambda one: one.base() > 0.099)
    control.disconnect()
