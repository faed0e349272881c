"""A real base in place of the simulated MiR100: the environments see it through the scene's model.

The model follows the base's odometry; commands go to the base.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.mir100.parameters import BEAM_COUNT, CYCLE_S, LASER_MAX
from rlservo.envs.mir100.simulation import Mir100Simulation
from rlservo.envs.robots.mirror import Mirror
from rlservo.envs.robots.operator_terminal import Operator
from rlservo.envs.ros2.base import AGE_BOUND_S, BaseLimits, BaseState, RosBase

Vector = NDArray[np.float64]


# `stopped_by` has one type in both bases.
class MirroredMir100(Mirror[RosBase, BaseState], Mir100Simulation):  # pyright: ignore[reportIncompatibleVariableOverride]
    """The scene of a real base; `close` stops it."""

    _is_connected = False  # `place` is called by the simulation's constructor

    def __init__(self, robot: str, *, needs_scan: bool, limits: Mapping[str, Any], confirm: bool) -> None:
        """Connect and wait for every input. Raises RobotError."""
        checked = BaseLimits.of(dict(limits))

        def connect(timeout_s: float) -> RosBase:
            return RosBase(robot, limits=checked, setpoint_timeout_s=timeout_s, needs_scan=needs_scan)

        Mir100Simulation.__init__(self, "empty", laser_noise=0.0)
        self._readings: Vector = np.full(BEAM_COUNT, LASER_MAX)
        Mirror.__init__(self, connect, Operator(is_asked=confirm), cycle_s=CYCLE_S, age_bound_s=AGE_BOUND_S)
        self._is_connected = True
        self._look()

    # -- instead of the simulation's

    def place(
        self, pose: ArrayLike, *, target: ArrayLike | None = None, cubes: Sequence[ArrayLike] | Vector | None = None
    ) -> bool:
        """Start at the base's position with a new target, after confirmation. Raises RobotError if the base stopped."""
        if not self._is_connected:
            return super().place(pose, target=target, cubes=cubes)
        self._recover()
        self.stopped_by = None
        self._look()
        super().place(self.pose, target=target)
        x, y, _ = self.target
        self.operator.confirm(f"the robot will drive to {x:.2f}, {y:.2f} m in its odometry's frame")
        self._begin()
        self._look()
        return False

    def command(self, linear: float, angular: float) -> bool:
        """Replace the velocities [m/s], [rad/s]; return False if they are not used."""
        super().command(linear, angular)
        may_act = self._may_act()
        if may_act:
            self._robot.command(linear, angular)
        return may_act

    @property
    def scan(self) -> Vector:
        """All readings [m], (1012,), computed from the base's scans."""
        return self._readings

    @property
    def is_blocked(self) -> bool:
        """False: the base looks after itself."""
        return False

    # -- the mirror's

    def _newest(self) -> BaseState:
        return self._robot.state()

    def _show(self, state: BaseState) -> None:
        x, y, yaw = state.pose
        linear, angular = state.velocity
        self.data.qpos[:] = x, y, yaw
        self.data.qvel[:] = linear * math.cos(yaw), linear * math.sin(yaw), angular
        mujoco.mj_kinematics(self.model, self.data)
        if state.readings is not None:
            self._readings = state.readings
