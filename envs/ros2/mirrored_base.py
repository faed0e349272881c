"""A real base in place of the simulated MiR100: the environments see it through the scene's model.

The model follows the base's odometry; commands go to the base, and a control cycle passes in real time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.mir100.parameters import BEAM_COUNT, CYCLE_S, LASER_MAX
from rlservo.envs.mir100.simulation import Mir100Simulation
from rlservo.envs.robots.command_stream import Phase
from rlservo.envs.robots.operator_terminal import Operator
from rlservo.envs.robots.states import State, StateMachine
from rlservo.envs.ros2.base import AGE_BOUND_S, BaseLimits, RosBase

FRESH_S = 6.0  # [s] to wait for a fresh state
STALE_CYCLES, LATE_CYCLES = 2.0, 2.5  # between an observation and its action, and between two commands

Vector = NDArray[np.float64]
_PHASE_STATES = {Phase.LATE: (State.HOLD, "no command came"), Phase.STALE: (State.HOLD, "the base's state is old")}


class MirroredMir100(Mir100Simulation):
    """The scene of a real base; `close` stops it."""

    def __init__(self, robot: str, *, needs_scan: bool, limits: Mapping[str, Any], confirm: bool) -> None:
        """Connect and wait for every input. Raises RobotError."""
        self._is_up = False  # `place` is called by the constructor above
        super().__init__("empty", laser_noise=0.0)
        self._is_up = True
        self._operator = Operator(is_asked=confirm)
        self.states = StateMachine()
        self._make: Callable[[], RosBase] = lambda: RosBase(
            robot, limits=BaseLimits.of(dict(limits)), setpoint_timeout_s=LATE_CYCLES * CYCLE_S, needs_scan=needs_scan
        )
        self._readings: Vector = np.full(BEAM_COUNT, LASER_MAX)
        self._due_s = 0.0
        self._counts: dict[str, int] = {}
        self._lost: dict[str, int] = {}
        self._stale_actions = 0
        self._base = self._connected()
        self._mirror()

    # -- instead of the simulation's

    def place(
        self, pose: ArrayLike, *, target: ArrayLike | None = None, cubes: Sequence[ArrayLike] | Vector | None = None
    ) -> bool:
        """Start at the base's position with a new target, after confirmation. Raises RobotError if the base stopped."""
        if not self._is_up:
            return super().place(pose, target=target, cubes=cubes)
        if self.states.state == State.FAULT or self._base.fault:
            self._note_fault()
            self._lost = self._total()
            self._base.close()
            self._base = self._connected()
        self.stopped_by = None
        self._mirror()
        super().place(self.pose, target=target)
        x, y, _ = self.target
        self._operator.confirm(f"the robot will drive to {x:.2f}, {y:.2f} m in its odometry's frame")
        if self.states.state != State.HUMAN:
            self.states.enter(State.BLEND_IN)
            self._base.blend_in()
        self._operator.watch_keys()
        self._due_s = time.monotonic()
        self._mirror()
        return False

    def command(self, linear: float, angular: float) -> bool:
        """Replace the velocities [m/s], [rad/s]; return False if they are not used."""
        super().command(linear, angular)
        seen = self._seen
        age_s = time.monotonic() - seen.received_s + seen.age_s
        if self.states.state == State.HUMAN:
            return False
        if age_s > STALE_CYCLES * CYCLE_S + AGE_BOUND_S:
            self._stale_actions += 1
            self.hold()
            self.states.enter(State.HOLD, f"the action is for an observation {age_s:.2f} s old")
            return False
        self._base.command(linear, angular)
        return True

    def hold(self) -> None:
        """Decelerate and hold."""
        self._base.hold()

    def advance(self, substeps: int = 0) -> None:  # noqa: ARG002
        """Wait for the end of the control cycle and read the base's state."""
        now = time.monotonic()
        self._due_s = max(self._due_s + CYCLE_S, now)  # a missed cycle is not caught up
        time.sleep(self._due_s - now)
        self._mirror()
        self._follow_states()

    @property
    def scan(self) -> Vector:
        """All readings [m], (1012,), computed from the base's scans."""
        return self._readings

    @property
    def is_blocked(self) -> bool:
        """False: the base looks after itself."""
        return False

    def robot_info(self) -> dict[str, Any] | None:
        """Return the state, its changes and the applied limits since the last call."""
        counts = self._total()
        new = {name: count - self._counts.get(name, 0) for name, count in counts.items()}
        self._counts = counts
        info: dict[str, Any] = {"state": self.states.state.value}
        if any(new.values()):
            info["limited"] = {name: count for name, count in new.items() if count}
        if changes := self.states.take_changes():
            info["changes"] = [change._asdict() for change in changes]
        return info

    def limited(self) -> dict[str, int] | None:
        """Return the number of commands in which each limit was applied, and of stale actions."""
        return self._total()

    def take_over(self) -> None:
        """Leave the base to a person from the next control cycle on, or take it back."""
        self._operator.toggle()

    def close(self) -> None:
        """Stop the base and leave the graph."""
        self.states.enter(State.STOP, "the environment is closed")
        self._operator.close()
        self._base.close()

    # -- parts

    def _connected(self) -> RosBase:
        self.states.enter(State.CONNECT)
        base = self._make()
        self.states.enter(State.CHECK)
        self.states.enter(State.READY)
        return base

    def _total(self) -> dict[str, int]:
        counts = dict(self._lost)
        for name, count in self._base.limited().items():
            counts[name] = counts.get(name, 0) + count
        return counts | ({"stale_action": self._stale_actions} if self._stale_actions else {})

    def _mirror(self) -> None:
        """Set the model to the base's pose; hold and wait until its state is fresh."""
        limit = time.monotonic() + FRESH_S
        state = self._base.state()
        while time.monotonic() - state.received_s + state.age_s > AGE_BOUND_S and not self._note_fault():
            if time.monotonic() > limit:
                self.hold()
                self.stopped_by = "stale_observation"
                self.states.enter(State.FAULT, f"odometry or scan is still old after {FRESH_S:g} s")
                break
            time.sleep(0.005)
            state = self._base.state()
        self._seen = state
        x, y, yaw = state.pose
        linear, angular = state.velocity
        self.data.qpos[:] = x, y, yaw
        self.data.qvel[:] = linear * math.cos(yaw), linear * math.sin(yaw), angular
        mujoco.mj_kinematics(self.model, self.data)
        if state.readings is not None:
            self._readings = state.readings

    def _note_fault(self) -> bool:
        fault = self._base.fault
        if fault and self.states.state != State.FAULT:
            self.stopped_by = fault.partition(":")[0]
            self.states.enter(State.FAULT, fault)
        return bool(fault)

    def _follow_states(self) -> None:
        if self._note_fault() or self.states.state == State.FAULT:
            return
        if self._operator.has_taken_over:
            if self.states.state != State.HUMAN:
                self._base.free(True)
                self.states.enter(State.HUMAN, "taken over")
            return
        if self.states.state == State.HUMAN:
            self._base.free(False)
            self._base.blend_in()
            self.states.enter(State.BLEND_IN, "given back")
            return
        phase = self._base.phase
        if phase in _PHASE_STATES:
            self.states.enter(*_PHASE_STATES[phase])
        elif phase == Phase.FOLLOW:
            self.states.enter(State.RUN if self._base.blend >= 1.0 else State.BLEND_IN)
