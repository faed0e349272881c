"""Base of the MiR100's tasks: drive to a target, scored by the distance gained and the power spent.

A task adds the start positions, the failures that end an episode, and the lasers it observes. Source of every figure
here: jr-robotics/robo-gym 2.0.1, envs/mir100.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.mir100.sensor_errors import sensor_errors
from rlservo.envs.rendering import RENDER_MODES, Camera, RenderedEnv, Start
from rlservo.robots.argument_checks import (
    ElementInfo,
    EnvDescription,
    as_vector,
    check_action,
    check_option_names,
    parse_target,
)
from rlservo.robots.disturbable import SensorError
from rlservo.robots.mir100.lasers import pick_beams
from rlservo.robots.mir100.parameters import (
    CYCLE_S,
    LASER_MAX,
    LASER_NOISE,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_VELOCITY,
)
from rlservo.robots.mir100.simulation import Mir100Simulation, wrap_angle
from rlservo.robots.mir100.worlds import Pose
from rlservo.robots.robot_port import MobileBase

LINEAR_SCALE, ANGULAR_SCALE = 0.5, 0.7  # [m/s], [rad/s], of an action of 1
SUCCESS_DISTANCE = 0.2  # [m]
MIN_TARGET_DISTANCE = 1.0  # [m], of a random target from the start
MAX_STEPS = 500
VELOCITY_TOLERANCE = 0.1  # [m/s], [rad/s], of the observation bounds above the robot's limits
PROGRESS_REWARD = 50.0  # [1/m]
LINEAR_COST, ANGULAR_COST = 0.30, 0.03  # of an action of 1
FAILURE_REWARD = -200.0
TARGET_FORMS = {
    "odom": ("X,Y",),
    "base_link": ("X,Y",),
}  # of `target`; odom: simulated, the map

Observation = NDArray[np.float32]
Vector = NDArray[np.float64]


class Mir100Navigation(RenderedEnv):
    """Drive the MiR100 to a target; the tasks that derive from it hold the data sheets."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # type: ignore[misc]

    IS_PLANAR = True
    is_real = False
    RESET_OPTIONS: ClassVar[tuple[str, ...]] = ("start_pose", "target_pose")
    WORLD: ClassVar[str]
    LASER_COUNT: ClassVar[int]  # number of observed readings, evenly picked
    SUCCESS_REWARD: ClassVar[float]
    VIEW: ClassVar[dict[str, Any]]  # the camera's pose

    def __init__(
        self,
        ip: str | None = None,
        lower_bound_port: int | None = None,
        upper_bound_port: int | None = None,
        gui: bool = False,
        *,
        rs_address: str | None = None,
        rs_state_to_info: bool = True,
        laser_noise: float = LASER_NOISE,
        failure_reward: float = FAILURE_REWARD,
        step_reward: float = 0.0,
        render_mode: str | None = None,
        target: str | None = None,
    ) -> None:
        del ip, lower_bound_port, upper_bound_port, rs_address  # no robot server to reach
        del rs_state_to_info  # robo-gym's MiR100 environments accept it and put nothing into info either
        super().__init__(render_mode, gui=gui)
        self._given = None if target is None else parse_target(target, TARGET_FORMS)
        self.simulation = Mir100Simulation(self.WORLD, laser_noise=laser_noise)
        self.robot: MobileBase = self.simulation  # unless a task says otherwise
        self._elements = self.describe()["action"]
        for name, value in (("failure_reward", failure_reward), ("step_reward", step_reward)):
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}: expected a finite number")
        self._failure_reward, self._step_reward = failure_reward, step_reward

        high = np.array(
            [
                math.inf,
                math.pi,
                MAX_LINEAR_VELOCITY + VELOCITY_TOLERANCE,
                MAX_ANGULAR_VELOCITY + VELOCITY_TOLERANCE,
                *[LASER_MAX] * self.LASER_COUNT,
            ],
            dtype=np.float32,
        )
        low = -high
        low[4:] = 0.0
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self._action_box = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.action_space = self._action_box

        self._camera = Camera(self.simulation.model, self.simulation.data, **self.VIEW)
        self.observed_beams = pick_beams(self.LASER_COUNT)
        self._shown_readings: NDArray[np.floating[Any]] | None = None  # of an observation that is looked at
        self._previous_distance: float | None = None
        self._steps = 0
        self._base_offset = (0.0, 0.0)  # [m]

    @classmethod
    def describe(cls, **_constructor_arguments: Any) -> EnvDescription:
        """Name the elements, without building a simulator; no constructor argument changes them."""
        frame = "base_link"
        observation: list[ElementInfo] = [
            {"name": "target_r", "unit": "m", "quantity": "distance", "frame": frame},
            {"name": "target_theta", "unit": "rad", "quantity": "direction", "frame": frame},
            {"name": "linear_velocity", "unit": "m/s", "quantity": "linear velocity", "axis": "x", "frame": frame},
            {"name": "angular_velocity", "unit": "rad/s", "quantity": "angular velocity", "axis": "z", "frame": frame},
        ]
        lasers: list[ElementInfo] = [
            {"name": f"laser_{index}", "unit": "m", "quantity": "distance"} for index in range(cls.LASER_COUNT)
        ]
        linear: ElementInfo = {
            "name": "linear_velocity_normalized", "unit": "1", "quantity": "linear velocity", "axis": "x",
            "scale": LINEAR_SCALE, "offset": 0.0, "frame": frame,
        }  # fmt: skip
        angular: ElementInfo = {
            "name": "angular_velocity_normalized", "unit": "1", "quantity": "angular velocity", "axis": "z",
            "scale": ANGULAR_SCALE, "offset": 0.0, "frame": frame,
        }  # fmt: skip
        return {"observation": observation + lasers, "action": [linear, angular], "control_rate_hz": 1.0 / CYCLE_S}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class's docstring lists the options."""
        super().reset(seed=seed)
        options = options or {}
        check_option_names(options, self.RESET_OPTIONS)
        start_pose, target_pose = options.get("start_pose"), options.get("target_pose")
        start = self._random_start() if start_pose is None else as_vector("start_pose", start_pose, 3).tolist()
        target = self._own_target(start) if target_pose is None else as_vector("target_pose", target_pose, 3).tolist()
        self.simulation.rng = self.np_random
        self._place(start, target, options)
        self._steps = 0
        self._previous_distance = None
        self._refresh_window()
        return self._observation(*self._told_target_polar()), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command velocities, let 0.1 s pass, and judge the outcome."""
        linear, angular = check_action(action, self._action_box, self._elements).tolist()
        self._steps += 1
        self.robot.command(linear * LINEAR_SCALE, angular * ANGULAR_SCALE)
        self.robot.advance()

        distance, bearing = self._target_polar()
        reward = self._step_reward - LINEAR_COST * abs(linear) - ANGULAR_COST * abs(angular)
        if self._previous_distance is not None:  # robo-gym scores no progress in an episode's first step
            reward += PROGRESS_REWARD * (self._previous_distance - distance)
        self._previous_distance = distance

        status = self._failure() or self.robot.stopped_by
        if status is not None:
            reward = self._failure_reward
        if distance < SUCCESS_DISTANCE:  # in robo-gym's order: arriving outweighs a failure in the same step
            reward, status = self.SUCCESS_REWARD, "success"
        terminated = status is not None
        truncated = not terminated and self._steps >= MAX_STEPS
        if truncated:
            status = "max_steps_exceeded"
        info: dict[str, Any] = {}
        if status is not None:
            info = {"final_status": status, "is_success": status == "success"}
        if (robot := self.robot.robot_info()) is not None:
            info["robot"] = robot
        self._refresh_window()
        if any(self._base_offset):
            distance, bearing = self._told_target_polar()
        return self._observation(distance, bearing), reward, terminated, truncated, info

    def close(self) -> None:
        """Free the GL context, close the window, and stop a real base."""
        self.robot.close()
        super().close()

    def limited(self) -> dict[str, int] | None:
        """Return the number of commands in which each limit of a real base applied; None for a simulated one."""
        return self.robot.limited()

    def take_over(self) -> None:
        """Leave a real base to a person, or take it back. Raises ValueError for a simulated one."""
        self.robot.take_over()

    # -- for disturbances

    def set_base_offset(self, offset: tuple[float, float]) -> None:
        """Report a target that is wrong by `offset` (x, y) [m] on the map: the localisation is off."""
        self._base_offset = offset

    def sensor_errors(self) -> dict[str, SensorError]:
        """Return the errors of the real robot's localisation, odometry and scanners."""
        return sensor_errors(self.LASER_COUNT, LINEAR_SCALE, ANGULAR_SCALE)

    @property
    def commanded_velocity(self) -> dict[str, Vector]:
        """Current command to the robot, by unit."""
        linear, angular = self.simulation.commanded_velocity
        return {"m/s": np.array([linear]), "rad/s": np.array([angular])}

    # -- for viewers

    def robot_position(self) -> Vector:
        """Return base_link's position on the map [m] (3,)."""
        x, y, _ = self.simulation.pose
        return np.array([x, y, 0.0])

    def target_position(self) -> Vector:
        """Return the target's position on the map [m] (3,)."""
        x, y, _ = self.simulation.target
        return np.array([x, y, 0.0])

    def move_target(self, position: ArrayLike) -> None:
        """Move the target on the map [m] (3,) within the episode; the next step scores no progress."""
        x, y, _ = as_vector("position", position, 3).tolist()
        self.simulation.move_target((x, y, self.simulation.target[2]))
        self._previous_distance = None

    def obstacle_positions(self) -> Vector:
        """Return the cubes' positions on the map [m] (n, 3)."""
        return np.array([(x, y, 0.0) for x, y, _ in self.simulation.cubes]).reshape(-1, 3)

    def move_obstacle(self, index: int, position: ArrayLike) -> None:
        """Move a cube on the map [m] (3,) within the episode, without turning it."""
        x, y, _ = as_vector("position", position, 3).tolist()
        yaws = {number: yaw for number, (_, _, yaw) in enumerate(self.simulation.cubes)}
        self.simulation.move_cube(index, (x, y, yaws.get(index, 0.0)))

    def beams(self) -> Vector:
        """Return both ends of every laser beam on the map [m] (n, 2, 3); none if there is nothing to see."""
        return self.simulation.beams(self._shown_readings)

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:
        """Return the options of an episode with the requested start; `keep_target` leaves the target in place."""
        options: dict[str, Any] = {"target_pose": self.simulation.target} if keep_target else {}
        return {**options, "start_pose": self.simulation.pose} if start == "here" else options

    def start_at(self, position: ArrayLike) -> dict[str, Any]:
        """Return the options of an episode that starts there on the map [m] (3,), with the robot's heading."""
        x, y, _ = as_vector("position", position, 3).tolist()
        return {"start_pose": (x, y, self.simulation.pose[2])}

    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Put the robot at the pose of an episode's observations, relative to the target, which is at the origin.

        The heading is not observed: it is integrated from the velocities since the episode began. Between the fixes of
        a target that is observed rarely, the path is integrated likewise.
        """
        x, y, yaw = _dead_reckoning(observations[: row + 1].astype(np.float64))
        self.simulation.place((x, y, yaw), target=(0.0, 0.0, 0.0))
        self.show_readings(observations[row, 4:])

    def show_readings(self, readings: NDArray[np.floating[Any]]) -> None:
        """Let `beams` have these readings [m] (n,), of beams picked evenly from all, instead of the simulation's."""
        self._shown_readings = readings

    # -- what a task adds

    @abstractmethod
    def _random_start(self) -> Pose:
        """Draw the robot's start pose."""

    @abstractmethod
    def _random_target_position(self, start: Sequence[float]) -> tuple[float, float]:
        """Draw x and y of a target; the base class draws again while it is too near the start."""

    @abstractmethod
    def _place(self, start: Sequence[float], target: Sequence[float], options: Mapping[str, Any]) -> None:
        """Place everything; `options` has the task's own options. Raises InvalidResetError."""

    @abstractmethod
    def _failure(self) -> str | None:
        """Return the final status if the robot has failed, else None."""

    # -- parts

    def _own_target(self, start: Sequence[float]) -> Pose:
        """Return the constructor's target, or a random one."""
        if self._given is None:
            return self._random_target(start)
        frame, numbers = self._given
        x, y = numbers.tolist()
        return (x, y, 0.0) if frame == "odom" else from_base(start, x, y)

    def _random_target(self, start: Sequence[float]) -> Pose:
        while True:
            x, y = self._random_target_position(start)
            if math.hypot(x - start[0], y - start[1]) >= MIN_TARGET_DISTANCE:
                return x, y, 0.0

    def _target_polar(self) -> tuple[float, float]:
        """Return distance [m] and direction [rad, -pi .. pi] of the target, seen from the robot."""
        target_x, target_y, _ = self.simulation.target
        return self._polar(target_x, target_y)

    def _told_target_polar(self) -> tuple[float, float]:
        """Return the policy's observation, from the pose that the robot believes it has."""
        (target_x, target_y, _), (dx, dy) = self.simulation.target, self._base_offset
        return self._polar(target_x + dx, target_y + dy)

    def _polar(self, target_x: float, target_y: float) -> tuple[float, float]:
        x, y, yaw = self.simulation.pose
        dx, dy = target_x - x, target_y - y
        return math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - yaw)

    def _observation(self, distance: float, bearing: float) -> Observation:
        observation = np.empty(4 + self.LASER_COUNT, dtype=np.float32)
        observation[0] = distance
        observation[1] = bearing
        observation[2:4] = self.simulation.velocity
        if self.LASER_COUNT:
            observation[4:] = self.robot.scan[self.observed_beams]
        return observation


def from_base(base: Sequence[float], x: float, y: float) -> Pose:
    """Return the pose of a place of the base's frame [m], where the base stands at x, y [m] and yaw [rad]."""
    x0, y0, yaw = base
    return x0 + x * math.cos(yaw) - y * math.sin(yaw), y0 + x * math.sin(yaw) + y * math.cos(yaw), 0.0


def _dead_reckoning(observations: Vector) -> Pose:
    """Return the pose after an episode's observations (n, 4 or more), the target at the origin, the first yaw 0."""
    turned = (observations[1:, 3] + observations[:-1, 3]) * CYCLE_S / 2
    yaws = np.concatenate([[0.0], np.cumsum(turned)])
    fix = int(np.flatnonzero(observations[:, 0] > 0.0)[-1]) if (observations[:, 0] > 0.0).any() else 0
    distance, bearing = observations[fix, 0:2]
    x = -distance * math.cos(yaws[fix] + bearing)
    y = -distance * math.sin(yaws[fix] + bearing)
    ways = observations[fix + 1 :, 2] * CYCLE_S
    x += float(ways @ np.cos(yaws[fix + 1 :]))
    y += float(ways @ np.sin(yaws[fix + 1 :]))
    return x, y, float(yaws[-1])
