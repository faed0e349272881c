"""`rollout --dry-run`: start, target, path and speeds from the arm's present pose, and nothing moves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from arms import RunningArm
from command_line import rlservo
from outside_arm import outside_arm
from rlservo.robots.simulated.ur_controller.controller import START_JOINTS

pytest.importorskip("rtde_control")


def test_dry_run_says_what_the_arm_would_do_and_nothing_moves(shipped: Path) -> None:
    with outside_arm() as arm:
        arm.type("slider 0.1")
        arm.recorder.now_s()
        arm.recorder.wait_until(lambda one: one.newest()["target_speed_fraction"] == 0.1)
        words = (
            "rollout", "rlservo/EndEffectorPositioningURRob-v0", "--bundle", shipped / "ur5", "--dry-run",
            "--env-arg", f"robot=rtde://{arm.host}", "--env-arg", "ur_model=ur5", "--target", "base_link:0.3,0.1,0.6",
        )  # fmt: skip
        done = rlservo(*words, "--json")
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        (policy,) = report["rehearsal"]
        assert policy["from"] == pytest.approx([0.0, -2.5, 1.5, -1.5, -1.4, 0.0], abs=1e-3)
        assert 0.02 < policy["joint_speed"] <= 0.0315  # a tenth of a tenth of the data sheet's
        assert 5.0 < policy["time_s"] < 30.0 and report["successes"] == 1
        assert sum((a - b) ** 2 for a, b in zip(policy["flange"], (0.3, 0.1, 0.6), strict=True)) < 0.1**2
        slow = rlservo(*words, "--env-arg", 'limits={"speed_scale": 0.1}')
        assert slow.returncode == 2 and "raise the speed slider" in slow.stderr
        arm.recorder.watch(0.2)
        assert arm.recorder.motion().fastest() < 0.005
        assert set(arm.recorder.motion().setpoint_velocities.ravel()) == {0.0}


def test_dry_run_shows_the_way_to_the_start_at_the_start_speed(arm: RunningArm, shipped: Path) -> None:
    away = np.array(START_JOINTS) + (0.5, 0.3, 0.0, 0.0, 0.0, 0.0)
    arm.do(lambda: arm.controller.simulation.place(away))
    done = rlservo(
        "rollout", "rlservo/EndEffectorPositioningURRob-v0", "--bundle", shipped / "ur5", "--dry-run",
        "--env-arg", f"robot=rtde://{arm.host}", "--env-arg", "ur_model=ur5", "--target", "base_link:0.3,0.1,0.6",
        "--env-arg", 'limits={"start_speed": 0.2}', "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    start, policy = json.loads(done.stdout)["rehearsal"]
    assert start["from"] == pytest.approx(away.tolist(), abs=1e-3)
    assert policy["from"] == pytest.approx(list(START_JOINTS), abs=0.01)
    assert start["joint_speed"] == pytest.approx(0.2, rel=0.01)
    assert start["time_s"] == pytest.approx(0.5 / 0.2 + 0.5, abs=0.3)  # half of blend_s
