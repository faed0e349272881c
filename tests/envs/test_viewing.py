"""Views of the environments: shapes and poses, things to drag, observations shown again."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.rendering import RenderedEnv
from rlservo.envs.shapes import Poses, body_poses, moving_bodies, visible_shapes
from rlservo.robots.argument_checks import InvalidResetError

IDS = (
    "EndEffectorPositioningURSim-v0",
    "EmptyEnvironmentURSim-v0",
    "BasicAvoidanceURSim-v0",
    "NoObstacleNavigationMir100Sim-v0",
    "SparseFixNavigationMir100Sim-v0",
    "ObstacleAvoidanceMir100Sim-v0",
)
WITH_TARGET = [each for each in IDS if each != "EmptyEnvironmentURSim-v0"]


def make(name: str, **arguments: Any) -> RenderedEnv:
    env = gym.make(f"rlservo/{name}", disable_env_checker=True, **arguments).unwrapped
    assert isinstance(env, RenderedEnv)
    return env


def driven(name: str, steps: int) -> tuple[RenderedEnv, np.ndarray]:
    """An environment after some steps, and all its observations."""
    env = make(name)
    observations = [env.reset(seed=3)[0]]
    env.action_space.seed(3)
    for _ in range(steps):
        observations.append(env.step(0.3 * env.action_space.sample())[0])
    return env, np.array(observations)


@pytest.mark.parametrize("name", IDS)
def test_shapes_and_poses_are_those_of_the_model(name: str) -> None:
    env = make(name)
    env.reset(seed=1)
    shapes = visible_shapes(env.model)
    assert {shape.kind for shape in shapes} >= {"plane", "cylinder"}
    assert all((shape.vertices is not None) == (shape.kind == "mesh") for shape in shapes)
    bodies = moving_bodies(env.model)
    poses = body_poses(env.data, bodies)
    assert poses.positions.shape == (len(bodies), 3) and np.allclose(np.linalg.norm(poses.wxyz, axis=1), 1.0)
    assert env.model.body("world").id not in bodies
    position, look_at = env.viewpoint()
    assert position[2] > look_at[2]  # from above


def test_poses_between_two_are_on_the_way_and_turn_the_short_way() -> None:
    one = Poses(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    other = Poses(np.ones((1, 3)), np.array([[-np.cos(0.2), -np.sin(0.2), 0.0, 0.0]]))  # turned by 0.4 rad
    middle = one.towards(other, 0.5)
    assert np.allclose(middle.positions, 0.5)
    assert np.allclose(middle.wxyz, [[np.cos(0.1), np.sin(0.1), 0.0, 0.0]])


@pytest.mark.parametrize("name", WITH_TARGET)
def test_a_target_that_is_moved_is_what_the_next_observation_tells(name: str) -> None:
    env = make(name, **({"fix_interval": 1} if name.startswith("Sparse") else {}))
    env.reset(seed=2)
    robot = env.robot_position()
    away = np.array([0.6, 0.0, 0.0])
    env.move_target(robot + away)
    target = env.target_position()
    assert target is not None and np.allclose(target, robot + away)
    observation = env.step(np.zeros(env.action_space.shape, np.float32))[0]  # type: ignore[arg-type]
    assert observation[0] == pytest.approx(np.linalg.norm(env.robot_position() - target), abs=1e-3)


def test_a_task_without_a_target_refuses_to_move_it() -> None:
    env = make("EmptyEnvironmentURSim-v0")
    assert env.target_position() is None
    with pytest.raises(ValueError, match="has no target to move"):
        env.move_target((0, 0, 1))
    with pytest.raises(ValueError, match="has no obstacle 0"):
        env.move_obstacle(0, (0, 0, 1))


@pytest.mark.parametrize("name", [each for each in IDS if each[0] in "EN" or each.startswith("Obst")])
def test_an_episode_goes_on_where_the_robot_is(name: str) -> None:
    env, _ = driven(name, 10)
    robot, target, obstacles = env.robot_position(), env.target_position(), env.obstacle_positions()
    env.reset(options=env.reset_options(start="here", keep_target=True))
    if name.startswith("Empty"):
        return  # that task cannot: it starts in its own way
    assert np.allclose(env.robot_position(), robot, atol=1e-6)
    assert np.allclose(env.target_position(), target) and np.allclose(env.obstacle_positions(), obstacles)  # type: ignore[arg-type]
    env.reset(options=env.reset_options(start="here"))
    assert not np.allclose(env.target_position(), target)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", IDS)
def test_an_episode_starts_with_the_robot_where_it_is_put(name: str) -> None:
    env = make(name)
    env.reset(seed=3)
    there = np.array([0.5, 2.5, 0.0]) if env.IS_PLANAR else np.array([0.35, 0.25, 0.6])
    before = env.data.qpos.copy()
    options = env.start_at(there)
    assert np.array_equal(env.data.qpos, before)  # nothing has moved yet
    env.reset(options=options)
    assert np.allclose(env.robot_position(), there, atol=2e-3)


def test_an_arm_that_cannot_reach_points_there() -> None:
    env = make("EndEffectorPositioningURSim-v0")
    env.reset(options=env.start_at(np.array([3.0, 0.0, 0.5])))
    x, y, z = env.robot_position()
    assert x > 0.6 and abs(y) < 0.3 and 0.1 < z < 1.0


def test_a_random_start_differs_from_the_arms_own() -> None:
    env = make("EndEffectorPositioningURSim-v0")
    env.reset(seed=1)
    own = env.robot_position()
    env.reset(options=env.reset_options(start="random", keep_target=True))
    assert not np.allclose(env.robot_position(), own, atol=0.01)


def test_cubes_are_moved_seen_by_the_beams_and_given_at_reset() -> None:
    env = make("ObstacleAvoidanceMir100Sim-v0", laser_noise=0.0)
    env.reset(seed=4)
    robot = env.robot_position()
    env.move_obstacle(2, robot + (1.2, 0.0, 0.0))
    assert np.allclose(env.obstacle_positions()[2], robot + (1.2, 0.0, 0.0))
    beams = env.beams()
    assert beams.shape == (1012, 2, 3)
    ends = beams[:, 1] - env.obstacle_positions()[2]
    assert (np.abs(ends[:, :2]).max(axis=1) < 0.36).sum() > 10  # half a cube's diagonal
    cubes = [(2.0, 0.0, 0.0), (0.0, 0.0, 0.5), (-2.0, 0.5, 0.0)]
    env.reset(options={"start_pose": (0.0, -2.5, 0.0), "target_pose": (0.0, 2.5, 0.0), "cubes": cubes})
    assert np.allclose(env.obstacle_positions()[:, :2], [cube[:2] for cube in cubes])
    with pytest.raises(InvalidResetError, match="with these cubes"):
        env.reset(options={"start_pose": (0.0, 0.0, 0.0), "cubes": cubes})
    with pytest.raises(InvalidResetError, match="cubes"):
        env.reset(options={"cubes": cubes[:2]})


@pytest.mark.parametrize("name", IDS)
def test_observations_show_the_robot_as_it_was(name: str) -> None:
    env, observations = driven(name, 30)
    shown = make(name)
    shown.show_observations(observations, 30)
    target, shown_target = env.target_position(), shown.target_position()
    if target is None or shown_target is None:
        assert np.allclose(shown.robot_position(), env.robot_position(), atol=1e-5)
        return
    # A MiR100's observations hold its position relative to its target, and heading only since the episode began.
    distance = np.linalg.norm(env.robot_position() - target)
    tolerance = 0.02 if name.startswith("Sparse") else 1e-4
    assert np.linalg.norm(shown.robot_position() - shown_target) == pytest.approx(distance, abs=tolerance)
    if not env.IS_PLANAR:
        assert np.allclose(shown.robot_position(), env.robot_position(), atol=1e-5)
        assert np.allclose(shown_target, target, atol=1e-5)
    assert len(shown.beams()) == (16 if name.startswith("Obst") else 0)
