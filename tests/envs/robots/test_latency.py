"""`robot-latency` against a controller whose link has a known delay."""

from __future__ import annotations

import pytest

from arms import RunningArm
from rlservo.envs.robots.arm import RobotError
from rlservo.envs.robots.latency import measure_latency
from rlservo.envs.robots.limits import Limits
from rlservo.envs.robots.rtde_arm import RtdeArm

pytest.importorskip("rtde_control")


def test_latency_is_the_links_and_the_followers_and_gives_the_evaluation_to_pass(arm: RunningArm) -> None:
    arm.server.link.latency_s = 0.1
    real = RtdeArm(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
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
    real = RtdeArm(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    home = real.arm_state().positions.copy()
    try:
        report = measure_latency(real, steps=2, on_step=lambda _: real.go_to(home))
    finally:
        real.close()
    assert report.steps == 2


def test_robot_that_stops_between_two_motions_says_why(arm: RunningArm) -> None:
    real = RtdeArm(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        with pytest.raises(RobotError, match="the robot stopped: protective_stop: find the cause"):
            measure_latency(real, on_step=lambda _: arm.do(lambda: arm.controller.stop_protectively("a test")))
    finally:
        real.close()
