"""A real arm that is read once and then rehearsed: motion within the limits from its present pose; nothing is sent.

The rehearsed arm follows each setpoint exactly, and its time passes as fast as it is computed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import ArmState, RobotError, Vector
from rlservo.robots.arm_process import AT_REST, REACHED
from rlservo.robots.control_law import ControlLaw, Order, Phase
from rlservo.robots.limits import COUNTED, Limits, MotionLimiter
from rlservo.robots.operator_terminal import Operator
from rlservo.robots.readiness import present_state
from rlservo.robots.real_arm import Aim, RealArm
from rlservo.robots.servo_loop import FORGET_S
from rlservo.robots.ur.simulation import URSimulation

DT = 0.008  # [s], of the limiter's steps
LONGEST_S = 3600.0  # of a motion to a start


class RehearsedArm:
    """`ArmProcess` without a process: `pass_time` moves the setpoint as the command stream would."""

    fault = ""

    def __init__(self, host: str, ur_model: str, *, velocity_scale: float, limits: Limits) -> None:
        """Read the arm's state. Raises RobotError if it cannot be reached, or is outside its limits."""
        self.host, self.limits = host, limits
        positions, self.scale, self.frames = present_state(host, ur_model, limits)
        simulation = URSimulation(ur_model, objects=())
        if self.frames is not None:
            simulation.calibrate(self.frames)
        velocities = np.array(simulation.parameters.velocity_limits)
        self._policy_velocities = velocities * velocity_scale * limits.speed_scale
        self._start_velocities = np.minimum(velocities, limits.start_speed) * limits.speed_scale
        self._limiter = MotionLimiter(limits, simulation, self._policy_velocities, DT)
        self._limiter.restart(positions.tolist())
        self._limiter.check_start()
        self._counts = np.zeros(len(COUNTED))
        self._goal, self._due_s, self._time_s = positions, 0.0, 0.0
        self._law = ControlLaw(setpoint_timeout_s=LONGEST_S, blend_s=limits.blend_s, forget_s=FORGET_S)
        self._order, self._blend_from_s = Order.HOLD, 0.0
        self.rows: list[dict[str, Any]] = []  # one for each motion: to a start, and of the policy from there

    def arm_state(self) -> ArmState:
        """Return the rehearsed state."""
        limiter, now = self._limiter, time.monotonic()
        return ArmState(limiter.position.copy(), limiter.velocity.copy(), self._time_s, now, 0.0, "running", "normal")

    def command(self, joint_positions: ArrayLike, duration_s: float = 0.5) -> None:
        """Replace the setpoint: reach joint positions [rad] (6,) in `duration_s` [s], as far as limits allow."""
        self._goal = self._limiter.goal_within(np.asarray(joint_positions, dtype=np.float64))
        self._due_s, self._order = self._time_s + duration_s, Order.FOLLOW
        self._limiter.velocity_limits = self._policy_velocities

    def hold(self) -> None:
        """Decelerate and hold."""
        self._order = Order.HOLD

    free = hold

    @property
    def phase(self) -> Phase:
        """What the arm does now."""
        return self._law.phase

    @property
    def blend(self) -> float:
        """The policy's share of the speed, 0 to 1."""
        return self._law.blend

    def blend_in(self) -> None:
        """Hold, and let the speed of later commands grow from 0; the policy's motion begins."""
        self._order, self._blend_from_s = Order.HOLD, self._time_s
        self._begin("policy")

    def go_to(self, joint_positions: ArrayLike, is_interrupted: Callable[[], bool]) -> None:
        """Move to a start [rad] (6,). Raises RobotError if the limits keep the arm from it."""
        del is_interrupted
        goal, began_s = np.asarray(joint_positions, dtype=np.float64), self._time_s
        self._begin("to the start")
        self._goal, self._due_s, self._order = self._limiter.goal_within(goal), 0.0, Order.GO
        self._limiter.velocity_limits = self._start_velocities
        limiter = self._limiter
        while np.abs(limiter.position - goal).max() > REACHED or np.abs(limiter.velocity).max() > AT_REST:
            is_stuck = not self._step() and self.blend > 0.0
            if is_stuck or self._time_s - began_s > LONGEST_S:
                raise RobotError(f"the limits keep the robot from its start: they are {self.limited()}")
        self.hold()

    def pass_time(self, time_s: float) -> None:
        """Let a control cycle pass."""
        for _ in range(max(1, round(time_s / DT))):
            self._step()

    def setpoint(self) -> Vector:
        """Return the joint positions [rad] (6,)."""
        return self._limiter.position

    def limited(self) -> dict[str, int]:
        """Return the number of steps in which each limit was applied, by element, without zeros."""
        return {name: int(count) for name, count in zip(COUNTED, self._counts, strict=True) if count}

    def close(self) -> None:
        """Nothing is open."""

    def _begin(self, what: str) -> None:
        self.rows.append(
            {
                "motion": what,
                "from": self._limiter.position.copy().tolist(),
                "to": [],
                "time_s": 0.0,
                "joint_speed": 0.0,
                "flange_speed": 0.0,
                "flange": [],
                "lowest_flange": np.inf,
            }
        )

    def _step(self) -> bool:
        """Advance by one step of the limiter; return whether the setpoint has moved."""
        limiter, law = self._limiter, self._law
        limiter.limited[:] = False
        law.decide(
            self._order, passed_s=DT, blend_from_s=self._blend_from_s, setpoint_age_s=0.0, is_stale=False, other=""
        )
        want, share, before = np.zeros(6), 1.0, limiter.position
        if law.phase in (Phase.GO, Phase.FOLLOW):
            want = limiter.velocity_towards(self._goal, self._due_s - self._time_s, DT)
            share = self.scale * law.blend
        limiter.step(want, DT, share)
        self._time_s += DT
        self._counts += limiter.limited
        if self.rows:
            row, (flange, jacobian) = self.rows[-1], limiter.simulation.tool_at(limiter.position)
            row["time_s"] += DT
            row["to"], row["flange"] = limiter.position.tolist(), flange.tolist()
            row["joint_speed"] = max(row["joint_speed"], float(np.abs(limiter.velocity).max()))
            row["flange_speed"] = max(row["flange_speed"], float(np.linalg.norm(jacobian @ limiter.velocity)))
            row["lowest_flange"] = min(row["lowest_flange"], float(flange[2]))
        return bool(np.abs(limiter.position - before).max() > 0.0)


class Rehearsal(RealArm):
    """A rehearsed arm in place of a real one: its cycles take no time."""

    def __init__(self, simulation: URSimulation, arm: RehearsedArm, aim: Aim | None) -> None:
        super().__init__(simulation, connect=lambda _: arm, operator=Operator(is_asked=False), aim=aim)
        self._rehearsed = arm

    @property
    def rehearsal(self) -> list[dict[str, Any]]:
        """The motions that were rehearsed."""
        return list(self._rehearsed.rows)

    def advance(self) -> None:
        """Let a control cycle pass."""
        self._rehearsed.pass_time(self._cycle_s)
        self._look()
        self._follow_states()
