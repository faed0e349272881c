"""Isaac Lab's reach task for a real UR10e, against its figures and UR's own Denavit-Hartenberg table."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from outside_arm import flange

ID = "rlservo.envs:rlservo/IsaacDeployReachURSim-v0"
START = [math.pi, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0]
HALF = math.sqrt(0.5)


def reach(**arguments: Any) -> Any:
    return gym.make(ID, rs_state_to_info=False, **arguments).unwrapped


def matrix(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    return np.array(
        [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
         [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
         [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*A Box (observation|action) space:UserWarning")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*For Box action spaces, we recommend using a symmetric and normalized space")
def test_gymnasium_check_env_passes() -> None:
    check_env(reach(), skip_render_check=True)


def test_every_element_says_what_it_is() -> None:
    described = type(reach()).describe()
    observed = described["observation"]
    joints = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    assert [one.get("joint") for one in observed[:12]] == [f"{joint}_joint" for joint in joints] * 2
    assert [one["quantity"] for one in observed] == [
        *["joint position"] * 6, *["joint velocity"] * 6, *["position"] * 3, *["quaternion"] * 4,
    ]  # fmt: skip
    assert {one["frame"] for one in observed[12:]} == {"base"}
    assert "".join(one["axis"] for one in observed[15:]) == "xyzw"
    assert "".join(one["axis"] for one in type(reach()).describe(quaternion="wxyz")["observation"][15:]) == "wxyz"
    assert {(one["quantity"], one["unit"], one["scale"], one["offset"]) for one in described["action"]} == {
        ("joint position", "rad", 1.0, 0.0)
    }
    assert described["control_rate_hz"] == 60.0
    with pytest.raises(ValueError, match="quaternion is 'zyxw': expected xyzw or wxyz"):
        reach(quaternion="zyxw")


def test_target_is_observed_in_the_pendants_frame_as_urs_own_kinematics_have_it() -> None:
    env, rng = reach(), np.random.default_rng(0)
    assert env.reset(seed=0)[0][:12] == pytest.approx([*START, *[0.0] * 6], abs=1e-6)
    for _ in range(5):
        joints = START + rng.uniform(-0.5, 0.5, 6)
        position, axes, _ = env.simulation.tool_frame_at(joints)
        turned = np.diag([-1.0, -1.0, 1.0])  # base_link to base
        wanted = flange(joints)
        np.testing.assert_allclose(turned @ position, wanted[:3, 3], atol=1e-9)
        np.testing.assert_allclose(turned @ axes, wanted[:3, :3], atol=1e-9)
        seen = reach(target="joints:" + ",".join(map(str, joints))).reset(seed=1)[0]
        np.testing.assert_allclose(seen[12:15], wanted[:3, 3], atol=1e-6)
        np.testing.assert_allclose(matrix(*seen[15:].tolist()), wanted[:3, :3], atol=1e-6)


@pytest.mark.parametrize("target", ["base:0.9,-0.2,0.25", "base_link:-0.9,0.2,0.25,3.14159265,0,1.57079633"])
def test_target_given_in_either_frame_is_the_same(target: str) -> None:
    seen = reach(target=target).reset(seed=1)[0]
    assert seen[12:] == pytest.approx([0.9, -0.2, 0.25, HALF, -HALF, 0.0, 0.0], abs=1e-6)
    seen = reach(target=target, quaternion="wxyz").reset(seed=1)[0]
    assert seen[15:] == pytest.approx([0.0, HALF, -HALF, 0.0], abs=1e-6)


def test_targets_are_drawn_in_isaac_labs_ranges_with_its_sign() -> None:
    env = reach()
    drawn = np.array([env.reset(seed=seed)[0][12:] for seed in range(300)])
    middle, half = [0.8875, -0.225, 0.2], [0.25, 0.125, 0.1]
    assert (np.abs(drawn[:, :3] - middle).max(axis=0) <= np.array(half) + 1e-6).all()
    assert np.abs(drawn[:, :3] - middle).max(axis=0) == pytest.approx(half, abs=0.02)
    turns = np.array([matrix(*one) for one in drawn[:, 3:].tolist()])
    pitch = np.arcsin(-turns[:, 2, 0])
    roll = np.arctan2(turns[:, 2, 1], turns[:, 2, 2]) % (2 * math.pi)
    yaw = (np.arctan2(turns[:, 1, 0], turns[:, 0, 0]) + math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
    for angle, middle_of, reach_of in ((pitch, 0.0, math.pi / 6), (roll, math.pi, math.pi / 6), (yaw, 0.0, 2.0944)):
        assert np.abs(angle - middle_of).max() == pytest.approx(reach_of, abs=0.08) and angle.std() > reach_of / 3
    halves = roll / 2, pitch / 2, (yaw - math.pi / 2) / 2  # as isaaclab.utils.math.quat_from_euler_xyz has it
    (cr, cp, cy), (sr, sp, sy) = ([turn(angle) for angle in halves] for turn in (np.cos, np.sin))
    wanted = np.stack([cy * sr * cp - sy * cr * sp, cy * cr * sp + sy * sr * cp,
                       sy * cr * cp - cy * sr * sp, cy * cr * cp + sy * sr * sp], axis=1)  # fmt: skip
    np.testing.assert_allclose(drawn[:, 3:], wanted, atol=1e-5)


def test_solution_reaches_each_target_by_steps_from_the_present_position() -> None:
    env = reach()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        done, info = False, {}
        while not done:
            way = env.solution() - observation[:6]
            observation, _, terminated, truncated, info = env.step(observation[:6] + np.clip(0.5 * way, -0.1, 0.1))
            done = terminated or truncated
        assert info["final_status"] == "success" and info["dist_coord"] <= 0.02 and info["dist_rot"] < 0.05
    assert env.reset()[0][:6] == pytest.approx(observation[:6], abs=1e-6)  # goes on from there


def test_arm_follows_near_targets_as_isaac_labs_drives_do_and_stops_at_its_limits() -> None:
    env = reach(max_velocity_scale_factor=1.0)
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        observation, *_ = env.step(observation[:6] + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert observation[6] == pytest.approx(18 * 0.01, rel=0.1)  # [rad/s]: 1320 / 72.66 times the way
    near_limit = [2 * math.pi - 0.05, *START[1:]]
    env.reset(seed=0, options={"joint_positions": near_limit})
    for _ in range(60):
        observation, *_ = env.step([9.0, *START[1:]])
    assert observation[0] == pytest.approx(2 * math.pi, abs=0.01)
