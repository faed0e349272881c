"""Base of an arm's tasks: joints that may be fixed, a start pose, one command a cycle.

A task adds what its action means, what it observes and how a step is judged. Source of every figure here:
jr-robotics/robo-gym 2.0.1, envs/ur/ur_base_env.py.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.elements import joint_elements
from rlservo.envs.rendering import RENDER_MODES, Camera, RenderedEnv
from rlservo.envs.ur.server_state import state_dict
from rlservo.robots.argument_checks import (
    ElementInfo,
    EnvDescription,
    InvalidResetError,
    as_vector,
    check_action,
    check_option_names,
    parse_target,
)
from rlservo.robots.arm_interface import MUJOCO
from rlservo.robots.connect_arm import connect_arm
from rlservo.robots.kept_latency import kept_latency_ms
from rlservo.robots.robot_port import Arm
from rlservo.robots.ur.model import BASE_HEIGHT, Table
from rlservo.robots.ur.parameters import JOINT_NAMES, JOINTS, POSITION_LIMITS, cycle_of
from rlservo.robots.ur.simulation import MIN_TRAJECTORY_S, VIEW, ArmSimulation, URSimulation

if TYPE_CHECKING:
    from rlservo.robots.real_arm import RealArm

LIMITS: NDArray[np.float64] = np.array(POSITION_LIMITS)
BASE: NDArray[np.float64] = np.array([0.0, 0.0, BASE_HEIGHT])  # [m], base_link in MuJoCo's world
POSITION_BOUND = 1.1  # of a normalised joint position: its limit and robo-gym's tolerance
REDRAWS = 1000  # of a random start that collides; about one in ten does

# Of `target`: the frame base_link, the pendant's base (base_link turned by half a turn), or a pose's joints.
TARGET_FORMS = {
    "base_link": ("X,Y,Z", "X,Y,Z,ROLL,PITCH,YAW"),
    "base": ("X,Y,Z", "X,Y,Z,ROLL,PITCH,YAW"),
    "joints": ("BASE,SHOULDER,ELBOW,WRIST_1,WRIST_2,WRIST_3",),
}
FRONT = math.pi / 4  # [rad], on either side of where a task looks to, of a real arm's random targets

Observation = NDArray[np.float32]
Vector = NDArray[np.float64]
Simulation = TypeVar("Simulation", bound=ArmSimulation)


class ArmEnv(RenderedEnv, Generic[Simulation]):
    """Move an arm by one command per joint and cycle; the tasks that derive from it hold the data sheets."""

    # Not a ClassVar: each instance states its own rate.
    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    JOINTS: ClassVar[tuple[str, ...]]
    JOINT_NAMES: ClassVar[Mapping[str, str]]  # names in the URDF, by JOINTS
    LOW: ClassVar[Vector]  # [rad], of JOINTS
    HIGH: ClassVar[Vector]
    BASE: ClassVar[Vector]  # [m], the arm's base in MuJoCo's world
    FIXED: ClassVar[tuple[str, ...]] = ()  # joints that are fixed unless the constructor says otherwise
    START_JOINTS: ClassVar[tuple[float, ...]]  # [rad]
    MAX_STEPS: ClassVar[int]
    RESET_OPTIONS: ClassVar[tuple[str, ...]]
    RS_MODE: ClassVar[str]  # content of `info["rs_state"]`
    OBJECTS: ClassVar[tuple[str, ...]]
    ACTION_ELEMENT: ClassVar[tuple[str, str]]  # suffix of the joint's name, and unit
    OBSERVES_LAST_ACTION: ClassVar[bool] = False  # an element for each free joint, at the end of the observation
    TIME_LIMIT_STATUS: ClassVar[str] = "success"  # the final status of an episode that lasts MAX_STEPS
    MAX_VELOCITY_SCALE: ClassVar[float] = 0.2
    RATE_HZ: ClassVar[float] = 20.0

    def __init__(
        self,
        make_simulation: Callable[[], Simulation],
        *,
        fixed: Sequence[bool],
        rate_hz: float,
        rs_state_to_info: bool,
        gui: bool,
        render_mode: str | None,
    ) -> None:
        if all(fixed):
            raise ValueError(f"all {len(fixed)} joints are fixed: no joint is left to move")
        super().__init__(render_mode, gui=gui)
        self.metadata = {**self.metadata, "render_fps": rate_hz}
        self.simulation = make_simulation()
        self.robot: Arm = self.simulation  # unless a task says otherwise
        self._free = np.flatnonzero(~np.array(fixed))
        self._fixed = np.flatnonzero(fixed)
        self._rs_state_to_info = rs_state_to_info
        self._elements = self._action_elements(fixed)

        low, high = self._observation_bounds()
        self.observation_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        low, high = self._action_bounds()
        self._actions = gym.spaces.Box(
            low[self._free].astype(np.float32), high[self._free].astype(np.float32), dtype=np.float32
        )
        self.action_space = self._actions

        self._camera = Camera(self.simulation.model, self.simulation.data, **VIEW)
        self._start: Vector = np.array(self.START_JOINTS)
        self._steps = 0
        self._options: Mapping[str, Any] = {}  # of this episode's reset
        self._base_offset: Vector = np.zeros(3)  # [m]

    @classmethod
    def describe(cls, *, action_cycle_rate: float | None = None, **arguments: Any) -> EnvDescription:
        """Name the elements for the constructor arguments given, without building a simulator."""
        choices = [arguments.get(f"fix_{joint}") for joint in cls.JOINTS]
        fixed = cls._fixed_joints(choices)
        elements = cls._observation_elements()
        if cls.OBSERVES_LAST_ACTION:
            last = joint_elements(cls.JOINT_NAMES, "last_action", "1", "last action")
            elements += [one for one, is_fixed in zip(last, fixed, strict=True) if not is_fixed]
        return {
            "observation": elements,
            "action": cls._action_elements(fixed, **arguments),
            "control_rate_hz": cls.RATE_HZ if action_cycle_rate is None else action_cycle_rate,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class's docstring lists the options."""
        super().reset(seed=seed)
        options = options or {}
        check_option_names(options, self.RESET_OPTIONS)
        self._steps, self._options = 0, options
        self._start = self._place_arm(options)
        self._begin(options)
        self._refresh_window()
        return self._observation(), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the joints, let one cycle pass, and judge the outcome."""
        values = check_action(action, self._actions, self._elements)
        self._steps += 1
        command = np.empty(len(self.JOINTS))
        command[self._free] = values
        command[self._fixed] = self._fixed_values()[self._fixed]
        self.robot.command(self._to_joint_positions(command))
        self.robot.advance()

        observation = self._observation()
        reward, status = self._judge(observation, command)
        status = status or self.robot.stopped_by
        terminated = status is not None
        truncated = not terminated and self._steps >= self.MAX_STEPS
        if truncated:
            status = self.TIME_LIMIT_STATUS
        info: dict[str, Any] = {}
        if status is not None:
            info = {"final_status": status, "is_success": status == "success", **self._final_info(status)}
        if self._rs_state_to_info:
            info["rs_state"] = self._rs_state()
        if (robot := self.robot.robot_info()) is not None:
            info["robot"] = robot
        self._refresh_window()
        return observation, reward, terminated, truncated, info

    def limited(self) -> dict[str, int] | None:
        """Return the number of command cycles in which each limit of a real arm applied; None for a simulated arm."""
        return self.robot.limited()

    # -- for disturbances

    def set_base_offset(self, offset: tuple[float, float]) -> None:
        """Report positions of objects that are wrong by `offset` (x, y) [m]: the base is not where it was measured."""
        self._base_offset = np.array([*offset, 0.0])

    @property
    def commanded_velocity(self) -> dict[str, Vector]:
        """Current command to the joints, by unit."""
        return {"rad/s": self.simulation.commanded_velocity}

    # -- for viewers

    def robot_position(self) -> Vector:
        """Return the tool's position in MuJoCo's world [m] (3,)."""
        return self.simulation.tool_position + self.BASE

    def start_at(self, position: ArrayLike) -> dict[str, Any]:
        """Return the options of an episode that starts with the tool there, or as near as the arm gets from here."""
        joints = self.simulation.joints_towards(as_vector("position", position, 3) - self.BASE)
        return {"joint_positions": np.clip(joints, self.LOW, self.HIGH).tolist()}

    # -- what an arm and a task add

    @abstractmethod
    def _rs_state(self) -> dict[str, float]:
        """Return the state as the robot server's mode RS_MODE has it."""

    def _action_bounds(self) -> tuple[Vector, Vector]:
        """Return the action's low and high, (joints,)."""
        one = np.ones(len(self.JOINTS))
        return -one, one

    @classmethod
    @abstractmethod
    def _observation_elements(cls) -> list[ElementInfo]:
        """Describe each observation element."""

    @classmethod
    @abstractmethod
    def _position_map(cls, **arguments: Any) -> tuple[Vector, Vector | None]:
        """Return scale and offset [rad] by which actions are joint positions; an offset that varies is None."""

    @abstractmethod
    def _observation_bounds(self) -> tuple[Vector, Vector]:
        """Return the observation space's low and high."""

    @abstractmethod
    def _begin(self, options: Mapping[str, Any]) -> None:
        """Prepare the episode: the arm stands at its start."""

    @abstractmethod
    def _fixed_values(self) -> Vector:
        """Return the action elements of fixed joints, (joints,)."""

    @abstractmethod
    def _to_joint_positions(self, command: Vector) -> Vector:
        """Turn an action of all joints into joint positions [rad]."""

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
    def _fixed_joints(cls, choices: Sequence[bool | None]) -> list[bool]:
        return [
            joint in cls.FIXED if is_fixed is None else is_fixed
            for joint, is_fixed in zip(cls.JOINTS, choices, strict=True)
        ]

    @classmethod
    def _action_elements(cls, fixed: Sequence[bool], **arguments: Any) -> list[ElementInfo]:
        """Describe the elements of an action: one for each joint that is not fixed."""
        elements = joint_elements(
            cls.JOINT_NAMES, *cls.ACTION_ELEMENT, "joint position", *cls._position_map(**arguments)
        )
        return [one for one, is_fixed in zip(elements, fixed, strict=True) if not is_fixed]

    def _place_arm(self, options: Mapping[str, Any]) -> Vector:
        """Put the arm at the options' start and return it."""
        values = options.get("joint_positions")
        return self._place_arm_at(np.array(self.START_JOINTS) if values is None else self._check_joints(values))

    def _check_joints(self, values: Any) -> Vector:
        joints = as_vector("joint_positions", values, len(self.JOINTS))
        for joint, position, low, high in zip(self.JOINTS, joints, self.LOW, self.HIGH, strict=True):
            if not low <= position <= high:
                within = f"+-{high:g}" if low == -high else f"{low:g} .. {high:g}"
                raise InvalidResetError(
                    f"reset option 'joint_positions': {joint} is {position:g} rad, expected within {within} rad"
                )
        return joints

    def _place_arm_around(self, centre: Vector, spread: float | Sequence[float]) -> Vector:
        """Put the arm within `spread` [rad] of `centre`, redrawn while it collides."""
        reach: Vector = np.broadcast_to(np.array(spread), centre.shape)
        for _ in range(REDRAWS):
            draw = self.np_random.uniform(centre - reach, centre + reach)
            joints: Vector = np.clip(draw, self.LOW, self.HIGH)
            if not self.robot.place(joints):
                return joints
        raise InvalidResetError(f"all {REDRAWS} random starts around the given joint positions collide")

    def _place_arm_at(self, joints: Vector) -> Vector:
        if self.robot.place(joints):
            links = " and ".join(self.simulation.contacts()[0])
            raise InvalidResetError(f"the start joint positions collide: {links} touch")
        return joints


class URArmEnv(ArmEnv[URSimulation]):
    """Move a UR arm, simulated or real."""

    JOINTS = JOINTS
    JOINT_NAMES = JOINT_NAMES
    LOW, HIGH = -LIMITS, LIMITS
    BASE = BASE
    FIXED: ClassVar[tuple[str, ...]] = ("wrist_3",)
    TOOL: ClassVar[str] = "tool0"
    TABLE: ClassVar[Table]
    WITHIN: ClassVar[float] = 0.0  # [m], of the target, for a success; 0: a task without a target
    TARGET_TURN: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)  # [rad], roll, pitch and yaw, of one given as a position
    FRONT_FRAME: ClassVar[str] = "base_link"  # along whose x axis the task's random targets are, or "base"
    MIN_TRAJECTORY_S: ClassVar[float] = MIN_TRAJECTORY_S  # of the simulation

    def __init__(
        self,
        *,
        fix_base: bool | None = None,
        fix_shoulder: bool | None = None,
        fix_elbow: bool | None = None,
        fix_wrist_1: bool | None = None,
        fix_wrist_2: bool | None = None,
        fix_wrist_3: bool | None = None,
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
        target: str | None = None,
        dry_run: bool = False,
        rs_address: str | None = None,
        ip: str | None = None,
        lower_bound_port: int | None = None,
        upper_bound_port: int | None = None,
    ) -> None:
        """The arguments are described in the tasks' docstrings; None takes the task's own value."""
        del rs_address, ip, lower_bound_port, upper_bound_port  # no robot server to reach
        if target is not None and not self.WITHIN:
            raise ValueError(f"{type(self).__name__} has no target")
        given = None if target is None else parse_target(target, TARGET_FORMS)
        choices = (fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3)
        scale = self.MAX_VELOCITY_SCALE if max_velocity_scale_factor is None else max_velocity_scale_factor
        rate_hz = self.RATE_HZ if action_cycle_rate is None else action_cycle_rate
        self._build = partial(
            URSimulation,
            max_velocity_scale=scale,
            cycle_s=cycle_of(rate_hz),
            objects=self.OBJECTS,
            table=self.TABLE,
            tool=self.TOOL,
            min_trajectory_s=self.MIN_TRAJECTORY_S,
        )
        self.is_real = robot != MUJOCO
        self.robot_facts = {"ur_model": ur_model, "action_cycle_rate": rate_hz, "max_velocity_scale_factor": scale}
        self.robot_address = robot
        super().__init__(
            partial(self._build, ur_model),
            fixed=self._fixed_joints(choices),
            rate_hz=rate_hz,
            rs_state_to_info=rs_state_to_info,
            gui=gui,
            render_mode=render_mode,
        )
        self._simulations = {ur_model: self.simulation}  # an arm that is chosen again is not built again
        self._given = None if given is None else self._pose_of(*given)
        self._aimed: Vector | None = None  # the target that a real arm's operator was asked about
        self.robot = connect_arm(
            robot, self.simulation, limits=limits, confirm=confirm, metrics=metrics, dry_run=dry_run,
            aim=self._aim if self.WITHIN else None,
        )  # fmt: skip

    def close(self) -> None:
        """Free the GL context, close the window, and stop a real arm."""
        self.robot.close()
        super().close()

    def set_robot_model(self, name: str) -> None:
        """Put another arm on the table; call `reset` next. Raises ValueError naming all, and for a real arm."""
        if self.is_real:
            raise ValueError(f"a real arm cannot be replaced by {name!r}")
        simulation = self._simulations.get(name) or self._simulations.setdefault(name, self._build(name))
        if simulation is not self.simulation:
            self.robot = self.simulation = simulation
            self._camera.close()
            self._camera = Camera(simulation.model, simulation.data, **VIEW)

    def take_over(self) -> None:
        """Let a person lead a real arm by hand, or give it back. Raises ValueError for a simulated one."""
        self.robot.take_over()

    @property
    def measured_latency_ms(self) -> float | None:
        """The worst latency that `robot-latency` has measured on this real arm; None if it has not."""
        return kept_latency_ms(self.robot_address, str(self.robot_facts["ur_model"]))

    def _rs_state(self) -> dict[str, float]:
        return state_dict(self.simulation, self.RS_MODE)

    # -- the target of a task that has one: x, y, z [m] and roll, pitch, yaw [rad] in base_link

    def _random_pose(self) -> Vector:
        """Draw a target (6,)."""
        raise NotImplementedError

    def _target_pose(self) -> Vector:
        """Return this episode's target (6,): the reset option's, the constructor's, or a random one."""
        pose = self._asked_pose()
        if pose is None:
            pose = self._random_pose() if self._aimed is None else self._aimed
        return pose

    def _asked_pose(self) -> Vector | None:
        pose = self._options.get("ee_target_pose")
        return self._given if pose is None else as_vector("ee_target_pose", pose, 6)

    def _pose_of(self, frame: str, numbers: Vector) -> Vector:
        if frame == "joints":
            position, axes, _ = self.simulation.tool_frame_at(numbers)
            return np.concatenate([position, roll_pitch_yaw(axes)])
        if frame == "base":
            count = len(numbers)
            numbers = numbers * (-1, -1, 1, 1, 1, 1)[:count] + (0, 0, 0, 0, 0, math.pi)[:count]
        return np.concatenate([numbers, self.TARGET_TURN])[:6]

    def _aim(self, arm: RealArm, start: Vector) -> str:
        """Choose a real arm's target before it moves to `start` [rad] (6,). Raises InvalidResetError, naming why not.

        A random one is in front of the robot, and neither at its start nor out of its reach.
        """
        asked, tool = self._asked_pose(), self.simulation.tool_at(start)[0]
        words, why = "in front of the robot", "it is too near to the start"
        for _ in range(REDRAWS):
            pose = self._random_pose() if asked is None else asked
            x, y = pose[:2].tolist() if self.FRONT_FRAME == "base_link" else (-pose[:2]).tolist()
            if asked is None and (abs(math.atan2(y, x)) > FRONT or math.dist(tool, pose[:3]) < 2.0 * self.WITHIN):
                continue
            words = "(" + ", ".join(f"{value:.2f}" for value in pose[:3] + 0.0) + ") m in base_link"
            why = arm.unreachable(
                pose[:3], start, within=self.WITHIN, time_s=self.MAX_STEPS / self.metadata["render_fps"]
            )
            if not why:
                self._aimed = pose
                return words
            if asked is not None:
                break
        raise InvalidResetError(f"the target {words} cannot be reached: {why}")


class RealArmEnv(URArmEnv):
    """A task on a real arm: its address is required."""

    def __init__(self, *, robot: str = "", **arguments: Any) -> None:
        if not robot:
            raise ValueError("robot is missing: expected the arm's address, such as robot=rtde://192.168.0.2")
        super().__init__(robot=robot, **arguments)


def roll_pitch_yaw(axes: Vector) -> Vector:
    """Return rotations about the fixed axes x, y and z [rad] (3,), of a rotation matrix (3, 3)."""
    pitch = math.asin(max(-1.0, min(1.0, -axes[2, 0])))
    if math.cos(pitch) < 1e-6:  # roll and yaw turn about the same axis
        return np.array([0.0, pitch, math.atan2(-axes[0, 1], axes[1, 1])])
    return np.array([math.atan2(axes[2, 1], axes[2, 2]), pitch, math.atan2(axes[1, 0], axes[0, 0])])


def polar(point: Vector) -> tuple[float, float, float]:
    """Return r [m], theta = acos(z/r) and phi = atan2(y, x) [rad] of a point (3,); theta is 0 at the origin."""
    x, y, z = point.tolist()
    r = math.sqrt(x * x + y * y + z * z)
    return r, math.acos(max(-1.0, min(1.0, z / r))) if r > 0.0 else 0.0, math.atan2(y, x)
