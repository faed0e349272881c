"""EmptyEnvironment and BasicAvoidance: spaces, figures, rewards and endings of robo-gym's tasks."""

from __future__ import annotations

import itertools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.ur.basic_avoidance import BasicAvoidanceURSim
from rlservo.envs.ur.empty_environment import EmptyEnvironmentURSim
from rlservo.robots.argument_checks import InvalidResetError

# robo-gym's bounds: three elements of BasicAvoidance are always zero.
pytestmark = pytest.mark.filterwarnings("ignore:.*A Box observation space maximum and minimum values are equal")

EMPTY, AVOIDANCE = "rlservo/EmptyEnvironmentURSim-v0", "rlservo/BasicAvoidanceURSim-v0"
BOTH = pytest.mark.parametrize("env_id", [EMPTY, AVOIDANCE])
LIMITS = np.array([2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi])
AVOIDANCE_START = np.array([-1.57, -1.31, -1.31, -2.18, 1.57, 0.0])
FAR = [0.0, 0.9, 1.0]  # an object that is not in the way


def empty(**arguments: Any) -> EmptyEnvironmentURSim:
    env = gym.make(EMPTY, **arguments).unwrapped
    assert isinstance(env, EmptyEnvironmentURSim)
    return env


def avoidance(**arguments: Any) -> BasicAvoidanceURSim:
    env = gym.make(AVOIDANCE, **arguments).unwrapped
    assert isinstance(env, BasicAvoidanceURSim)
    return env


# -- both


@BOTH
def test_impossible_start_is_refused(env_id: str) -> None:
    env = gym.make(env_id).unwrapped
    with pytest.raises(InvalidResetError, match="elbow is 4 rad, expected within"):
        env.reset(options={"joint_positions": [0, 0, 4, 0, 0, 0]})
    with pytest.raises(InvalidResetError, match="collide: world and"):
        env.reset(options={"joint_positions": [0, 0.6, 0, 0, 0, 0]})
    with pytest.raises(InvalidResetError, match="'goal' does not exist: expected one of joint_positions"):
        env.reset(options={"goal": 1})


# -- EmptyEnvironment


def test_empty_observation_is_normalised_positions_and_velocities() -> None:
    env = empty()
    observation, info = env.reset(seed=0)
    assert info == {}
    start = np.array([0.0, -2.5, 1.5, 0.0, -1.4, 0.0])
    assert observation[:6] == pytest.approx(start / LIMITS, abs=1e-6)
    assert observation[6:] == pytest.approx(np.zeros(6), abs=1e-6)
    assert env.observation_space.high.tolist() == pytest.approx([1.1] * 6 + [math.inf] * 6)
    target = np.array([0.2, -0.35, 0.4, 0.1, -0.2], dtype=np.float32)
    for _ in range(250):
        observation, reward, terminated, truncated, info = env.step(target)
        assert reward == 0.0
        assert not terminated
        assert not truncated
    assert observation[:5] == pytest.approx(target, abs=2e-3)
    assert observation[5] == pytest.approx(0.0, abs=1e-4)  # fixed
    assert set(info["rs_state"]) >= {"in_collision", "ee_to_ref_translation_x"}
    assert len(info["rs_state"]) == 20


def test_empty_ends_with_success_after_300_steps_and_with_collision_on_the_ground() -> None:
    env = empty(rs_state_to_info=False)
    env.reset(seed=0)
    hold = (env.simulation.joint_positions / LIMITS)[:5].astype(np.float32)
    for step in range(1, 301):
        _, _, terminated, truncated, info = env.step(hold)
        assert truncated == (step == 300)
    assert not terminated
    assert info == {"final_status": "success", "is_success": True}

    env.reset(seed=0)
    for _ in range(300):
        _, _, terminated, truncated, info = env.step([0.0, 0.06, 0.0, 0.0, 0.0])
        if terminated:
            break
    assert terminated
    assert info == {"final_status": "collision", "is_success": False}
    assert env.simulation.model.ngeom > 0
    assert "table" not in {env.simulation.model.geom(i).name for i in range(env.simulation.model.ngeom)}


# -- BasicAvoidance


def test_avoidance_observation_is_object_polar_joints_and_offsets() -> None:
    env = avoidance(include_polar_to_elbow=True)
    observation, _ = env.reset(seed=0, options={"fixed_object_position": FAR})
    for _ in range(10):
        observation, *_ = env.step([0.3, -0.2, 0.1, 0.0, 0.4])
    sim = env.simulation
    for part, origin, rotation in (
        (observation[0:3], sim.tool_position, sim.tool_rotation),
        (observation[15:18], sim.forearm_position, sim.forearm_rotation),
    ):
        r, theta, phi = part.tolist()
        point = [
            r * math.sin(theta) * math.cos(phi),
            r * math.sin(theta) * math.sin(phi),
            r * math.cos(theta),
        ]
        assert origin + rotation @ point == pytest.approx(FAR, abs=1e-5)
    assert observation[3:9] == pytest.approx(sim.joint_positions / LIMITS, abs=1e-6)
    assert observation[9:15] == pytest.approx((sim.joint_positions - AVOIDANCE_START) / LIMITS, abs=1e-6)
    plain, _ = avoidance().reset(seed=0, options={"fixed_object_position": FAR})
    assert plain[15:].tolist() == [0.0, 0.0, 0.0]


def test_avoidance_forearm_frame_is_the_elbow_by_denavit_hartenberg() -> None:
    env = avoidance()
    env.reset(seed=0, options={"fixed_object_position": FAR})
    arm = env.simulation.parameters
    base, shoulder = AVOIDANCE_START[:2]
    # The elbow is at |a2| along the upper arm, which the shoulder lifts by -q; base_link is turned by pi.
    along, up = arm.a2 * math.cos(shoulder), -arm.a2 * math.sin(shoulder) * -1
    expected = [-along * math.cos(base), -along * math.sin(base), arm.d1 + up]
    assert env.simulation.forearm_position == pytest.approx(expected, abs=1e-6)


def test_avoidance_ball_follows_the_triangle_wave_20_cycles_ahead() -> None:
    env = avoidance()
    env.reset(seed=0, options={"z_amplitude": 0.2, "z_offset": 0.6})
    path = 0.6 + 0.2 * (1 - np.abs(2 - 4 * np.linspace(0, 1, 800)))
    for cycle in range(20, 250):
        x, y, z = env.simulation.object_position(0).tolist()
        assert (x, y) == (0.12, 0.34)
        assert z == pytest.approx(path[5 * cycle % 800], abs=1e-9)
        env.step(np.zeros(5))


def test_avoidance_reward_is_robo_gyms() -> None:
    env = avoidance()
    env.reset(seed=0, options={"fixed_object_position": FAR})
    previous = np.zeros(6)
    seen = set()
    actions = itertools.cycle([[0.3, 0, 0, 0, 0], [-0.3, 0.9, 0, 0.6, 0], [0, 0, 0, 0, 0]])
    for _ in range(30):
        action = np.array(next(actions), dtype=np.float32)
        observation, reward, *_ = env.step(action)
        six = np.append(action, 0.0)
        expected = 0.0
        if np.abs(observation[-6:]).sum() < 0.6:
            expected += (1 - np.abs(observation[9:15]).sum() / 0.6) / 1000
        expected += (1 - np.square(six).sum() / 6) / 1000
        rapid = int((np.abs(six - previous) > 0.5).sum())
        seen.add(rapid)
        expected -= 0.2 * rapid / 1000
        previous = six
        assert reward == pytest.approx(expected, abs=1e-8)
    assert len(seen) >= 3


def test_avoidance_costs_two_thousandths_while_the_ball_is_close() -> None:
    env = avoidance()
    env.reset(seed=0)
    tool = env.simulation.tool_position
    rewards = {}
    for name, position in (("far", FAR), ("near", (tool + [0.0, 0.2, 0.1]).tolist())):
        env.reset(seed=0, options={"fixed_object_position": position})
        _, rewards[name], terminated, _, _ = env.step(np.zeros(5))
        assert not terminated
    assert rewards["near"] - rewards["far"] == pytest.approx(-0.002, abs=1e-9)


def test_avoidance_ends_on_touching_the_ball_and_succeeds_after_1000_steps() -> None:
    env = avoidance()
    env.reset(seed=0, options={"fixed_object_position": FAR})
    for step in range(1, 1001):
        _, _, terminated, truncated, info = env.step(np.zeros(5))
        assert not terminated
        assert truncated == (step == 1000)
    assert info["final_status"] == "success"
    assert info["is_success"]
    assert info["target_coord"] == pytest.approx(FAR)
    assert len(info["rs_state"]) == 34

    tool = env.simulation.tool_position
    env.reset(seed=0, options={"fixed_object_position": (tool + [0.0, 0.12, 0.0]).tolist()})
    ended = None
    for action in ([0.4, 0, 0, 0, 0], [-0.4, 0, 0, 0, 0], [0, 0.5, 0, 0, 0], [0, -0.5, 0, 0, 0]):
        for _ in range(40):
            _, _, terminated, _, info = env.step(action)
            if terminated:
                ended = info
                break
        if ended:
            break
    assert ended is not None
    assert ended["final_status"] == "collision"
    assert not ended["is_success"]


def test_avoidance_refuses_a_ball_inside_the_arm() -> None:
    env = avoidance()
    env.reset(seed=0)
    tool = env.simulation.tool_position.tolist()
    with pytest.raises(InvalidResetError, match="the ball hits the arm before the first step"):
        env.reset(options={"fixed_object_position": tool})
    with pytest.raises(InvalidResetError, match=r"'fixed_object_position' has shape \(2,\), expected \(3,\)"):
        env.reset(options={"fixed_object_position": [1, 2]})


def test_avoidance_random_balls_are_drawn_from_robo_gyms_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    env = avoidance()
    move, drawn = env.simulation.move_objects, {}
    monkeypatch.setattr(env.simulation, "move_objects", lambda paths: (drawn.update(paths), move(paths)))
    lowest, highest = [], []
    for seed in range(60):
        env.reset(seed=seed)
        lowest.append(drawn[0][:, 2].min())
        highest.append(drawn[0][:, 2].max())
        assert not env.simulation.in_collision
    amplitude = (np.array(highest) - lowest) / 2
    offset = (np.array(highest) + lowest) / 2
    assert amplitude.min() >= 0.09 - 1e-4
    assert amplitude.max() <= 0.35 + 1e-4
    assert offset.min() >= 0.2 - 1e-4
    assert offset.max() <= 0.6 + 1e-4
    assert np.ptp(amplitude) > 0.15
    assert np.ptp(offset) > 0.25
