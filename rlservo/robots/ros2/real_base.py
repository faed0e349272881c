"""A real base in place of the simulated MiR100, whose simulation follows the base's odometry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import RobotError, Vector
from rlservo.robots.mir100.parameters import BEAM_COUNT, CYCLE_S, LASER_MAX
from rlservo.robots.mir100.simulation import Mir100Simulation
from rlservo.robots.operator_terminal import Operator
from rlservo.robots.real_robot import RealRobot
from rlservo.robots.ros2.base_driver import AGE_BOUND_S, BaseLimits, BaseState, RosBase


class RealMir100(RealRobot[RosBase, BaseState]):
    """A base that drives; `close` stops it."""

    def __init__(
        self,
        robot: str,
        simulation: Mir100Simulation,
        *,
        needs_scan: bool,
        fastest: tuple[float, float],
        limits: Mapping[str, Any],
        confirm: bool,
    ) -> None:
        """Connect and wait for every input. Raises RobotError. A policy's fastest command is in m/s and rad/s."""
        if not isinstance(limits, Mapping):
            raise RobotError(f"limits is {limits!r}: expected names with values, such as {{'speed_scale': 0.2}}")
        checked = BaseLimits.of(limits)

        def connect(timeout_s: float) -> RosBase:
            return RosBase(robot, limits=checked, setpoint_timeout_s=timeout_s, needs_scan=needs_scan)

        linear, angular = fastest
        self._fastest = linear * checked.speed_scale, angular * checked.speed_scale
        self.simulation = simulation
        self._readings: Vector = np.full(BEAM_COUNT, LASER_MAX)
        super().__init__(connect, Operator(is_asked=confirm), cycle_s=CYCLE_S, age_bound_s=AGE_BOUND_S)
        self._look()

    # -- of the port

    def start_towards(self, target: ArrayLike) -> None:
        """Start at the base's position with a new target, after confirmation. Raises RobotError if the base stopped."""
        self._recover()
        self.stopped_by = None
        self._look()
        self.simulation.place(self.simulation.pose, target=target)
        (x0, y0, _), (x, y, _), (linear, angular) = self.simulation.pose, self.simulation.target, self._fastest
        self.operator.confirm(
            f"the robot will drive from {x0:.2f}, {y0:.2f} to {x:.2f}, {y:.2f} m in its odometry's frame, "
            f"{math.hypot(x - x0, y - y0):.2f} m away, with at most {linear:.2g} m/s and {angular:.2g} rad/s"
        )
        self._begin()
        self._look()

    def command(self, linear: float, angular: float) -> bool:
        """Replace the velocities [m/s], [rad/s]; return False if they are not used."""
        self.simulation.command(linear, angular)
        may_act = self._may_act()
        if may_act:
            self._robot.command(linear, angular)
        return may_act

    @property
    def scan(self) -> Vector:
        """All readings [m], (1012,), computed from the base's scans."""
        return self._readings

    def robot_info(self) -> dict[str, Any]:
        """Return the state, its changes, the applied limits, and what blocks the base."""
        return super().robot_info() | ({"blocked": why} if (why := self._robot.blocked_by) else {})

    @property
    def frame(self) -> str:
        """The odometry's frame, which targets are in."""
        return self._robot.frame

    def present_pose(self) -> tuple[float, float, float]:
        """Return the base's newest pose [m], [m], [rad]; the simulation's is that of the last cycle."""
        return self._robot.state().pose

    def unreachable(self, x: float, y: float, *, within: float, time_s: float) -> str:
        """Return why a place [m] cannot be reached to `within` [m] in a time; empty if it may."""
        clearance, (x0, y0, _) = self._robot.clearance(x, y), self.simulation.pose
        if clearance + within < self._robot.half_width:
            return f"the scan shows something at the target, {clearance:.2f} m from it"
        distance, most = math.hypot(x - x0, y - y0), self._fastest[0] * time_s + within
        return f"the target is {distance:.1f} m away: an episode covers {most:.1f} m" if distance > most else ""

    # -- parts

    def _newest(self) -> BaseState:
        return self._robot.state()

    def _show(self, state: BaseState) -> None:
        x, y, yaw = state.pose
        linear, angular = state.velocity
        data = self.simulation.data
        data.qpos[:] = x, y, yaw
        data.qvel[:] = linear * math.cos(yaw), linear * math.sin(yaw), angular
        mujoco.mj_kinematics(self.simulation.model, data)
        if state.readings is not None:
            self._readings = state.readings
