"""The UR positioning environment against robo-gym's contract."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.ur.end_effector_positioning import EndEffectorPositioningURSim
from rlservo.robots.argument_checks import InvalidResetError
from rlservo.robots.ur.parameters import UR_PARAMETERS

ENV_ID = "rlservo/EndEffectorPositioningURSim-v0"
START = [0.0, -2.5, 1.5, -1.5, -1.4, 0.0]
# Joint positions [rad] with which the arm touches itself and the ground: robo-gym's test_ur_ee_positioning.py.
TOUCHING = {
    "ur3": ([0.0, 0.0, -3.14, -1.77, 1.0], [0.0, 2.64, -1.95, -2.98, 0.41]),
    "ur3e": ([0.0, -1.88, 2.8, -0.75, -1.88], [1.13, 1.88, -2.19, -3.43, 2.43]),
    "ur5": ([0.0, -1.26, -3.14, 0.0, 0.0], [0.0, 1.0, 1.8, 0.0, 0.0]),
    "ur5e": ([0.0, -0.5, -3.14, 3.14, 0.0], [0.0, 3.52, -2.58, 0.0, 0.0]),
    "ur10": ([0.0, -1.5, 3.14, 0.0, 0.0], [0.0, 1.0, 1.15, 0.0, 0.0]),
    "ur10e": ([0.0, -0.15, -2.83, -2.51, 1.63], [-2.14, -0.13, 0.63, -1.13, 1.63]),
    "ur16e": ([0.0, -1.15, 2.9, -0.19, 0.42], [0.0, -0.15, 1.32, 0.0, 1.63]),
}
LIMITS = np.array([2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi])


def make(**arguments: Any) -> EndEffectorPositioningURSim:
    env = gym.make(ENV_ID, **arguments).unwrapped
    assert isinstance(env, EndEffectorPositioningURSim)
    return env


def hold_action(env: EndEffectorPositioningURSim) -> np.ndarray:
    """The action that commands the arm to where it is."""
    position = env.simulation.joint_positions
    action = position / LIMITS
    action[3] = 2 * (position[3] + 3.48) / (0.31 + 3.48) - 1
    return action[:5].astype(np.float32)


def test_spaces_are_robo_gyms() -> None:
    env = make()
    high = [math.inf] * 3 + [1.1] * 6 + [math.inf] * 12 + [1.01] * 6
    assert env.observation_space.shape == (27,)
    assert env.observation_space.dtype == np.float32
    assert env.observation_space.high.tolist() == pytest.approx(high)
    assert env.observation_space.low.tolist() == pytest.approx([-h for h in high])
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
    assert make(fix_wrist_3=False).action_space.shape == (6,)
    assert make(fix_base=True, fix_elbow=True).action_space.shape == (3,)


def test_first_observation_is_composed_as_in_the_contract() -> None:
    env = make()
    target = [0.3, -0.4, 0.5]
    observation, info = env.reset(seed=1, options={"ee_target_pose": [*target, 0.0, 0.0, 0.0]})
    assert info == {}
    assert observation[3:9] == pytest.approx((np.array(START) / LIMITS).tolist(), abs=1e-6)
    assert observation[9:15] == pytest.approx([0.0] * 6, abs=1e-6)
    assert observation[15:18] == pytest.approx(target)
    tool = observation[18:21]
    assert observation[0] == pytest.approx(float(np.linalg.norm(np.array(target) - tool)), rel=1e-5)
    local = env.simulation.tool_rotation.T @ (np.array(target) - env.simulation.tool_position)
    assert observation[1] == pytest.approx(math.acos(local[2] / np.linalg.norm(local)), rel=1e-5)
    assert observation[2] == pytest.approx(math.atan2(local[1], local[0]), rel=1e-5)
    assert observation[21:27].tolist() == [0.0] * 6


def test_previous_action_lags_one_step_and_holds_the_fixed_joint() -> None:
    env = make()
    env.reset(seed=1, options={"joint_positions": [*START[:5], 0.5], "ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    first, second = hold_action(env), hold_action(env) + np.float32(0.001)
    observation, *_ = env.step(first)
    assert observation[21:27].tolist() == [0.0] * 6
    observation, *_ = env.step(second)
    assert observation[21:27] == pytest.approx([*first, 0.5 / (2 * math.pi)], abs=1e-6)


def test_action_is_absolute_joint_positions_and_wrist_1_is_restricted() -> None:
    env = make(max_velocity_scale_factor=1.0)
    env.reset(seed=1, options={"ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    goal = np.array(START) + [0.3, 0.2, -0.2, 0.4, 0.3, 0.0]
    action = goal / LIMITS
    action[3] = 2 * (goal[3] + 3.48) / (0.31 + 3.48) - 1
    for _ in range(30):
        env.step(action[:5])
    assert env.simulation.joint_positions == pytest.approx(goal.tolist(), abs=2e-3)


def test_unrestricted_wrist_1_uses_its_whole_range() -> None:
    env = make(max_velocity_scale_factor=1.0, restrict_wrist_1=False)
    env.reset(seed=1, options={"ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    action = (np.array(START) / LIMITS)[:5]
    action[3] = -0.3
    for _ in range(30):
        env.step(action)
    assert env.simulation.joint_positions[3] == pytest.approx(-0.3 * 2 * math.pi, abs=2e-3)


def test_velocity_scale_limits_the_joints() -> None:
    env = make()
    env.reset(seed=1, options={"ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    action = hold_action(env)
    action[0] = 1.0
    for _ in range(10):
        observation, *_ = env.step(action)
        assert abs(observation[9]) <= 0.1 * math.pi * 1.05
    assert env.simulation.joint_positions[0] == pytest.approx(0.1 * math.pi, rel=0.1)  # one second at 0.314 rad/s


def test_step_reward_is_the_distance_penalty() -> None:
    env = make()
    env.reset(seed=1, options={"ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    observation, reward, terminated, truncated, _ = env.step(hold_action(env))
    assert reward == pytest.approx(-0.005 * float(observation[0]))
    assert not terminated
    assert not truncated


def test_reaching_the_target_is_success() -> None:
    env = make()
    env.reset(seed=1)
    near = env.simulation.tool_position + [0.05, 0.0, 0.05]
    env.reset(seed=1, options={"ee_target_pose": [*near, 0, 0, 0]})
    _, reward, terminated, truncated, info = env.step(hold_action(env))
    assert (reward, terminated, truncated) == (2.0, True, False)
    assert info["final_status"] == "success"
    assert info["is_success"] is True
    assert info["target_coord"] == pytest.approx(near)


def test_the_threshold_is_a_tenth_of_a_metre() -> None:
    env = make()
    env.reset(seed=1)
    tool = env.simulation.tool_position
    for distance, expected in ((0.0999, True), (0.1001, False)):
        env.reset(options={"ee_target_pose": [tool[0], tool[1], tool[2] + distance, 0, 0, 0]})
        assert env.step(hold_action(env))[2] is expected


def test_collision_ends_the_episode_even_at_the_target() -> None:
    env = make(max_velocity_scale_factor=1.0)
    env.reset(seed=1, options={"ee_target_pose": [0.0, 0.0, 3.0, 0, 0, 0]})
    action = hold_action(env)
    action[1] = 0.2  # the shoulder past the horizontal: the upper arm meets the table
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(action)
        if terminated:
            break
    assert (reward, terminated, truncated) == (-1.0, True, False)
    assert info["final_status"] == "collision"
    assert info["is_success"] is False


def test_three_hundred_steps_truncate() -> None:
    env = make(rs_state_to_info=False)
    env.reset(seed=1, options={"ee_target_pose": [0.5, 0.5, 0.2, 0, 0, 0]})
    action = hold_action(env)
    for step in range(1, 301):
        _, reward, terminated, truncated, info = env.step(action)
        assert truncated is (step == 300)
        assert not terminated
    assert info["final_status"] == "max_steps_exceeded"
    assert reward < 0


@pytest.mark.parametrize("ur_model", list(UR_PARAMETERS))
def test_random_targets_fill_the_workspace(ur_model: str) -> None:
    env = make(ur_model=ur_model)
    arm = UR_PARAMETERS[ur_model]
    targets = np.array([env.reset(seed=seed)[0][15:18] for seed in range(300)])
    radius = np.linalg.norm(targets, axis=1)
    assert radius.max() <= arm.workspace_radius + 1e-6
    assert np.linalg.norm(targets[:, :2], axis=1).min() > arm.workspace_min_radius - 1e-6
    assert targets[:, 2].min() >= 0.0
    assert np.median(radius) > 0.75 * arm.workspace_radius  # uniform in volume: most lie far out
    assert {(x > 0, y > 0) for x, y, _ in targets.tolist()} == {(a, b) for a in (True, False) for b in (True, False)}


def test_randomised_starts_stay_in_range_and_never_collide() -> None:
    env = make()
    spread = np.array([1.5, 0.25, 0.5, 1.0, 0.4, 3.14])
    starts = []
    for seed in range(200):
        observation, _ = env.reset(seed=seed, options={"randomize_start": True})
        assert not env.simulation.in_collision
        starts.append(observation[3:9] * LIMITS)
    offsets = np.array(starts) - START
    assert (np.abs(offsets) <= spread + 1e-5).all()
    assert (np.abs(offsets).max(axis=0) > 0.8 * spread).all()


def test_continue_on_success_starts_where_the_last_success_ended() -> None:
    env = make()
    env.reset(seed=1)
    near = env.simulation.tool_position + [0.05, 0.0, 0.05]
    env.reset(options={"ee_target_pose": [*near, 0, 0, 0]})
    action = hold_action(env)
    action[0] += 0.05
    assert env.step(action)[4]["final_status"] == "success"
    ended = env.simulation.joint_positions.copy()
    env.reset(options={"continue_on_success": True})
    assert env.simulation.joint_positions == pytest.approx(ended)
    env.reset(options={})
    assert env.simulation.joint_positions == pytest.approx(START)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"joint_position": START}, r"'joint_position' does not exist: expected one of joint_positions, ee_target"),
        ({"joint_positions": [0.0] * 5}, r"shape \(5,\), expected \(6,\)"),
        ({"joint_positions": [0, 0, 4.0, 0, 0, 0]}, r"elbow is 4 rad, expected within \+-3.14159 rad"),
        ({"joint_positions": [0, 0.3, 0, 0, 0, 0]}, r"start joint positions collide: .* touch"),
        ({"ee_target_pose": [math.nan] * 6}, r"element 0 is not finite"),
    ],
)
def test_impossible_reset_options_are_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InvalidResetError, match=sentence):
        make().reset(seed=1, options=options)


def test_robo_gyms_constructor_arguments_are_accepted_and_others_refused() -> None:
    env = make(ip="127.0.0.1", lower_bound_port=50100, upper_bound_port=50200, gui=False, rs_address="127.0.0.1:1")
    assert env.action_space.shape == (5,)
    with pytest.raises(TypeError, match="unexpected keyword argument 'ur_modell'"):
        make(ur_modell="ur5")
    with pytest.raises(ValueError, match="all 6 joints are fixed"):
        make(fix_base=True, fix_shoulder=True, fix_elbow=True, fix_wrist_1=True, fix_wrist_2=True)


@pytest.mark.parametrize("which", [0, 1], ids=["itself", "ground"])
@pytest.mark.parametrize("ur_model", list(TOUCHING))
def test_an_arm_that_is_driven_into_something_collides(ur_model: str, which: int) -> None:
    """With a target out of the way: one that is drawn ends about 1 in 60 of these episodes first, as a success."""
    env = make(ur_model=ur_model, restrict_wrist_1=False)
    env.reset(options={"ee_target_pose": [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]})
    action = np.float32(TOUCHING[ur_model][which] / LIMITS[:5])
    info: dict[str, Any] = {}
    while "final_status" not in info:
        info = env.step(action)[4]
    assert info["final_status"] == "collision"


def test_robot_server_state_is_in_info_only_when_asked_for() -> None:
    env = make()
    env.reset(seed=1)
    info = env.step(hold_action(env))[4]
    assert len(info["rs_state"]) == 27
    quiet = make(rs_state_to_info=False)
    quiet.reset(seed=1)
    assert "rs_state" not in quiet.step(hold_action(quiet))[4]
