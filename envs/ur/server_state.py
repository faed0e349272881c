"""State of the arm as robo-gym's robot server reports it: `state_dict` and `state`, by rs_mode.

Names, order and modes: jr-robotics/robo-gym-robot-servers, ur_robot_server. The list has its joints in ROS order, the
names make the dictionary's order irrelevant.
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlservo.envs.ur.parameters import JOINTS
from rlservo.envs.ur.rs_modes import ROS_ORDER, rs_mode_of

Vector = NDArray[np.float64]
Transform = tuple[float, float, float, float, float, float, float]  # x, y, z [m], quaternion x, y, z, w


class Arm(Protocol):
    """What a state is read from: `URSimulation`. Poses in base_link."""

    in_collision: bool

    @property
    def joint_positions(self) -> Vector:
        """[rad] (6,)."""
        ...

    @property
    def joint_velocities(self) -> Vector:
        """[rad/s] (6,)."""
        ...

    @property
    def tool_position(self) -> Vector:
        """[m] (3,)."""
        ...

    @property
    def tool_rotation(self) -> Vector:
        """(3, 3)."""
        ...

    @property
    def forearm_position(self) -> Vector:
        """[m] (3,)."""
        ...

    @property
    def forearm_rotation(self) -> Vector:
        """(3, 3)."""
        ...

    def object_position(self, index: int) -> Vector:
        """[m] (3,)."""
        ...


def state_dict(arm: Arm, rs_mode: str, *, is_turned: bool = False) -> dict[str, float]:
    """Return the state by names. `turned` gives poses in the controller's `base` frame instead of base_link."""
    mode = rs_mode_of(rs_mode)
    values: dict[str, float] = {}
    for index in range(mode.objects):
        values |= zip(_TRANSFORM_NAMES[f"object_{index}"], _object(arm, index, is_turned), strict=True)
    values |= zip(_POSITIONS, arm.joint_positions.tolist(), strict=True)
    values |= zip(_VELOCITIES, arm.joint_velocities.tolist(), strict=True)
    values |= zip(_TRANSFORM_NAMES["ee"], _transform(arm.tool_position, arm.tool_rotation, is_turned), strict=True)
    values["in_collision"] = float(arm.in_collision)
    if mode.forearm:
        forearm = _transform(arm.forearm_position, arm.forearm_rotation, is_turned)
        values |= zip(_TRANSFORM_NAMES["forearm"], forearm, strict=True)
    return values


def state_list(arm: Arm, rs_mode: str, *, is_turned: bool = False) -> list[float]:
    """Return the state as a list: objects, positions, velocities, end effector, collision, forearm."""
    mode = rs_mode_of(rs_mode)
    values: list[float] = []
    for index in range(mode.objects):
        values += _object(arm, index, is_turned)
    for joints in (arm.joint_positions.tolist(), arm.joint_velocities.tolist()):
        values += [joints[index] for index in ROS_ORDER]
    values += _transform(arm.tool_position, arm.tool_rotation, is_turned)
    values.append(float(arm.in_collision))
    if mode.forearm:
        values += _transform(arm.forearm_position, arm.forearm_rotation, is_turned)
    return values


def _object(arm: Arm, index: int, is_turned: bool) -> Transform:
    x, y, z = arm.object_position(index).tolist()
    # Objects are placed in the reference frame and never turn in it.
    return (-x, -y, z, 0.0, 0.0, 0.0, 1.0) if is_turned else (x, y, z, 0.0, 0.0, 0.0, 1.0)


def _transform(position: Vector, rotation: Vector, is_turned: bool) -> Transform:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.reshape(9))
    w, x, y, z = quaternion.tolist()
    px, py, pz = position.tolist()
    if is_turned:  # by pi about z: `base` against base_link
        return -px, -py, pz, -y, x, w, -z
    return px, py, pz, x, y, z, w


_POSITIONS = [f"{joint}_joint_position" for joint in JOINTS]
_VELOCITIES = [f"{joint}_joint_velocity" for joint in JOINTS]
_TRANSFORM_NAMES = {
    frame: [f"{frame}_to_ref_translation_{axis}" for axis in "xyz"]
    + [f"{frame}_to_ref_rotation_{axis}" for axis in "xyzw"]
    for frame in ("object_0", "object_1", "ee", "forearm")
}
