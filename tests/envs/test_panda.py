"""The Panda: its kinematics against Franka's own table, and robo-gym 2.1's two environments."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.panda.arm_env import EmptyEnvironmentPandaSim
from rlservo.envs.panda.end_effector_positioning import EndEffectorPositioningPandaSim
from rlservo.envs.randomization import DomainRandomization
from rlservo.robots.argument_checks import InvalidActionError, InvalidResetError
from rlservo.robots.panda.model import HIGH, LOW
from rlservo.robots.panda.simulation import PandaSimulation

EMPTY, POSITIONING = "rlservo/EmptyEnvironmentPandaSim-v0", "rlservo/EndEffectorPositioningPandaSim-v0"
BOTH = pytest.mark.parametrize("env_id", [EMPTY, POSITIONING])
START = np.array([-0.018, -0.76, 0.02, -2.342, 0.03, 1.541, 0.753])
# a, d [m] and alpha [rad] of joints 1 to 7 and the flange, in Craig's convention: Franka's documentation.
TABLE = [
    (0.0, 0.333, 0.0), (0.0, 0.0, -math.pi / 2), (0.0, 0.316, math.pi / 2), (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2), (0.0, 0.0, math.pi / 2), (0.088, 0.0, math.pi / 2), (0.0, 0.107, 0.0),
]  # fmt: skip


def positioning(**arguments: Any) -> EndEffectorPositioningPandaSim:
    env = gym.make(POSITIONING, **arguments).unwrapped
    assert isinstance(env, EndEffectorPositioningPandaSim)
    return env


def hand(joints: np.ndarray) -> np.ndarray:
    """Return panda_hand's pose (4, 4): the flange turned by -45 degrees."""
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(TABLE, [*joints, -math.pi / 4], strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array(
            [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    return pose


def test_the_hand_is_where_frankas_table_has_it() -> None:
    arm, rng = PandaSimulation(table=False), np.random.default_rng(0)
    for joints in [START, *rng.uniform(LOW, HIGH, (20, 7))]:
        arm.place(joints)
        pose = hand(joints)
        assert arm.tool_position == pytest.approx(pose[:3, 3], abs=1e-9)
        assert arm.tool_rotation == pytest.approx(pose[:3, :3], abs=1e-9)


@BOTH
def test_description_has_robo_gyms_names(env_id: str) -> None:
    description = type(gym.make(env_id).unwrapped).describe()
    assert len(description["observation"]) == {EMPTY: 14, POSITIONING: 29}[env_id]
    assert [element["name"] for element in description["action"]][-1] == "panda_joint6_position_normalized"


def test_an_action_is_normalised_between_limits_that_are_not_symmetric() -> None:
    env = gym.make(EMPTY, fix_panda_joint7=False, rs_state_to_info=True).unwrapped
    assert isinstance(env, EmptyEnvironmentPandaSim)
    observation, _ = env.reset(seed=0)
    low, high = np.array(LOW), np.array(HIGH)
    assert observation[:7] == pytest.approx((START - low) / (high - low) * 2 - 1, abs=1e-6)
    target = START + 0.05
    action = ((target - low) / (high - low) * 2 - 1).astype(np.float32)
    for _ in range(120):  # each cycle covers a fifteenth of the way
        _, reward, _, _, info = env.step(action)
    assert reward == 0.0
    assert [info["rs_state"][f"joint{n}_position"] for n in range(1, 8)] == pytest.approx(target, abs=1e-3)
    assert env.simulation.joint_velocities == pytest.approx(np.zeros(7), abs=1e-3)


def test_no_joint_is_commanded_faster_than_its_scaled_limit() -> None:
    env = positioning()
    env.reset(seed=0)
    largest = np.zeros(7)
    for step in range(60):
        env.step(np.full(6, 0.4 if step % 20 < 10 else -0.4, np.float32))
        largest = np.maximum(largest, np.abs(env.simulation.commanded_velocity))
    assert (largest <= 0.2 * np.array([2.175] * 4 + [2.61] * 3) + 1e-9).all() and largest[1] > 0.43


def test_positioning_ends_with_success_near_the_target_and_pays_for_distance() -> None:
    env = positioning()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert observation[0] == pytest.approx(math.dist(observation[17:20], observation[20:23]), abs=1e-6)
        action, info, done = env.solution().clip(-1, 1).astype(np.float32), {}, False
        while not done:
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            if not done:
                assert reward == pytest.approx(-0.005 * observation[0], abs=1e-6) and observation[0] > 0.1
        assert info["final_status"] == "success" and reward == 2.0 and info["dist_coord"] <= 0.1
        assert observation[23:] == pytest.approx(action)


def test_a_collision_with_the_table_ends_an_episode() -> None:
    env = positioning()
    env.reset(seed=0)
    low, high = np.array(LOW), np.array(HIGH)
    down = np.array([0.0, 1.2, 0.0, -1.2, 0.0, 1.5, 0.753])
    action = ((down - low) / (high - low) * 2 - 1)[:6].astype(np.float32)
    info: dict[str, Any] = {}
    for _ in range(300):
        _, reward, terminated, _, info = env.step(action)
        if terminated:
            break
    assert info["final_status"] == "collision" and reward == -1.0 and not info["is_success"]


def test_what_cannot_be_asked_for_is_refused_by_name() -> None:
    env = positioning()
    with pytest.raises(InvalidResetError, match=r"panda_joint4 is 0.5 rad, expected within -3.0718 .. -0.0698 rad"):
        env.reset(options={"joint_positions": [0.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0]})
    with pytest.raises(InvalidResetError, match="'continue_on_success' does not exist"):
        env.reset(options={"continue_on_success": True})
    env.reset(seed=0)
    with pytest.raises(InvalidActionError, match=r"element 5 \(panda_joint6_position_normalized\) is 1.5"):
        env.step([0, 0, 0, 0, 0, 1.5])
    with pytest.raises(ValueError, match="all 7 joints are fixed"):
        gym.make(EMPTY, **{f"fix_panda_joint{number}": True for number in range(1, 8)})


def test_it_can_be_disturbed_as_an_arm() -> None:
    disturbed = DomainRandomization(
        positioning(), observation_noise="real", observation_bias="real", payload=(2.0, 2.0), model_error=0.05,
        base_offset=(0.01, 0.01),
    )  # fmt: skip
    observation, info = disturbed.reset(seed=0)
    plain, _ = positioning().reset(seed=0)
    assert 0.001 < np.abs(observation[17:20] - plain[17:20]).max() < 0.05
    assert info["randomization"]["payload"] == 2.0 and len(info["randomization"]["model_error"]["friction"]) == 7
