"""Targets of real robots: given in a stated frame, named in the question, refused before anything moves."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from arms import LIMITS, RunningArm
from outside_arm import OutsideArm, outside_arm
from rlservo.envs.ur.isaac_reach import quaternion_of

pytest.importorskip("rtde_control")

ENV = "rlservo/EndEffectorPositioningURRob-v0"
BOX = '{"box_low": [-2, -2, 0.3], "watchdog_hz": 2}'


@pytest.fixture(scope="module")
def still() -> Iterator[OutsideArm]:
    """An arm of which no test here may move anything, its slider at 10%."""
    with outside_arm() as arm:
        arm.type("slider 0.1")
        arm.recorder.now_s()
        arm.recorder.wait_until(lambda one: one.newest()["target_speed_fraction"] == 0.1)
        yield arm
        assert arm.recorder.motion().fastest() < 0.005


def refusal(arm: OutsideArm, policies: Path, *options: str) -> str:
    """Return what a rollout that may not begin prints, on one line."""
    words = [
        sys.executable, "-m", "rlservo.deploy.cli", "rollout", ENV, "--bundle", str(policies / "ur5" / "1"),
        "--env-arg", f"robot=rtde://{arm.host}", "--env-arg", "ur_model=ur5", "--unproven", *options,
    ]  # fmt: skip
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 2, done
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())


def test_question_names_start_target_and_the_largest_speed_at_the_present_slider(
    still: OutsideArm, shipped: Path
) -> None:
    said = refusal(still, shipped, "--target", "base:-0.3,-0.1,0.6")  # the pendant's x and y are base_link's, negated
    assert "to its start (0.00, -2.50, 1.50, -1.50, -1.40, 0.00) rad" in said
    assert "at the present speed scaling of 10%" in said
    assert "at most 0.031 rad/s, to the target (0.30, 0.10, 0.60) m in base_link" in said


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--target", "base_link:2,0,0.3"], r"\(2.00, 0.00, 0.30\) m in base_link cannot be reached: .* no nearer"),
        (["--target", "base_link:0.3,0,-0.2"], r"it is 0\.23 m outside the box of the limits"),
        (["--target", "base_link:0.3,0,0.1", "--env-arg", f"limits={BOX}"], r"it is 0\.23 m outside the box"),
        (["--target", "base_link:0,-0.6,0.3", "--env-arg",
          'limits={"position_low": [-0.3, -6, -3, -6, -6, -6], "position_high": [0.3, 6, 3, 6, 6, 6]}'],
         "no nearer to it than .* within the limits of the joints"),
        (["--target", "base_link:0.4,0,0.3", "--env-arg", 'limits={"speed_scale": 0.1}'],
         r"takes \d+ s with at most 0\.0031 rad/s \(speed scaling 10%, speed_scale 0\.1\), and an episode has 30 s"),
        (["--target", "0.3,0,0.3"], "expected one of base_link:X,Y,Z, .* base:X,Y,Z, .*joints:BASE,"),
        (["--target", "joints:0,1,nan,0,0,0"], "expected one of base_link:X,Y,Z"),
    ],
)  # fmt: skip
def test_target_that_cannot_be_is_refused_in_one_sentence(
    still: OutsideArm, shipped: Path, options: list[str], why: str
) -> None:
    said = refusal(still, shipped, "--yes", *options)
    assert re.search(why, said), said


def test_targets_of_a_real_arm_are_in_front_of_the_robot(arm: RunningArm) -> None:
    env: Any = gym.make(
        f"rlservo.envs:{ENV}", robot=f"rtde://{arm.host}", ur_model="ur5", confirm=False, limits=LIMITS,
        disable_env_checker=True,
    )  # fmt: skip
    try:
        for seed in range(12):
            observation, _ = env.reset(seed=seed)
            x, y, z = observation[15:18].tolist()
            assert x > abs(y) - 1e-6 and z >= 0.0, (x, y, z)
            assert observation[0] > 0.15  # not there already
    finally:
        env.close()


@pytest.mark.parametrize("env_id", ["EndEffectorPositioningURSim-v0", "IsaacReachURSim-v0"])
def test_target_of_joints_is_the_flanges_pose_there(env_id: str) -> None:
    joints = [0.3, -1.2, 1.4, -0.4, 0.9, 0.5]
    text = "joints:" + ",".join(map(str, joints))
    env: Any = gym.make(f"rlservo.envs:rlservo/{env_id}", target=text, disable_env_checker=True)
    env.reset(seed=1)
    simulation, target = env.unwrapped.simulation, env.unwrapped.target_position()
    if "Isaac" in env_id:
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, quaternion_of(*env.unwrapped._target_pose()[3:]))
        simulation.place(joints)
        assert np.abs(rotation.reshape(3, 3) - simulation.tool_rotation).max() < 1e-9
    simulation.place(joints)
    assert math.dist(simulation.tool_position + (0, 0, target[2] - env.unwrapped._target[2]), target) < 1e-9
    env.close()


def test_environment_without_a_target_and_a_bad_one_of_a_base_are_refused() -> None:
    for env_id, target, why in (
        ("EmptyEnvironmentURSim-v0", "base_link:0.3,0,0.3", "EmptyEnvironmentURSim has no target"),
        ("NoObstacleNavigationMir100Sim-v0", "map:1,2", r"expected one of odom:X,Y, base_link:X,Y \[m, rad\]"),
    ):
        with pytest.raises(ValueError, match=why):
            gym.make(f"rlservo.envs:rlservo/{env_id}", target=target)
