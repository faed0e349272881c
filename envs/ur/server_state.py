"""State of the arm as robo-gym's robot server reports it: one number for each name in its rs_mode."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlservo.envs.ur.rs_modes import ROS_ORDER, rs_mode_of, state_names
from rlservo.robots.ur.simulation import ArmSimulation, URSimulation

Vector = NDArray[np.float64]
Transform = tuple[float, float, float, float, float, float, float]  # x, y, z [m], quaternion x, y, z, w


def state_dict(arm: URSimulation, rs_mode: str, *, is_turned: bool = False) -> dict[str, float]:
    """Return the state by names, in the list's order: objects, positions, velocities, end effector, collision, forearm.

    `is_turned` gives poses in the controller's `base` frame instead of base_link.
    """
    mode = rs_mode_of(rs_mode)
    values: list[float] = []
    for index in range(mode.objects):
        values += object_transform(arm, index, is_turned)
    for joints in (arm.joint_positions.tolist(), arm.joint_velocities.tolist()):
        values += [joints[index] for index in ROS_ORDER]
    values += transform(arm.tool_position, arm.tool_rotation, is_turned)
    values.append(float(arm.in_collision))
    if mode.forearm:
        values += transform(arm.forearm_position, arm.forearm_rotation, is_turned)
    return dict(zip(state_names(rs_mode), values, strict=True))


def object_transform(arm: ArmSimulation, index: int, is_turned: bool = False) -> Transform:
    """Return an object's pose, in base_link or the controller's `base`."""
    x, y, z = arm.object_position(index).tolist()
    # Objects are placed in the reference frame and never turn in it.
    return (-x, -y, z, 0.0, 0.0, 0.0, 1.0) if is_turned else (x, y, z, 0.0, 0.0, 0.0, 1.0)


def transform(position: Vector, rotation: Vector, is_turned: bool = False) -> Transform:
    """Return a pose in base_link, or as it is in the controller's `base`."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.reshape(9))
    w, x, y, z = quaternion.tolist()
    px, py, pz = position.tolist()
    if is_turned:  # by pi about z: `base` against base_link
        return -px, -py, pz, -y, x, w, -z
    return px, py, pz, x, y, z, w
