"""The two MiR100 environments against robo-gym's contract."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.mir100.navigation import Mir100Navigation
from rlservo.envs.mir100.no_obstacle_navigation import NoObstacleNavigationMir100Sim
from rlservo.envs.mir100.obstacle_avoidance import ObstacleAvoidanceMir100Sim
from rlservo.robots.argument_checks import InvalidResetError
from rlservo.robots.mir100.parameters import BACK_SCANNER, FRONT_SCANNER

EMPTY_ID = "rlservo/NoObstacleNavigationMir100Sim-v0"
LAB_ID = "rlservo/ObstacleAvoidanceMir100Sim-v0"
BOTH = (EMPTY_ID, LAB_ID)
STOP = np.zeros(2, dtype=np.float32)
AHEAD = np.array([1.0, 0.0], dtype=np.float32)


def make(env_id: str, **arguments: Any) -> Mir100Navigation:
    env = gym.make(env_id, **arguments).unwrapped
    assert isinstance(env, Mir100Navigation)
    return env


def make_lab(**arguments: Any) -> ObstacleAvoidanceMir100Sim:
    env = make(LAB_ID, **arguments)
    assert isinstance(env, ObstacleAvoidanceMir100Sim)
    return env


def turn_and_drive(observation: np.ndarray) -> np.ndarray:
    """Turn to the target, drive when it is ahead."""
    theta = float(observation[1])
    return np.array([1.0 if abs(theta) < 0.5 else 0.0, np.clip(2.0 * theta, -1.0, 1.0)], dtype=np.float32)


def run(env: Mir100Navigation, action: np.ndarray, limit: int = 500) -> Iterator[tuple[Any, ...]]:
    """Repeat one action until the episode ends."""
    for _ in range(limit):
        result = env.step(action)
        yield result
        if result[2] or result[3]:
            return
    raise AssertionError(f"no end within {limit} steps")


def last(env: Mir100Navigation, action: np.ndarray) -> tuple[Any, ...]:
    return list(run(env, action))[-1]


# -- Gymnasium, RLlib


# -- spaces and their elements


@pytest.mark.parametrize(("env_id", "lasers"), [(EMPTY_ID, 0), (LAB_ID, 16)])
def test_spaces_are_robo_gyms(env_id: str, lasers: int) -> None:
    env = make(env_id)
    assert env.observation_space == gym.spaces.Box(
        np.array([-math.inf, -math.pi, -1.1, -1.6] + [0.0] * lasers, dtype=np.float32),
        np.array([math.inf, math.pi, 1.1, 1.6] + [29.0] * lasers, dtype=np.float32),
        dtype=np.float32,
    )
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.mark.parametrize("env_id", BOTH)
def test_description_has_robo_gyms_names_and_units(env_id: str) -> None:
    description = type(make(env_id)).describe(laser_noise=0.0, ip="127.0.0.1")
    names = [element["name"] for element in description["observation"]]
    assert names[:4] == ["target_r", "target_theta", "linear_velocity", "angular_velocity"]
    assert [element["unit"] for element in description["observation"][:4]] == ["m", "rad", "m/s", "rad/s"]
    assert {element["unit"] for element in description["observation"][4:]} <= {"m"}


@pytest.mark.parametrize(
    ("target", "polar"),
    [
        ([1.0, 2.0, 0.0], (1.0, 0.0)),  # straight ahead of a robot that looks along +y
        ([0.0, 1.0, 0.0], (1.0, math.pi / 2)),  # to its left
        ([2.0, 1.0, 0.0], (1.0, -math.pi / 2)),  # to its right
        ([1.0 + 1e-9, -1.0, 0.0], (2.0, -math.pi)),  # behind it
        ([2.0, 2.0, 0.0], (math.sqrt(2), -math.pi / 4)),
    ],
)
def test_target_is_seen_in_the_robots_frame(target: list[float], polar: tuple[float, float]) -> None:
    env = make(EMPTY_ID)
    observation, _ = env.reset(seed=0, options={"start_pose": [1.0, 1.0, math.pi / 2], "target_pose": target})
    assert observation[0] == pytest.approx(polar[0], rel=1e-6)
    assert math.remainder(observation[1] - polar[1], 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert observation[2:4].tolist() == [0.0, 0.0]


def test_observed_velocities_are_the_robots_and_an_action_of_one_is_half_a_metre_per_second() -> None:
    env = make(EMPTY_ID)
    env.reset(seed=0, options={"start_pose": [0.0, 0.0, 2.0], "target_pose": [1.0, 1.0, 0.0]})
    *_, observation = [env.step(np.array([-1.0, 1.0], dtype=np.float32))[0] for _ in range(10)]
    assert observation[2:4] == pytest.approx([-0.5, 0.7], abs=0.003)


def test_observed_lasers_are_picked_as_robo_gym_picks_them_and_point_where_the_data_sheet_says() -> None:
    env = make_lab()
    observation, _ = env.reset(seed=5)
    indices = [round(position) for position in np.linspace(0, 1012 - 1, num=16)]
    scan = env.simulation.scan
    assert observation[4:].tolist() == scan[indices].astype(np.float32).tolist()
    angles = np.degrees(np.concatenate([FRONT_SCANNER.angles, BACK_SCANNER.angles]))[indices]
    sheet = [-75, -41.5, -7.5, 26, 60, 93.5, 127, 161, 114, 148, -178.5, -145, -111, -77.5, -43.5, -10]
    difference = [math.remainder(a - b, 360.0) for a, b in zip(angles, sheet, strict=True)]
    assert difference == pytest.approx([0.0] * 16, abs=1e-9)


def test_laser_0_looks_to_the_front_right_and_shortens_when_a_cube_stands_there() -> None:
    env = make_lab(laser_noise=0.0)
    env.reset(seed=0, options={"start_pose": [0.0, 2.5, 0.0], "target_pose": [0.0, -2.5, 0.0]})
    ahead, left, _ = FRONT_SCANNER.position
    direction = math.radians(-75.0)
    cube = (ahead + 1.5 * math.cos(direction), 2.5 + left + 1.5 * math.sin(direction), direction)
    env.simulation.place((0.0, 2.5, 0.0), cubes=[cube, (50.0, 0.0, 0.0), (52.0, 0.0, 0.0)])
    observation, *_ = env.step(STOP)
    assert observation[4] == pytest.approx(1.5 - 0.25, abs=1e-6)


# -- starts


def test_empty_floor_starts_and_targets_fill_robo_gyms_ranges() -> None:
    env = make(EMPTY_ID)
    starts, targets = [], []
    for seed in range(400):
        env.reset(seed=seed)
        starts.append(env.simulation.pose)
        targets.append(env.simulation.target)
    start, target = np.array(starts), np.array(targets)
    assert (np.abs(start) <= [2.0, 2.0, math.pi]).all()
    assert (np.abs(target) <= [1.0, 1.0, 0.0]).all()
    assert start.max(axis=0) == pytest.approx([2.0, 2.0, math.pi], abs=0.06)
    assert start.min(axis=0) == pytest.approx([-2.0, -2.0, -math.pi], abs=0.06)
    assert np.linalg.norm(start[:, :2] - target[:, :2], axis=1).min() >= 1.0


def test_lab_starts_targets_and_cubes_fill_robo_gyms_ranges_and_nothing_touches() -> None:
    env = make_lab()
    starts, targets, cubes = [], [], []
    for seed in range(400):
        env.reset(seed=seed)
        assert not env.simulation.in_collision
        assert env.simulation.scan.min() >= 0.15
        starts.append(env.simulation.pose)
        targets.append(env.simulation.target)
        cubes.append(env.simulation.cubes)
    start, target, cube = np.array(starts), np.array(targets), np.array(cubes)
    for side in (start[:, 1], target[:, 1]):
        assert np.abs(side).min() == pytest.approx(2.1, abs=0.02)
        assert np.abs(side).max() == pytest.approx(3.1, abs=0.02)
    assert (start[:, 1] * target[:, 1] < 0).all()  # on opposite sides
    assert 0.4 < (start[:, 1] > 0).mean() < 0.6
    assert (np.abs(start[:, 0]) <= 2.0).all()
    assert (np.abs(target[:, 0]) <= 2.0).all()
    assert cube.min(axis=0)[:, 0] == pytest.approx([-2.4, -0.5, 1.5], abs=0.02)
    assert cube.max(axis=0)[:, 0] == pytest.approx([-1.5, 0.5, 2.4], abs=0.02)
    assert np.abs(cube[:, :, 1]).max() == pytest.approx(1.0, abs=0.02)
    assert np.abs(cube[:, :, 2]).max() == pytest.approx(math.pi, abs=0.02)


@pytest.mark.parametrize("env_id", BOTH)
def test_reset_options_place_robot_and_target(env_id: str) -> None:
    env = make(env_id)
    for start in ([0.5, 2.6, 0.25], np.array([0.5, 2.6, 0.25])):
        env.reset(seed=0, options={"start_pose": start, "target_pose": (-0.5, -2.6, 1.0)})
        assert env.simulation.pose == pytest.approx((0.5, 2.6, 0.25), abs=1e-12)
        assert env.simulation.target == (-0.5, -2.6, 1.0)


def test_cubes_are_drawn_again_while_they_are_in_the_way_of_the_start_asked_for() -> None:
    env = make_lab()
    for seed in range(30):  # in the very middle of the cubes' columns
        env.reset(seed=seed, options={"start_pose": [0.0, 0.0, math.pi / 2]})
        assert not env.simulation.in_collision
        assert not env.step(STOP)[2]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"start_pose": [1.0, 2.0]}, r"'start_pose' has shape \(2,\), expected \(3,\)"),
        ({"target_pose": [1.0, math.nan, 0.0]}, r"'target_pose', element 1 is not finite"),
        ({"target": [1.0, 1.0, 0.0]}, r"'target' does not exist: expected one of start_pose, target_pose"),
        ({"start_pose": [2.5, 2.5, 0.0]}, r"the robot touches wall_east there, wherever the cubes stand"),
        ({"start_pose": [2.25, 2.5, 0.0]}, r"the robot is within 0.15 m of something there"),
    ],
)
def test_impossible_reset_options_are_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InvalidResetError, match=sentence):
        make_lab().reset(seed=0, options=options)


# -- rewards and endings


@pytest.mark.parametrize("env_id", BOTH)
def test_reward_is_the_hand_computed_one(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=3, options={"start_pose": [-1.0, 2.5, 0.0], "target_pose": [1.5, 2.0, 0.0]})
    action = np.array([0.8, -0.5], dtype=np.float32)
    motors = 0.30 * 0.8 + 0.03 * 0.5
    _, reward, *_ = env.step(action)
    assert reward == pytest.approx(-motors, abs=1e-6)  # robo-gym scores no progress in the first step
    before = math.dist(env.simulation.pose[:2], (1.5, 2.0))
    _, reward, *_ = env.step(action)
    after = math.dist(env.simulation.pose[:2], (1.5, 2.0))
    assert reward == pytest.approx(50.0 * (before - after) - motors, abs=1e-6)
    assert reward > 0.5  # it is driving towards the target


@pytest.mark.parametrize(("env_id", "prize"), [(EMPTY_ID, 200.0), (LAB_ID, 100.0)])
def test_arriving_within_20_cm_is_success(env_id: str, prize: float) -> None:
    env = make(env_id)
    env.reset(seed=0, options={"start_pose": [-0.8, 2.5, 0.0], "target_pose": [0.8, 2.5, 0.0]})
    steps = list(run(env, AHEAD))
    observation, reward, terminated, truncated, info = steps[-1]
    assert (reward, terminated, truncated) == (prize, True, False)
    assert info == {"final_status": "success", "is_success": True}
    assert observation[0] < 0.2
    assert all(step[0][0] >= 0.2 and step[4] == {} for step in steps[:-1])


def test_leaving_the_20_m_box_ends_the_episode() -> None:
    env = make(EMPTY_ID)
    for start in ([9.8, 0.0, 0.0], [-9.8, 0.0, math.pi], [0.0, 9.8, math.pi / 2]):
        env.reset(seed=0, options={"start_pose": start, "target_pose": [0.0, 0.0, 0.0]})
        steps = list(run(env, AHEAD))
        assert steps[-1][1:4] == (-200.0, True, False)
        assert steps[-1][4] == {"final_status": "out of boundary", "is_success": False}
        assert max(map(abs, env.simulation.pose[:2])) == pytest.approx(10.0, abs=0.05)


def test_robo_gyms_boundary_is_open_towards_negative_y() -> None:
    env = make(EMPTY_ID)
    env.reset(seed=0, options={"start_pose": [0.0, -12.0, 0.0], "target_pose": [0.0, 0.0, 0.0]})
    assert env.step(STOP)[2:5] == (False, False, {})


def test_driving_at_a_wall_ends_in_collision_before_it_touches() -> None:
    env = make_lab(laser_noise=0.0)
    env.reset(seed=0, options={"start_pose": [1.0, 2.5, 0.0], "target_pose": [-1.0, -2.5, 0.0]})
    *_, (_, reward, terminated, truncated, info) = run(env, AHEAD)
    assert (reward, terminated, truncated) == (-200.0, True, False)
    assert info == {"final_status": "collision", "is_success": False}
    assert not env.simulation.in_collision
    assert 0.10 < env.simulation.scan.min() < 0.15


def test_a_collision_may_weigh_more_in_a_training() -> None:
    env = make_lab(failure_reward=-400.0)
    env.reset(seed=0, options={"start_pose": [1.0, 2.5, 0.0], "target_pose": [-1.0, -2.5, 0.0]})
    *_, (_, reward, *_) = run(env, AHEAD)
    assert reward == -400.0


def test_time_may_cost_in_a_training_but_in_the_last_step() -> None:
    options = {"start_pose": [1.0, 2.5, 0.0], "target_pose": [-1.0, -2.5, 0.0]}
    usual, dear = make_lab(), make_lab(step_reward=-1.0)
    for env in (usual, dear):
        env.reset(seed=0, options=options)
    rewards, less = ([reward for _, reward, *_ in run(env, AHEAD)] for env in (usual, dear))
    assert len(rewards) > 1 and rewards[-1] == less[-1] == -200.0
    assert np.subtract(rewards[:-1], less[:-1]) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="step_reward is nan: expected a finite number"):
        make_lab(step_reward=float("nan"))


def test_touching_without_being_seen_is_a_collision() -> None:
    env = make_lab(laser_noise=0.0)
    env.reset(seed=0)
    # Against the middle of the left side, where no corner is near; the scanners look along it.
    cube = (0.0, 2.5 + 0.29 + 0.25 - 0.002, 0.0)
    env.simulation.place((0.0, 2.5, 0.0), cubes=[cube, (50.0, 0.0, 0.0), (52.0, 0.0, 0.0)])
    assert env.simulation.scan.min() > 0.15
    _, reward, terminated, _, info = env.step(STOP)
    assert (reward, terminated, info["final_status"]) == (-200.0, True, "collision")


@pytest.mark.parametrize(("distance", "ends"), [(0.398, True), (0.402, False)])
def test_a_corner_within_40_cm_of_a_cubes_centre_is_a_collision(distance: float, ends: bool) -> None:
    env = make_lab(laser_noise=0.0)
    env.reset(seed=0)
    # Behind the left rear corner, far from both scanners, seen along the diagonal.
    offset = distance / math.sqrt(2)
    x, y, yaw = 0.5, 2.0, 0.4
    ahead, left = -0.45 - offset, 0.29 + offset
    cube = (x + ahead * math.cos(yaw) - left * math.sin(yaw), y + ahead * math.sin(yaw) + left * math.cos(yaw), yaw)
    env.simulation.place((x, y, yaw), cubes=[cube, (50.0, 0.0, 0.0), (52.0, 0.0, 0.0)])
    terminated, _, info = env.step(STOP)[2:5]
    assert not env.simulation.in_collision
    assert env.simulation.scan.min() > 0.15
    assert terminated is ends
    assert info.get("final_status") == ("collision" if ends else None)


def test_arriving_and_colliding_in_one_step_is_success_as_in_robo_gym() -> None:
    env = make_lab()
    env.reset(seed=0)
    touching = (0.037646 + 0.45 + 0.25 - 0.001, 2.5, 0.0)  # a millimetre into the front
    env.simulation.place((0.0, 2.5, 0.0), target=(0.1, 2.5, 0.0), cubes=[touching, (50, 0, 0), (52, 0, 0)])
    _, reward, terminated, _, info = env.step(STOP)
    assert env.simulation.in_collision
    assert (reward, terminated, info["final_status"]) == (100.0, True, "success")


@pytest.mark.parametrize("env_id", BOTH)
def test_five_hundred_steps_truncate(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    steps = list(run(env, STOP))
    assert len(steps) == 500
    assert steps[-1][1:4] == (0.0, False, True)
    assert steps[-1][4] == {"final_status": "max_steps_exceeded", "is_success": False}
    assert all(step[4] == {} for step in steps[:-1])


def test_arriving_in_the_very_last_step_is_success() -> None:
    env = make(EMPTY_ID)
    options = {"start_pose": [0.0, 0.0, 0.0], "target_pose": [1.0, 0.0, 0.0]}
    env.reset(seed=0, options=options)
    needed = len(list(run(env, AHEAD)))
    env.reset(seed=0, options=options)
    for _ in range(500 - needed):
        env.step(STOP)
    *_, (_, reward, terminated, truncated, info) = run(env, AHEAD)
    assert (reward, terminated, truncated, info["final_status"]) == (200.0, True, False, "success")


def test_turning_to_the_target_and_driving_solves_the_empty_floor() -> None:
    env = make(EMPTY_ID)
    successes, returns = 0, []
    for seed in range(50):
        observation, _ = env.reset(seed=seed)
        total, info = 0.0, {}
        while not info:  # only the last step has any
            observation, reward, _, _, info = env.step(turn_and_drive(observation))
            total += reward
        successes += info["is_success"]
        returns.append(total)
    assert successes >= 48
    assert np.mean(returns) > 200.0  # the prize, and 50 a metre


def test_the_lab_can_be_crossed_past_the_cubes() -> None:
    env = make_lab()
    env.reset(seed=0, options={"start_pose": [-0.95, -2.5, math.pi / 2], "target_pose": [-0.95, 2.5, 0.0]})
    cubes = [(-2.2, 0.5, 0.0), (0.4, 0.0, 0.0), (2.0, -0.5, 0.0)]  # the left gap is 2 m wide
    env.simulation.place((-0.95, -2.5, math.pi / 2), cubes=cubes)
    assert last(env, AHEAD)[4] == {"final_status": "success", "is_success": True}


# -- seeds


# -- misuse


@pytest.mark.parametrize("environment", [NoObstacleNavigationMir100Sim, ObstacleAvoidanceMir100Sim])
def test_robo_gyms_constructor_arguments_are_accepted_and_others_refused(environment: type[Mir100Navigation]) -> None:
    environment("127.0.0.1", 50100, 50200, False, rs_address="127.0.0.1:50051", rs_state_to_info=False)
    with pytest.raises(TypeError, match="max_episode_step"):
        environment(max_episode_step=10)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="render_mode 'rgb' does not exist: expected one of human, rgb_array"):
        environment(render_mode="rgb")
    assert environment(gui=True).render_mode == "human"


# -- pictures


RENDER = """
import sys
import gymnasium as gym
import numpy as np
env = gym.make(sys.argv[1], render_mode="rgb_array").unwrapped
env.reset(seed=3)
first = env.render().astype(int)
for _ in range(10):
    env.step(np.array([1.0, 0.0], dtype=np.float32))
second = env.render().astype(int)
env.close()
changed = (np.abs(first - second).max(axis=2) > 40).mean()
print(*first.shape, len(np.unique(first)), changed)
"""


@pytest.mark.parametrize("env_id", BOTH)
def test_rgb_array_shows_the_robot_move(env_id: str) -> None:
    # In a process of its own: an OpenGL library stays loaded.
    done = subprocess.run(
        [sys.executable, "-c", RENDER, f"rlservo.envs:{env_id}"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    height, width, channels, colours, changed = (float(value) for value in done.stdout.split())
    assert (height, width, channels) == (480, 640, 3)
    assert colours > 100  # a picture, not a blank
    assert 0.001 < changed < 0.1  # the robot has moved, and nothing but the robot
