"""`robot-latency` against a controller whose link has a known delay."""

from __future__ import annotations

import time
from typing import Any

import pytest

from arms import RunningArm
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.latency import measure_latency
from rlservo.robots.limits import Limits

pytest.importorskip("rtde_control")


def test_latency_is_the_links_and_the_followers_and_gives_the_evaluation_to_pass(arm: RunningArm) -> None:
    arm.server.link.latency_s = 0.1
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        report = measure_latency(real, steps=5)
    finally:
        real.close()
    assert report.p50_ms >= 200.0  # there and back
    assert report.cycles >= 3
    assert report.disturbance == f"latency={report.cycles},noise=real"
    assert report.state_period_ms >= 7.9
    assert abs(arm.controller.simulation.joint_positions[5]) < 0.02


def test_motion_that_was_cut_short_is_followed_by_a_whole_one(arm: RunningArm) -> None:
    """A busy computer stops commanding before the wrist has turned: the way back would be no motion at all."""
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    home = real.arm_state().positions.copy()
    try:
        report = measure_latency(real, steps=2, on_step=lambda _: real.go_to(home))
    finally:
        real.close()
    assert report.steps == 2


def test_motion_that_a_busy_computer_misses_is_made_again(arm: RunningArm, monkeypatch: pytest.MonkeyPatch) -> None:
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    command, missed = real.command, [0, 1]

    def late(goal: Any, duration_s: float) -> None:
        command(goal, duration_s)
        if missed:
            missed.pop()
            time.sleep(0.8)  # the whole motion

    monkeypatch.setattr(real, "command", late)
    try:
        report = measure_latency(real, steps=2)
        assert (report.steps, missed) == (2, [])
        missed += [0] * 1000
        with pytest.raises(RobotError, match=r"missed the start of 4 motions of 0\.4 s: end other work on it"):
            measure_latency(real, steps=2)
    finally:
        real.close()


def test_robot_that_stops_between_two_motions_says_why(arm: RunningArm) -> None:
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        with pytest.raises(RobotError, match="the robot stopped: protective_stop: find the cause"):
            measure_latency(real, on_step=lambda _: arm.do(lambda: arm.controller.stop_protectively("a test")))
    finally:
        real.close()


def test_arm_whose_slider_is_at_a_tenth_is_measured_too(arm: RunningArm) -> None:
    arm.server.link.latency_s = 0.1
    arm.do(lambda: setattr(arm.controller, "speed_fraction", 0.1))
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        report = measure_latency(real, steps=5)
    finally:
        real.close()
    assert 200.0 <= report.p50_ms <= 400.0  # as at full speed
