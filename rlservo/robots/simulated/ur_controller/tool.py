"""The tool centre point in the controller's `base` frame, which is base_link turned by pi about z."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.robots.ur.model import BASE_HEIGHT
from rlservo.robots.ur.simulation import URSimulation

NO_OFFSET = (0.0,) * 6
TO_BASE: NDArray[np.float64] = np.diag([-1.0, -1.0, 1.0])

Vector = NDArray[np.float64]


class Tool:
    """Poses and speeds for any joint positions; a pose is x, y, z [m] and a rotation vector [rad]."""

    def __init__(self, simulation: URSimulation) -> None:
        self.offset: Sequence[float] = NO_OFFSET  # of the tool centre point, as a pose in the flange's frame
        self._model, self._data = simulation.model, mujoco.MjData(simulation.model)
        self._flange = simulation.model.site("tool0").id

    def pose(self, joints: ArrayLike, offset: Sequence[float] | None = None) -> list[float]:
        """Return the pose of the point at `offset`, by default the tool's own, with the joints [rad] (6,)."""
        position, axes = self._place(joints, self.offset if offset is None else offset)
        quaternion, vector = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quaternion, (TO_BASE @ axes).reshape(9))
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
        x, y, z = TO_BASE @ (position - (0.0, 0.0, BASE_HEIGHT))
        return [float(x), float(y), float(z), *vector.tolist()]

    def speed(self, joints: ArrayLike, velocities: Vector) -> list[float]:
        """Return the tool's velocity [m/s] and angular velocity [rad/s] with the joints [rad], [rad/s] (6,)."""
        position, _ = self._place(joints, self.offset)
        mujoco.mj_comPos(self._model, self._data)
        linear, angular = np.empty((3, self._model.nv)), np.empty((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, linear, angular, position, self._model.site_bodyid[self._flange])
        speed: list[float] = np.concatenate([TO_BASE @ linear @ velocities, TO_BASE @ angular @ velocities]).tolist()
        return speed

    def _place(self, joints: ArrayLike, offset: Sequence[float]) -> tuple[Vector, Vector]:
        """Return the point's position [m] (3,) and axes (3, 3) in MuJoCo's world."""
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        flange = self._data.site_xmat[self._flange].reshape(3, 3)
        quaternion, turn, vector = np.empty(4), np.empty(9), np.array(offset[3:], dtype=np.float64)
        angle = float(np.linalg.norm(vector))
        mujoco.mju_axisAngle2Quat(quaternion, vector / max(angle, 1e-12), angle)
        mujoco.mju_quat2Mat(turn, quaternion)
        return self._data.site_xpos[self._flange] + flange @ offset[:3], flange @ turn.reshape(3, 3)
