"""Isaac reach: spaces, figures, rewards and endings of robo-gym 2.1's task."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.ur.isaac_reach import DEFAULT_JOINTS, IsaacReachURSim, quaternion_of, rotation_of
from rlservo.robots.ur.simulation import URSimulation

ID = "rlservo/IsaacReachURSim-v0"
TWO_PI = 2 * math.pi


def reach(**arguments: Any) -> IsaacReachURSim:
    env = gym.make(ID, **arguments).unwrapped
    assert isinstance(env, IsaacReachURSim)
    return env


def test_spaces_and_names_are_isaac_labs() -> None:
    env = reach()
    assert env.observation_space.shape == (25,)
    elbow = (math.pi - 1.712) / 0.5
    assert env.action_space.high == pytest.approx([TWO_PI / 0.5, (TWO_PI + 1.712) / 0.5, elbow, *[TWO_PI / 0.5] * 3])
    description = IsaacReachURSim.describe()
    names = [element["name"] for element in description["observation"]]
    assert names[:2] == ["base_position_offset", "shoulder_position_offset"]
    assert names[12:] == [
        "target_x", "target_y", "target_z", "target_qw", "target_qx", "target_qy", "target_qz",
        *(f"{joint}_last_action" for joint in ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")),
    ]  # fmt: skip
    assert len(description["action"]) == 6 and description["control_rate_hz"] == 30.0


def test_an_observation_holds_the_target_as_a_quaternion_and_the_last_action() -> None:
    env = reach()
    first, _ = env.reset(seed=1, options={"ee_target_pose": [0.5, 0.1, 0.3, 0.0, math.pi / 2, 2.0]})
    cosine, sine = math.cos(1.0) / math.sqrt(2), math.sin(1.0) / math.sqrt(2)
    assert first[12:] == pytest.approx([0.5, 0.1, 0.3, cosine, -sine, cosine, sine, *[0.0] * 6], abs=1e-6)
    action = np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.1], np.float32)
    assert env.step(action)[0][19:] == pytest.approx(action)


def test_targets_are_drawn_in_isaac_labs_box_with_the_flange_down() -> None:
    env = reach()
    drawn = np.array([env.reset(seed=seed)[0][12:19] for seed in range(200)])
    assert (drawn[:, :3].min(axis=0) >= [0.35, -0.2, 0.15]).all() and (
        drawn[:, :3].max(axis=0) <= [0.65, 0.2, 0.5]
    ).all()
    assert drawn[:, :3].max(axis=0) - drawn[:, :3].min(axis=0) == pytest.approx([0.3, 0.4, 0.35], abs=0.03)
    axes = np.array([rotation_of(quaternion.astype(np.float64))[:, 0] for quaternion in drawn[:, 3:]])
    assert axes == pytest.approx(np.tile([0.0, 0.0, -1.0], (200, 1)), abs=1e-6)


def test_tool1_is_tool0_turned_as_robo_gym_says() -> None:
    arms = [URSimulation("ur10", tool=tool, table="isaac") for tool in ("tool0", "tool1")]
    for arm in arms:
        arm.place(DEFAULT_JOINTS)
    yaw, pitch = 3.1415, -1.5707
    turned = rotation_of(quaternion_of(0.0, pitch, yaw))
    assert arms[1].tool_rotation == pytest.approx(arms[0].tool_rotation @ turned, abs=2e-4)
    assert arms[1].tool_position == pytest.approx(arms[0].tool_position)


def test_the_solution_ends_at_the_target_with_success() -> None:
    env = reach()
    for seed in range(4):
        env.reset(seed=seed)
        action = env.solution().astype(np.float32)
        done, steps, info, reward = False, 0, {}, 0.0
        while not done:
            _, reward, terminated, truncated, info = env.step(action)
            done, steps = terminated or truncated, steps + 1
        assert (info["final_status"], reward) == ("success", 2.0) and steps < 400
        assert info["dist_coord"] <= 0.02 and info["dist_rot"] < 0.05


@pytest.mark.parametrize(
    ("away", "turned", "status"),
    [(0.019, 0.0, "success"), (0.021, 0.0, None), (0.0, 0.049, "success"), (0.0, 0.051, None)],
)
def test_position_and_orientation_both_count(away: float, turned: float, status: str | None) -> None:
    env = reach()
    pose = np.array([0.5, 0.0, 0.3, 0.0, math.pi / 2, 0.5])
    env.reset(seed=0, options={"ee_target_pose": pose.tolist()})
    action = env.solution()
    joints = action * 0.5 + DEFAULT_JOINTS
    moved = pose + [away, 0.0, 0.0, 0.0, 0.0, turned]
    env.reset(seed=0, options={"ee_target_pose": moved.tolist(), "joint_positions": joints.tolist()})
    _, reward, terminated, _, info = env.step(action.astype(np.float32))
    assert info.get("final_status") == status and terminated == (status is not None)
    assert reward == pytest.approx(2.0 if status else -0.005 * away - 0.05 * turned, abs=1e-5)


def test_an_episode_goes_on_where_the_last_one_ended_unless_a_seed_is_given() -> None:
    env = reach()
    env.reset(seed=0)
    done = False
    while not done:
        observation, _, terminated, truncated, _ = env.step(env.solution().astype(np.float32))
        done = terminated or truncated
    assert env.reset()[0][:6] == pytest.approx(observation[:6], abs=1e-6)
    assert env.reset(seed=0)[0][:6] == pytest.approx(np.zeros(6))
    env = reach(continue_except_collision=False)
    env.reset(seed=0)
    env.step(env.solution().astype(np.float32))
    assert env.reset()[0][:6] == pytest.approx(np.zeros(6))


def test_the_table_stops_the_arm() -> None:
    env = reach()
    env.reset(seed=0)
    down = ((np.array([0.0, 0.3, 1.0, 0.0, 0.0, 0.0]) - DEFAULT_JOINTS) / 0.5).astype(np.float32)
    info: dict[str, Any] = {}
    for _ in range(300):
        _, reward, terminated, _, info = env.step(down)
        if terminated:
            break
    assert info["final_status"] == "collision" and reward == -1.0
    assert env.reset()[0][:6] == pytest.approx(np.zeros(6)), "a collision is not gone on from"
