"""Base of the arm's tasks: joints that may be fixed, a start pose, one command a cycle.

A task adds what its action means, what it observes and how a step is judged. Source of every figure here:
jr-robotics/robo-gym 2.0.1, envs/ur/ur_base_env.py.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.checks import (
    ElementInfo,
    EnvDescription,
    InvalidResetError,
    as_vector,
    check_action,
    check_option_names,
    element,
)
from rlservo.envs.rendering import RENDER_MODES, Camera, RenderedEnv
from rlservo.envs.robots.arm import MUJOCO
from rlservo.envs.robots.connect import make_arm
from rlservo.envs.ur.model import BASE_HEIGHT
from rlservo.envs.ur.parameters import JOINTS, POSITION_LIMITS, cycle_of
from rlservo.envs.ur.server_state import state_dict
from rlservo.envs.ur.simulation import VIEW

LIMITS: NDArray[np.float64] = np.array(POSITION_LIMITS)
BASE: NDArray[np.float64] = np.array([0.0, 0.0, BASE_HEIGHT])  # [m], base_link in MuJoCo's world
POSITION_BOUND = 1.1  # of a normalised joint position: its limit and robo-gym's tolerance

Observation = NDArray[np.float32]
Vector = NDArray[np.float64]


class URArmEnv(RenderedEnv):
    """Move a UR arm by one command per joint and cycle; the tasks that derive from it hold the data sheets."""

    # Not a ClassVar: each instance states its own rate.
    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    START_JOINTS: ClassVar[tuple[float, ...]]  # [rad]
    MAX_STEPS: ClassVar[int]
    RESET_OPTIONS: ClassVar[tuple[str, ...]]
    RS_MODE: ClassVar[str]  # content of `info["rs_state"]`
    OBJECTS: ClassVar[tuple[str, ...]]
    TABLE: ClassVar[bool]
    ACTION_ELEMENT: ClassVar[tuple[str, str]]  # suffix of the joint's name, and unit
    TIME_LIMIT_STATUS: ClassVar[str] = "success"  # the final status of an episode that lasts MAX_STEPS
    MAX_VELOCITY_SCALE: ClassVar[float] = 0.2
    RATE_HZ: ClassVar[float] = 20.0

    def __init__(
        self,
        *,
        fix_base: bool = False,
        fix_shoulder: bool = False,
        fix_elbow: bool = False,
        fix_wrist_1: bool = False,
        fix_wrist_2: bool = False,
        fix_wrist_3: bool = True,
        ur_model: str = "ur5",
        rs_state_to_info: bool = True,
        gui: bool = False,
        max_velocity_scale_factor: float | None = None,
        action_cycle_rate: float | None = None,
        render_mode: str | None = None,
        robot: str = MUJOCO,
        limits: Mapping[str, Any] | None = None,
        confirm: bool = True,
        metrics: str | None = None,
        rs_address: str | None = None,
        ip: str | None = None,
        lower_bound_port: int | None = None,
        upper_bound_port: int | None = None,
    ) -> None:
        """The arguments are described in the tasks' docstrings; None takes the task's own value."""
        del rs_address, ip, lower_bound_port, upper_bound_port  # no robot server to reach
        fixed = np.array((fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3))
        scale = self.MAX_VELOCITY_SCALE if max_velocity_scale_factor is None else max_velocity_scale_factor
        rate_hz = self.RATE_HZ if action_cycle_rate is None else action_cycle_rate
        if fixed.all():
            raise ValueError("all six joints are fixed: no joint is left to act on")
        super().__init__(render_mode, gui=gui)
        self.metadata = {**self.metadata, "render_fps": rate_hz}
        self._build = partial(
            make_arm,
            robot,
            limits=limits,
            confirm=confirm,
            metrics=metrics,
            max_velocity_scale=scale,
            cycle_s=cycle_of(rate_hz),
            objects=self.OBJECTS,
            table=self.TABLE,
        )
        self.is_real = robot != MUJOCO
        self._simulations = {ur_model: self._build(ur_model)}  # an arm that comes again is not built again
        self.simulation = self._simulations[ur_model]
        self._free = np.flatnonzero(~fixed)
        self._fixed = np.flatnonzero(fixed)
        self._rs_state_to_info = rs_state_to_info
        self._elements = self._action_elements(fixed.tolist())

        low, high = self._observation_bounds()
        self.observation_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self._actions = gym.spaces.Box(-1.0, 1.0, (len(self._free),), dtype=np.float32)
        self.action_space = self._actions

        self._camera = Camera(self.simulation.model, self.simulation.data, **VIEW)
        self._start: Vector = np.array(self.START_JOINTS)
        self._steps = 0
        self._base_offset: Vector = np.zeros(3)  # [m]

    @classmethod
    def describe(cls, *, action_cycle_rate: float | None = None, **arguments: Any) -> EnvDescription:
        """Name the elements for the constructor arguments given, without building a simulator."""
        fixed = [bool(arguments.get(f"fix_{joint}", joint == "wrist_3")) for joint in JOINTS]
        return {
            "observation": [element(name, unit) for name, unit in cls._observation_elements()],
            "action": cls._action_elements(fixed),
            "control_rate_hz": cls.RATE_HZ if action_cycle_rate is None else action_cycle_rate,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class's docstring lists the options."""
        super().reset(seed=seed)
        options = options or {}
        check_option_names(options, self.RESET_OPTIONS)
        self._steps = 0
        self._start = self._place_arm(options)
        self._begin(options)
        self._refresh_window()
        return self._observation(), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the joints, let one cycle pass, and judge the outcome."""
        values = check_action(action, self._actions, self._elements)
        self._steps += 1
        command = np.empty(6)  # all joints
        command[self._free] = values
        command[self._fixed] = self._fixed_values()[self._fixed]
        self.simulation.command(self._to_joint_positions(command))
        self.simulation.advance()

        observation = self._observation()
        reward, status = self._judge(observation, command)
        status = status or self.simulation.stopped_by
        terminated = status is not None
        truncated = not terminated and self._steps >= self.MAX_STEPS
        if truncated:
            status = self.TIME_LIMIT_STATUS
        info: dict[str, Any] = {}
        if status is not None:
            info = {"final_status": status, "is_success": status == "success", **self._final_info(status)}
        if self._rs_state_to_info:
            info["rs_state"] = state_dict(self.simulation, self.RS_MODE)
        if (robot := self.simulation.robot_info()) is not None:
            info["robot"] = robot
        self._refresh_window()
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Free the GL context, close the window, and stop a real arm."""
        for simulation in self._simulations.values():
            simulation.close()
        super().close()

    def limited(self) -> dict[str, int] | None:
        """Return the number of command cycles in which each limit of a real arm applied; None for a simulated arm."""
        return self.simulation.limited()

    # -- for disturbances

    def set_robot_model(self, name: str) -> None:
        """Put another arm on the table; call `reset` next. Raises ValueError naming the seven, and for a real arm."""
        if self.is_real:
            raise ValueError(f"a real arm cannot be exchanged for {name!r}")
        simulation = self._simulations.get(name) or self._simulations.setdefault(name, self._build(name))
        if simulation is not self.simulation:
            self.simulation = simulation
            self._camera.close()
            self._camera = Camera(simulation.model, simulation.data, **VIEW)

    def set_base_offset(self, offset: tuple[float, float]) -> None:
        """Report positions of objects that are wrong by `offset` (x, y) [m]: the base is not where it was measured."""
        self._base_offset = np.array([*offset, 0.0])

    @property
    def commanded_velocity(self) -> dict[str, Vector]:
        """Current command to the joints, by unit."""
        return {"rad/s": self.simulation.commanded_velocity}

    # -- for viewers

    def take_over(self) -> None:
        """Let a person lead a real arm by hand, or give it back. Raises ValueError for a simulated one."""
        self.simulation.take_over()

    def robot_position(self) -> Vector:
        """Return tool0's position in MuJoCo's world [m] (3,)."""
        return self.simulation.tool_position + BASE

    def start_at(self, position: ArrayLike) -> dict[str, Any]:
        """Return the options of an episode that starts with tool0 there, or as near as the arm gets from here."""
        joints = self.simulation.joints_towards(as_vector("position", position, 3) - BASE)
        return {"joint_positions": np.clip(joints, -LIMITS, LIMITS).tolist()}

    # -- what a task adds

    @classmethod
    @abstractmethod
    def _observation_elements(cls) -> list[tuple[str, str]]:
        """Return name and unit of each observation element."""

    @abstractmethod
    def _observation_bounds(self) -> tuple[Vector, Vector]:
        """Return the observation space's low and high."""

    @abstractmethod
    def _begin(self, options: Mapping[str, Any]) -> None:
        """Prepare the episode: the arm stands at its start."""

    @abstractmethod
    def _fixed_values(self) -> Vector:
        """Return the action elements of fixed joints, (6,)."""

    @abstractmethod
    def _to_joint_positions(self, command: Vector) -> Vector:
        """Turn an action of all six joints into joint positions [rad]."""

    @abstractmethod
    def _observation(self) -> Observation:
        """Return the observation of this moment."""

    @abstractmethod
    def _judge(self, observation: Observation, command: Vector) -> tuple[float, str | None]:
        """Return the reward of the step that ended with `observation`, and the final status if it ends the episode.

        The time limit is checked elsewhere.
        """

    def _final_info(self, status: str) -> dict[str, Any]:  # noqa: ARG002
        """Return the last step's info besides the status."""
        return {}

    # -- parts

    @classmethod
    def _action_elements(cls, fixed: Sequence[bool]) -> list[ElementInfo]:
        """Name the elements of an action: one for each joint that is not fixed."""
        name, unit = cls.ACTION_ELEMENT
        return [element(f"{joint}_{name}", unit) for joint, is_fixed in zip(JOINTS, fixed, strict=True) if not is_fixed]

    def _place_arm(self, options: Mapping[str, Any]) -> Vector:
        """Put the arm at the options' start and return it."""
        values = options.get("joint_positions")
        return self._place_arm_at(np.array(self.START_JOINTS) if values is None else self._check_joints(values))

    def _check_joints(self, values: Any) -> Vector:
        joints = as_vector("joint_positions", values, 6)
        for joint, position, limit in zip(JOINTS, joints, POSITION_LIMITS, strict=True):
            if abs(position) > limit:
                raise InvalidResetError(
                    f"reset option 'joint_positions': {joint} is {position:g} rad, expected within +-{limit:g} rad"
                )
        return joints

    def _place_arm_at(self, joints: Vector) -> Vector:
        if self.simulation.place(joints):
            links = " and ".join(self.simulation.contacts()[0])
            raise InvalidResetError(f"the start joint positions collide: {links} touch")
        return joints


def polar(point: Vector) -> tuple[float, float, float]:
    """Return r [m], theta = acos(z/r) and phi = atan2(y, x) [rad] of a point (3,); theta is 0 at the origin."""
    x, y, z = point.tolist()
    r = math.sqrt(x * x + y * y + z * z)
    return r, math.acos(max(-1.0, min(1.0, z / r))) if r > 0.0 else 0.0, math.atan2(y, x)
