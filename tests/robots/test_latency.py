"""`robot-latency` against a controller whose link has a known delay."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from typing import Any

import pytest

from arms import RunningArm
from command_line import rlservo
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_process import ArmProcess
from rlservo.robots.latency import measure_latency
from rlservo.robots.limits import Limits

pytest.importorskip("rtde_control")

# Each way. ur_rtde takes a command for refused after 0.3 s, so 0.2 s are left to a busy machine.
LINK_S = 0.05


def test_latency_is_the_links_and_the_followers_and_gives_the_evaluation_to_pass(arm: RunningArm) -> None:
    arm.server.link.latency_s = LINK_S
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        report = measure_latency(real, steps=5)
    finally:
        real.close()
    assert report.p50_ms >= 2000.0 * LINK_S  # there and back
    assert report.cycles >= 2
    assert report.disturbance == f"latency={report.cycles},noise=real"
    assert report.state_period_ms >= 7.9
    assert abs(arm.controller.simulation.joint_positions[5]) < 0.02


def test_what_was_measured_is_told_although_a_stop_ended_the_hours(arm: RunningArm) -> None:
    """A delay that ends the program is what one looks for in hours."""
    arm.controller.trace.clear()
    began = threading.Event()

    def stop_it() -> None:
        arm.wait_until(lambda: sum(abs(one.velocities[5]) > 0.1 for one in list(arm.controller.trace)) > 400)
        began.set()
        arm.do(lambda: arm.controller.stop_protectively("a test"))

    person = threading.Thread(target=stop_it)
    person.start()
    words = ("--ur-model", "ur5", "--steps", "5", "--hours", "1", "--limit", "watchdog_hz=1", "--yes", "--json")
    done = rlservo("robot-latency", f"rtde://{arm.host}", *words)
    person.join()
    assert done.returncode == 2 and began.is_set()
    report = json.loads(done.stdout)
    assert "protective_stop" in report["fault"] and report["steps"] >= 5
    assert sum(report["latencies"]["counts"]) == report["steps"] and sum(report["periods"]["counts"]) > 100
    assert f"ended after {report['steps']} motions: the robot stopped: protective_stop" in done.stderr


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
    arm.server.link.latency_s = LINK_S
    arm.do(lambda: setattr(arm.controller, "speed_fraction", 0.1))
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))
    try:
        report = measure_latency(real, steps=5)
    finally:
        real.close()
    assert 2000.0 * LINK_S <= report.p50_ms <= 2000.0 * LINK_S + 200.0  # as at full speed


def test_periods_are_those_between_two_setpoints_and_suspensions_are_among_them(arm: RunningArm) -> None:
    real = ArmProcess(arm.host, "ur5", setpoint_timeout_s=0.5, limits=Limits(watchdog_hz=1.0))

    def suspend(_motion: int) -> None:
        os.kill(real.pid, signal.SIGSTOP)
        time.sleep(0.07)
        os.kill(real.pid, signal.SIGCONT)

    began = time.monotonic()
    try:
        report = measure_latency(real, steps=5, hours=12 / 3600, on_step=suspend)
    finally:
        real.close()
    took_s = time.monotonic() - began
    assert took_s > 12 and report.steps > 5
    periods, motions = report.periods, report.latencies
    assert 0.5 < 0.008 * sum(periods.counts) / took_s < 1.02  # 125 setpoints a second
    assert 7.5 < periods.p50_ms < 12.0 and 70.0 < periods.longest_ms < 1000.0
    assert len(periods.counts) == 500 and periods.counts[-1] >= report.steps - 1  # of 50 ms and more
    assert sum(motions.counts) == report.steps and motions.longest_ms == report.max_ms
    assert abs(motions.p50_ms - report.p50_ms) < 20.0
