"""A real arm in place of the simulated one: the environments see it through the scene's model.

The model follows the arm's measured positions, so that tool, contacts and pictures are computed as in the simulator;
commands go to the arm, and a control cycle passes in real time. The state machine around the policy is here.
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
from rlservo.envs.robots.command_stream import AGE_BOUND_S, Phase
from rlservo.envs.robots.operator_terminal import Operator
from rlservo.envs.robots.rtde_arm import RtdeArm
from rlservo.envs.robots.states import State, StateMachine
from rlservo.envs.ur.simulation import URSimulation

if TYPE_CHECKING:
    from rlservo.envs.robots.metrics import ArmMetrics

AT_START = 0.03  # [rad], within which the arm need not move
PATH_STEP = 0.05  # [rad], between two checked poses of a path
SETTLE_S = 0.2
FRESH_S = 6.0  # [s] to wait for a fresh state; ur_rtde itself waits for 3 s
STALE_CYCLES = 2.0  # between an observation and the action for it
LATE_CYCLES = 2.5  # between two setpoints

Vector = NDArray[np.float64]
_PHASE_STATES = {Phase.LATE: (State.HOLD, "no setpoint came"), Phase.STALE: (State.HOLD, "the robot's state is old")}


class MirroredSimulation(URSimulation):
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
        super().__init__(ur_model, max_velocity_scale=max_velocity_scale, cycle_s=cycle_s, **scene)
        self.operator = operator
        self.states = StateMachine()
        self.stale_actions = 0
        self._cycle_s = cycle_s
        self._connect = connect
        self._due_s = 0.0
        self._counts: dict[str, int] = {}
        self._lost: dict[str, int] = {}  # counts of closed connections
        self._arm = self._connected()
        self.state_seen = self._arm.arm_state()
        self._metrics: ArmMetrics | None = None
        if metrics is not None:
            from rlservo.envs.robots.metrics import ArmMetrics

            try:
                self._metrics = ArmMetrics(
                    metrics, self._arm.host, counts=self.limited, state=lambda: self.states.state
                )
            except RobotError:
                self._arm.close()
                raise
        self._mirror()

    # -- instead of the simulation's

    def place(self, joint_positions: ArrayLike) -> bool:
        """Move the arm slowly to joint positions [rad] (6,), after confirmation; return whether it would collide there.

        Raises InvalidResetError if something is in the way, RobotError if the robot has stopped.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        if super().place(goal):
            return True
        self._recover()
        start = self._arm.arm_state().positions
        away = float(np.abs(goal - start).max())
        for share in np.linspace(0.0, 1.0, 2 + int(away / PATH_STEP)):
            if super().place(start + share * (goal - start)) and share > 0.0:
                links = " and ".join(self.contacts()[0])
                raise InvalidResetError(f"{links} would touch on the straight path to the start: move the arm by hand")
        if away > AT_START:
            speed = self._arm.limits.start_speed * self._arm.limits.speed_scale
            self.operator.confirm(f"the robot will move to its start, {away:.2f} rad at {speed:.2g} rad/s")
            self.states.enter(State.GO_TO_START, f"{away:.2f} rad away")
            try:
                self._arm.go_to(goal)
            except RobotError as error:
                self.states.enter(State.FAULT, str(error))
                raise
            self.states.enter(State.READY)
        elif self.states.state not in (State.READY, State.HUMAN):
            self._arm.hold()
            self.states.enter(State.READY)
        self.in_collision, self.stopped_by = False, None
        self._mirror()
        self.states.enter(State.BLEND_IN)
        self._arm.blend_in()
        self.operator.watch_keys()
        self._due_s = time.monotonic()
        return self.in_collision

    def settle(self) -> None:
        """Wait until the arm is at rest."""
        self._arm.hold()
        time.sleep(SETTLE_S)
        self._mirror()

    def command(self, joint_positions: ArrayLike) -> None:
        """Replace the setpoint, unless a person leads the arm or the observation is too old to act on."""
        self.data.act[:] = self._arm.setpoint()
        super().command(joint_positions)
        age_s = time.monotonic() - self.state_seen.received_s + self.state_seen.age_s
        if self.states.state == State.HUMAN:
            self._velocity[:] = 0.0
        elif age_s > STALE_CYCLES * self._cycle_s + AGE_BOUND_S:
            self.stale_actions += 1
            self._velocity[:] = 0.0
            self._arm.hold()
            self.states.enter(State.HOLD, f"the action is for an observation {age_s:.2f} s old")
        else:
            self._arm.command(joint_positions, self._remaining * self.model.opt.timestep)

    def hold(self) -> None:
        """Stop where the arm is."""
        self._velocity[:] = 0.0
        self._arm.hold()

    def advance(self) -> None:
        """Wait for the end of the control cycle and read the arm's state."""
        now = time.monotonic()
        self._due_s = max(self._due_s + self._cycle_s, now - self._cycle_s)
        if now - self._due_s > 0.0:
            self._due_s = now  # a missed cycle is not caught up
        time.sleep(max(0.0, self._due_s - now))
        self._mirror()
        self._follow_states()

    def arm_state(self) -> ArmState:
        """Return the newest state of the arm."""
        return self._arm.arm_state()

    def robot_info(self) -> dict[str, Any] | None:
        """Return the state, its changes and the applied limits since the last call."""
        counts = self.limited()
        new = {name: count - self._counts.get(name, 0) for name, count in counts.items()}
        self._counts = counts
        info: dict[str, Any] = {"state": self.states.state.value}
        if any(new.values()):
            info["limited"] = {name: count for name, count in new.items() if count}
        if changes := self.states.take_changes():
            info["changes"] = [change._asdict() for change in changes]
        return info

    def take_over(self) -> None:
        """Let a person lead the arm from the next control cycle on, or return it to the policy."""
        self.operator.toggle()

    def limited(self) -> dict[str, int]:
        """Return the number of cycles in which each limit was applied, by element, and of stale actions."""
        counts = dict(self._lost)
        for name, count in self._arm.limited().items():
            counts[name] = counts.get(name, 0) + count
        return counts | ({"stale_action": self.stale_actions} if self.stale_actions else {})

    def close(self) -> None:
        """Stop the arm and close the connection."""
        self.states.enter(State.STOP, "the environment is closed")
        self.operator.close()
        self._arm.close()
        if self._metrics is not None:
            self._metrics.close()

    # -- parts

    def _connected(self) -> RtdeArm:
        self.states.enter(State.CONNECT)
        arm = self._connect(LATE_CYCLES * self._cycle_s)
        self.states.enter(State.CHECK)
        self.states.enter(State.READY, arm.host)
        return arm

    def _recover(self) -> None:
        """Connect again after a fault. Raises RobotError while the robot is not ready."""
        if self.states.state != State.FAULT and not self._arm.fault():
            return
        self._note_fault()
        self._lost = self._arm.limited()
        self._arm.close()
        self._arm = self._connected()

    def _mirror(self) -> None:
        """Set the model to the arm's position; hold and wait until its state is fresh."""
        limit = time.monotonic() + FRESH_S
        state = self._arm.arm_state()
        while time.monotonic() - state.received_s + state.age_s > AGE_BOUND_S and not self._note_fault():
            if time.monotonic() > limit:
                self.stopped_by = "stale_observation"
                self._arm.hold()
                age_s = time.monotonic() - state.received_s + state.age_s
                self.states.enter(State.FAULT, f"the robot's newest state is {age_s:.2f} s old, after {FRESH_S:g} s")
                break
            time.sleep(0.002)
            state = self._arm.arm_state()
        self.state_seen = state
        self.data.qpos[:] = state.positions
        self.data.qvel[:] = state.velocities
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        self.in_collision = self.in_collision or self.data.ncon > 0

    def _note_fault(self) -> bool:
        fault = self._arm.fault()
        if fault and self.states.state != State.FAULT:
            self.stopped_by = fault.partition(":")[0]
            self.states.enter(State.FAULT, fault)
        return bool(fault)

    def _follow_states(self) -> None:
        """Follow the command stream's phase and the operator at the terminal."""
        if self._note_fault() or self.states.state == State.FAULT:
            return
        if self.operator.has_taken_over:
            if self.states.state != State.HUMAN:
                self._arm.free()
                self.states.enter(State.HUMAN, "taken over")
            return
        if self.states.state == State.HUMAN:
            self._arm.blend_in()
            self.states.enter(State.BLEND_IN, "given back")
            return
        phase = self._arm.phase()
        if phase in _PHASE_STATES:
            self.states.enter(*_PHASE_STATES[phase])
        elif phase == Phase.FOLLOW:
            self.states.enter(State.RUN if self._arm.blend() >= 1.0 else State.BLEND_IN)
