"""A UR arm with robo-gym's interface, on the arm's simulation.

Source of the behaviour: jr-robotics/robo-gym-robot-servers, ur_robot_server. On the wire joints come in ROS order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlservo.envs.rendering import Camera
from rlservo.envs.robot_server.robot import RobotState
from rlservo.envs.robot_server.settings import URSettings
from rlservo.envs.robots.arm import MUJOCO
from rlservo.envs.robots.connect import make_arm
from rlservo.envs.ur.object_paths import object_path
from rlservo.envs.ur.parameters import JOINTS, POSITION_LIMITS, cycle_of
from rlservo.envs.ur.rs_modes import ROS_ORDER, state_names
from rlservo.envs.ur.server_state import state_dict
from rlservo.envs.ur.simulation import SETTLE_CYCLES, VIEW

INITIAL_JOINTS = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)  # [rad], until the first SetState
ROS_JOINTS = [JOINTS[index] for index in ROS_ORDER]
LIMITS: NDArray[np.float64] = np.array(POSITION_LIMITS)
ROUNDING = 1e-5  # [rad], by which a float32 may exceed a limit
# A list that is not one of our states has the positions after six other numbers, as in robo-gym's first versions.
OLD_LIST = (*range(6), *(f"{joint}_joint_position" for joint in ROS_JOINTS))


class URRobot:
    """The arm, its objects and their parameters, which stay from one SetState to the next, as ROS parameters do."""

    def __init__(self, settings: URSettings) -> None:
        self._settings = settings
        self.is_real = settings.robot != MUJOCO
        self.simulation = make_arm(
            settings.robot,
            settings.ur_model,
            limits=settings.limits,
            confirm=settings.confirm,
            metrics=settings.metrics,
            max_velocity_scale=settings.max_velocity_scale_factor,
            cycle_s=self.cycle_s,
            objects=settings.object_names,
            table=settings.table,
        )
        self.camera = Camera(self.simulation.model, self.simulation.data, **VIEW)
        self._is_turned = settings.reference_frame == "base"
        self._to_base_link = np.array([-1.0, -1.0, 1.0] if self._is_turned else [1.0, 1.0, 1.0])
        self._rng = np.random.default_rng(settings.seed)
        self._float_params: dict[str, float] = {}
        self._string_params: dict[str, str] = {}
        if not self.is_real:
            self.simulation.place(INITIAL_JOINTS)

    @property
    def cycle_s(self) -> float:
        """Duration of a control cycle [s]."""
        return cycle_of(self._settings.action_cycle_rate)

    def state(self) -> RobotState:
        """Return the state of the server's mode, as a list and by names."""
        names = state_dict(self.simulation, self._settings.rs_mode, is_turned=self._is_turned)
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
                paths[index] = object_path(function, index, floats, self._rng) * self._to_base_link
        self._float_params, self._string_params = floats, strings
        if self.simulation.place(joints) and self.is_real:
            links = " and ".join(self.simulation.contacts()[0])
            raise ValueError(f"a real arm is not moved to a pose in which {links} would touch")
        self.simulation.move_objects(paths)
        self.simulation.settle()
        return SETTLE_CYCLES

    def act(self, action: Sequence[float]) -> None:
        """Send the arm towards six joint positions, or by six offsets from its own [rad], for one cycle."""
        if len(action) != 6:
            raise ValueError(f"the action has {len(action)} elements, expected 6: {', '.join(ROS_JOINTS)} [rad]")
        for joint, value in zip(ROS_JOINTS, action, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"the action for {joint} is {value:g}: expected a finite number [rad]")
        if self.simulation.stopped_by is not None:
            raise ValueError(f"the robot has stopped ({self.simulation.stopped_by}): SetState connects again")
        target = np.array([action[index] for index in ROS_ORDER])
        if self._settings.action_mode == "delta_pos":
            target += self.simulation.joint_positions
        self.simulation.command(np.clip(target, -LIMITS, LIMITS))
        self.simulation.advance()

    def idle(self, cycles: int) -> None:
        """Stop the arm in place and let cycles pass."""
        self.simulation.hold()
        for _ in range(cycles):
            self.simulation.advance()

    def close(self) -> None:
        """Close the window, and stop a real arm."""
        self.camera.close()
        self.simulation.close()

    def _target_joints(self, target: RobotState) -> NDArray[np.float64]:
        names = [f"{joint}_joint_position" for joint in JOINTS]
        if all(name in target.names for name in names):
            joints = np.array([target.names[name] for name in names], dtype=np.float64)
        elif target.values:
            mode, count = self._settings.rs_mode, len(target.values)
            in_list = state_names(mode)
            by_name = dict(zip(in_list if count == len(in_list) else OLD_LIST, target.values, strict=False))
            if not by_name.keys() >= set(names):
                raise ValueError(f"the state has {count} elements: expected {len(in_list)}, those of rs_mode {mode!r}")
            joints = np.array([by_name[name] for name in names], dtype=np.float64)
        else:
            missing = ", ".join(name for name in names if name not in target.names)
            raise ValueError(f"state_dict lacks {missing}, and state is empty: expected the arm's joint positions")
        for joint, position, limit in zip(JOINTS, joints.tolist(), POSITION_LIMITS, strict=True):
            if not abs(position) <= limit + ROUNDING:
                raise ValueError(f"the position of {joint} is {position:g} rad: expected within +-{limit:g} rad")
        within_limits: NDArray[np.float64] = np.clip(joints, -LIMITS, LIMITS)
        return within_limits
