"""A real arm in place of the simulated one: the environments see it through the scene's model.

The model follows the arm's measured positions, so that tool, contacts and pictures are computed as in the simulator;
commands go to the arm.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.checks import InvalidResetError
from rlservo.envs.robots.arm import ArmState, RobotError
from rlservo.envs.robots.command_stream import AGE_BOUND_S
from rlservo.envs.robots.mirror import Mirror
from rlservo.envs.robots.operator_terminal import Operator
from rlservo.envs.robots.rtde_arm import RtdeArm
from rlservo.envs.robots.states import State
from rlservo.envs.ur.simulation import URSimulation

if TYPE_CHECKING:
    from rlservo.envs.robots.metrics import ArmMetrics

AT_START = 0.03  # [rad], within which the arm need not move
PATH_STEP = 0.05  # [rad], between two checked poses of a path
SETTLE_S = 0.2

Vector = NDArray[np.float64]


# `stopped_by` has one type in both bases.
class MirroredArm(Mirror[RtdeArm, ArmState], URSimulation):  # pyright: ignore[reportIncompatibleVariableOverride]
    """The scene of a real arm. `close` also closes the object that `connect` returns."""

    def __init__(
        self,
        ur_model: str,
        *,
        connect: Callable[[float], RtdeArm],
        operator: Operator,
        max_velocity_scale: float,
        cycle_s: float,
        metrics: str | None = None,
        **scene: Any,
    ) -> None:
        """Connect. `connect` takes the time [s] after which the arm holds without a setpoint; its errors are raised.

        `metrics` is the address, HOST:PORT, at which Prometheus reads the arm's metrics.
        """
        URSimulation.__init__(self, ur_model, max_velocity_scale=max_velocity_scale, cycle_s=cycle_s, **scene)
        Mirror.__init__(self, connect, operator, cycle_s=cycle_s, age_bound_s=AGE_BOUND_S)
        self._metrics: ArmMetrics | None = None
        if metrics is not None:
            from rlservo.envs.robots.metrics import ArmMetrics

            try:
                self._metrics = ArmMetrics(
                    metrics, self._robot.host, counts=self.limited, state=lambda: self.states.state
                )
            except RobotError:
                self._robot.close()
                raise
        self._look()

    # -- instead of the simulation's

    def place(self, joint_positions: ArrayLike) -> bool:
        """Move the arm slowly to joint positions [rad] (6,), after confirmation; return whether it would collide there.

        An arm that a person leads, or takes over on the way, is left to that person. Raises InvalidResetError if
        something is in the way or the motion is called off, RobotError if the robot has stopped.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        if super().place(goal):
            return True
        self._recover()
        if self.states.state != State.HUMAN:
            self._go_to(goal)
        self.in_collision, self.stopped_by = False, None
        self._look()
        self._begin()
        return self.in_collision

    def settle(self) -> None:
        """Wait until the arm is at rest."""
        self.hold()
        time.sleep(SETTLE_S)
        self._look()

    def command(self, joint_positions: ArrayLike) -> None:
        """Replace the setpoint, unless a person leads the arm or the observation is too old to act on."""
        self.data.act[:] = self._robot.setpoint()
        super().command(joint_positions)
        if self._may_act():
            self._robot.command(joint_positions, self._remaining * self.model.opt.timestep)
        else:
            self._velocity[:] = 0.0

    def hold(self) -> None:
        """Stop where the arm is."""
        self._velocity[:] = 0.0
        super().hold()

    def arm_state(self) -> ArmState:
        """Return the newest state of the arm."""
        return self._robot.arm_state()

    def close(self) -> None:
        """Stop the arm and close the connection."""
        super().close()
        if self._metrics is not None:
            self._metrics.close()

    # -- parts

    def _go_to(self, goal: Vector) -> None:
        start = self._robot.arm_state().positions
        away = float(np.abs(goal - start).max())
        for share in np.linspace(0.0, 1.0, 2 + int(away / PATH_STEP)):
            if super().place(start + share * (goal - start)) and share > 0.0:
                links = " and ".join(self.contacts()[0])
                raise InvalidResetError(f"{links} would touch on the straight path to the start: move the arm by hand")
        if away > AT_START:
            speed = self._robot.limits.start_speed * self._robot.limits.speed_scale
            self.operator.confirm(f"the robot will move to its start, {away:.2f} rad at {speed:.2g} rad/s")
            self.states.enter(State.GO_TO_START, f"{away:.2f} rad away")
            try:
                self._robot.go_to(goal, lambda: self.operator.has_taken_over or self.is_called_off())
            except RobotError as error:
                self.states.enter(State.FAULT, str(error))
                raise
        else:
            self._robot.hold()
        self.states.enter(State.READY)
        if self.is_called_off():
            raise InvalidResetError("the motion to the start was called off")

    # -- the mirror's

    def _newest(self) -> ArmState:
        return self._robot.arm_state()

    def _show(self, state: ArmState) -> None:
        self.data.qpos[:] = state.positions
        self.data.qvel[:] = state.velocities
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        self.in_collision = self.in_collision or self.data.ncon > 0
