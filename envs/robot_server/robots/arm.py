"""An arm with robo-gym's interface.

Source of the behaviour: jr-robotics/robo-gym-robot-servers, ur_robot_server and panda_robot_server.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.rendering import Camera
from rlservo.envs.robot_server.robot_server_settings import ArmSettings
from rlservo.envs.robot_server.robots.robot import RobotState
from rlservo.robots.robot_port import Arm
from rlservo.robots.ur.object_paths import object_path
from rlservo.robots.ur.parameters import cycle_of
from rlservo.robots.ur.simulation import SETTLE_CYCLES, VIEW, ArmSimulation

ROUNDING = 1e-5  # [rad], by which a float32 may exceed a limit
Simulation = TypeVar("Simulation", bound=ArmSimulation)


class ArmRobot(ABC, Generic[Simulation]):
    """The arm, its objects and their parameters, which stay from one SetState to the next, as ROS parameters do."""

    ORDER: ClassVar[tuple[int, ...]]  # of the joints on the wire; the same list turns them back
    POSITION_NAMES: ClassVar[tuple[str, ...]]  # of the state's joint positions, in the simulation's order
    LOW: ClassVar[NDArray[np.float64]]  # [rad]
    HIGH: ClassVar[NDArray[np.float64]]

    def __init__(self, settings: ArmSettings, simulation: Simulation, robot: Arm, initial: Sequence[float]) -> None:
        """`initial` is where a simulated arm stands until the first SetState [rad]."""
        self._settings = settings
        self.simulation, self._robot = simulation, robot
        self.is_real = robot is not simulation
        self.camera = Camera(simulation.model, simulation.data, **VIEW)
        self._to_base = np.ones(3)  # of a position in the reference frame
        self._rng = np.random.default_rng(settings.seed)
        self._float_params: dict[str, float] = {}
        self._string_params: dict[str, str] = {}
        if not self.is_real:
            simulation.place(initial)

    @property
    def cycle_s(self) -> float:
        """Duration of a control cycle [s]."""
        return cycle_of(self._settings.action_cycle_rate)

    @abstractmethod
    def _names(self) -> dict[str, float]:
        """Return the state of the server's mode by names, in the order of its list."""

    @abstractmethod
    def _list_names(self, count: int) -> Sequence[str]:
        """Return what the elements of a state's list of that length are."""

    def state(self) -> RobotState:
        """Return the state of the server's mode, as a list and by names."""
        names = self._names()
        return RobotState(values=list(names.values()), names=names)

    def set_state(self, target: RobotState) -> int:
        """Put the arm at the state's pose, start the objects' motions, and let 20 cycles pass."""
        joints = self._target_joints(target)
        floats = {**self._float_params, **target.float_params}
        strings = {**self._string_params, **target.string_params}
        paths = {}
        for index in range(self.simulation.object_count):
            function = strings.get(f"object_{index}_function")
            if function is not None:  # else it stays out of the way
                paths[index] = object_path(function, index, floats, self._rng) * self._to_base
        self._float_params, self._string_params = floats, strings
        if self._robot.place(joints) and self.is_real:
            links = " and ".join(self.simulation.contacts()[0])
            raise ValueError(f"a real arm cannot be moved to a pose in which {links} would touch")
        self.simulation.move_objects(paths)
        self._robot.settle()
        return SETTLE_CYCLES

    def act(self, action: Sequence[float]) -> None:
        """Send the arm towards joint positions, or by offsets from its own [rad], or drive it [rad/s], one cycle.

        Velocities are kept within the scaled limits.
        """
        mode, sim, robot = self._settings.action_mode, self.simulation, self._robot
        unit = "rad/s" if mode.endswith("_vel") else "rad"
        wire = [sim.JOINTS[index] for index in self.ORDER]
        if len(action) != len(wire):
            raise ValueError(f"the action has {len(action)} elements, expected {len(wire)}: {', '.join(wire)} [{unit}]")
        for joint, value in zip(wire, action, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"the action for {joint} is {value:g}: expected a finite number [{unit}]")
        if robot.stopped_by is not None:
            raise ValueError(f"the robot has stopped ({robot.stopped_by}): SetState asks at the server's terminal")
        target = np.array([action[index] for index in self.ORDER])
        if mode == "delta_pos":
            target += sim.joint_positions
        elif mode == "delta_vel":
            target += sim.joint_velocities
        if mode.endswith("_vel"):
            sim.drive(np.clip(target, -sim.max_velocity, sim.max_velocity))
            return
        robot.command(np.clip(target, self.LOW, self.HIGH))
        robot.advance()

    def idle(self, cycles: int) -> None:
        """Stop the arm in place and let cycles pass."""
        self._robot.hold()
        for _ in range(cycles):
            self._robot.advance()

    def close(self) -> None:
        """Close the window, and stop a real arm."""
        self.camera.close()
        self._robot.close()

    def _target_joints(self, target: RobotState) -> NDArray[np.float64]:
        names = self.POSITION_NAMES
        if all(name in target.names for name in names):
            joints = np.array([target.names[name] for name in names], dtype=np.float64)
        elif target.values:
            by_name = dict(zip(self._list_names(len(target.values)), target.values, strict=False))
            if not by_name.keys() >= set(names):
                mode, expected = self._settings.rs_mode, len(self._names())
                raise ValueError(
                    f"the state has {len(target.values)} elements: expected {expected}, those of rs_mode {mode!r}"
                )
            joints = np.array([by_name[name] for name in names], dtype=np.float64)
        else:
            missing = ", ".join(name for name in names if name not in target.names)
            raise ValueError(f"state_dict lacks {missing}, and state is empty: expected the arm's joint positions")
        for joint, position, low, high in zip(self.simulation.JOINTS, joints, self.LOW, self.HIGH, strict=True):
            if not low - ROUNDING <= position <= high + ROUNDING:
                within = f"+-{high:g}" if low == -high else f"{low:g} .. {high:g}"
                raise ValueError(f"the position of {joint} is {position:g} rad: expected within {within} rad")
        within_limits: NDArray[np.float64] = np.clip(joints, self.LOW, self.HIGH)
        return within_limits
