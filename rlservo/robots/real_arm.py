"""A real arm, which a simulation follows: tool, contacts and pictures are computed from its measured positions."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.robots.argument_checks import InvalidResetError
from rlservo.robots.arm_interface import ArmState, RobotError
from rlservo.robots.arm_states import ControlState
from rlservo.robots.limits import WALL_MARGIN, Limits
from rlservo.robots.operator_terminal import Operator
from rlservo.robots.real_robot import CommandedRobot, RealRobot
from rlservo.robots.servo_loop import AGE_BOUND_S
from rlservo.robots.ur.simulation import URSimulation

if TYPE_CHECKING:
    from rlservo.robots.arm_metrics import ArmMetrics

AT_START = 0.03  # [rad], within which the arm need not move
PATH_STEP = 0.05  # [rad], between two checked poses of a path
SETTLE_S = 0.2

Vector = NDArray[np.float64]
Aim = Callable[["RealArm", Vector], str]


class CommandedArm(CommandedRobot, Protocol):
    """An arm behind a servo loop, or its rehearsal."""

    host: str
    limits: Limits

    @property
    def scale(self) -> float: ...
    @property
    def frames(self) -> Vector | None: ...
    def arm_state(self) -> ArmState: ...
    def setpoint(self) -> Vector: ...
    def command(self, joint_positions: ArrayLike, duration_s: float) -> None: ...
    def go_to(self, joint_positions: ArrayLike, is_interrupted: Callable[[], bool]) -> None: ...


class RealArm(RealRobot[CommandedArm, ArmState]):
    """An arm that moves; `close` also closes the object that `connect` returns."""

    def __init__(
        self,
        simulation: URSimulation,
        *,
        connect: Callable[[float], CommandedArm],
        operator: Operator,
        aim: Aim | None = None,
        metrics: str | None = None,
    ) -> None:
        """Connect. `connect` takes the time [s] after which the arm holds without a setpoint; its errors are raised.

        `aim` is called before a motion to a start [rad] (6,): it chooses the target and returns it in words. `metrics`
        is the address, HOST:PORT, at which Prometheus reads the arm's metrics.
        """
        super().__init__(connect, operator, cycle_s=simulation.cycle_s, age_bound_s=AGE_BOUND_S)
        self.simulation, self._aim = simulation, aim
        if self._robot.frames is not None:
            simulation.calibrate(self._robot.frames)
        self._confirmed: list[tuple[Vector, str]] = []  # starts and targets that the operator has agreed to
        self._metrics: ArmMetrics | None = None
        if metrics is not None:
            from rlservo.robots.arm_metrics import ArmMetrics

            try:
                self._metrics = ArmMetrics(
                    metrics, self._robot.host, counts=self.limited, state=lambda: self.states.state
                )
            except RobotError:
                self._robot.close()
                raise
        self._look()

    # -- of the port

    def place(self, joint_positions: ArrayLike) -> bool:
        """Move the arm slowly to joint positions [rad] (6,), after confirmation; return whether it would collide there.

        An arm that a person leads, or takes over on the way, is left to that person. Raises InvalidResetError if
        something is in the way or the motion is called off, RobotError if the robot has stopped.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        if self.simulation.place(goal):
            return True
        self._recover()
        target = "" if self._aim is None else self._aim(self, goal)
        if not self.is_led:
            self._go_to(goal, target)
        self.simulation.in_collision = False
        self.stopped_by = None
        self._look()
        self._begin()
        return self.simulation.in_collision

    def settle(self) -> None:
        """Wait until the arm is at rest."""
        self.hold()
        time.sleep(SETTLE_S)
        self._look()

    def command(self, joint_positions: ArrayLike) -> None:
        """Replace the setpoint, unless a person leads the arm or the observation is too old to act on."""
        self.simulation.data.act[:] = self._robot.setpoint()
        duration_s = self.simulation.command(joint_positions)
        if self._may_act():
            self._robot.command(joint_positions, duration_s)
        else:
            self.simulation.hold()

    def hold(self) -> None:
        """Stop where the arm is."""
        self.simulation.hold()
        super().hold()

    def unreachable(self, position: Vector, start: Vector, *, within: float, time_s: float) -> str:
        """Return why the flange cannot get to `within` [m] of a position in base_link [m] (3,); empty if it may.

        `start` are the joints [rad] (6,) from which it begins, `time_s` an episode's time at the present speed.
        """
        limits, simulation = self._robot.limits, self.simulation
        tool = simulation.tool_at(start)[0]
        low, high = np.array(limits.box_low) + WALL_MARGIN, np.array(limits.box_high) - WALL_MARGIN
        if (beyond := float(np.linalg.norm(position - np.clip(position, low, high)))) > within:
            return f"it is {beyond:.2f} m outside the box of the limits for the flange, from {_m(low)} to {_m(high)} m"
        turned = start.copy()
        turned[0] += _wrapped(math.atan2(position[1], position[0]) - math.atan2(tool[1], tool[0]))
        way = math.dist(tool, position)
        edge = position + (tool - position) * min(1.0, within / max(way, 1e-9))
        scale, nearest, needed_s = self._robot.scale, math.inf, math.inf
        speeds = simulation.max_velocity * limits.speed_scale * scale
        for first in (start, turned):
            joints = simulation.joints_towards(position, start=first).clip(limits.position_low, limits.position_high)
            if (gap := math.dist(simulation.tool_at(joints)[0], position)) <= within:
                turns = np.abs(simulation.joints_towards(edge, start=first) - start)
                needed_s = min(needed_s, float((turns / np.maximum(speeds, 1e-9)).max()))
            nearest = min(nearest, gap)
        if nearest > within:
            return f"the flange gets no nearer to it than {nearest:.2f} m, within the limits of the joints"
        needed_s = max(needed_s, (way - within) / limits.tool_speed) + limits.blend_s / 2.0
        if needed_s > time_s:
            return (
                f"it takes {needed_s:.0f} s with at most {speeds.max():.2g} rad/s (speed scaling {scale:.0%}, "
                f"speed_scale {limits.speed_scale:g}), and an episode has {time_s:.0f} s: raise the speed slider, or "
                "the limits"
            )
        return ""

    def close(self) -> None:
        """Stop the arm and close the connection."""
        super().close()
        if self._metrics is not None:
            self._metrics.close()

    # -- parts

    def _go_to(self, goal: Vector, target: str) -> None:
        start = self._robot.arm_state().positions
        away = float(np.abs(goal - start).max())
        for share in np.linspace(0.0, 1.0, 2 + int(away / PATH_STEP)):
            if self.simulation.place(start + share * (goal - start)) and share > 0.0:
                links = " and ".join(self.simulation.contacts()[0])
                raise InvalidResetError(f"{links} would touch on the straight path to the start: move the arm by hand")
        self._confirm(start, goal, target)
        if away > AT_START:
            self.states.enter(ControlState.GO_TO_START, f"{away:.2f} rad away")
            try:
                self._robot.go_to(goal, lambda: self.operator.has_taken_over or self.is_called_off())
            except RobotError as error:
                self._stop_reason = str(error)
                self.states.enter(ControlState.FAULT, str(error))
                raise
            self.states.enter(ControlState.READY)
        else:
            self._robot.hold()
        if self.is_called_off():
            raise InvalidResetError("the motion to the start was cancelled")

    def _confirm(self, start: Vector, goal: Vector, target: str) -> None:
        """Ask once for each start that the arm moves to in this run, with the target to which it goes on from there."""
        if any(words == target and np.abs(one - goal).max() < AT_START for one, words in self._confirmed):
            return
        limits, scale = self._robot.limits, self._robot.scale
        away = np.abs(goal - start)
        start_speed = limits.start_speed * limits.speed_scale * scale
        seconds = float(away.max()) / max(start_speed, 1e-6) + limits.blend_s
        fastest = float(self.simulation.max_velocity.max()) * limits.speed_scale * scale
        slider = f"at the present speed scaling of {scale:.0%}"
        self.operator.confirm(
            f"the robot will move from {_listed(start)} to its start {_listed(goal)} rad, {away.max():.2f} rad in "
            f"{seconds:.0f} s with at most {start_speed:.2g} rad/s {slider}; then the policy moves each joint with at "
            f"most {fastest:.2g} rad/s" + (f", to the target {target}" if target else "")
        )
        self._confirmed.append((goal, target))

    def _newest(self) -> ArmState:
        return self._robot.arm_state()

    def _show(self, state: ArmState) -> None:
        model, data = self.simulation.model, self.simulation.data
        data.qpos[:] = state.positions
        data.qvel[:] = state.velocities
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        self.simulation.in_collision |= data.ncon > 0


def _m(place: Vector) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in place) + ")"


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _listed(joints: Vector) -> str:
    return "(" + ", ".join(f"{round(joint, 2) + 0.0:.2f}" for joint in joints) + ")"  # not -0.00
