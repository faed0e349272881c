"""The common part of a real arm and a real base.

A simulation follows the robot's measured state, and a control cycle passes in real time. The state machine around the
policy is here: faults and connecting again, a person who takes over, late and stale commands.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from rlservo.robots.arm_states import ControlState, StateMachine
from rlservo.robots.control_law import Phase
from rlservo.robots.operator_terminal import Operator

FRESH_S = 6.0  # [s] to wait for a fresh state; ur_rtde itself waits for 3 s
STALE_CYCLES = 2.0  # between an observation and the action for it
LATE_CYCLES = 2.5  # between two commands
LOOK_S = 0.002

_PHASE_STATES = {
    Phase.LATE: (ControlState.HOLD, "no setpoint came"),
    Phase.STALE: (ControlState.HOLD, "the robot's state is old"),
    Phase.BEHIND: (ControlState.HOLD, "the robot is too far behind its setpoint"),
}


class Measured(Protocol):
    """A robot's state: when it arrived, by time.monotonic(), and how old it was then [s]."""

    @property
    def received_s(self) -> float: ...
    @property
    def age_s(self) -> float: ...


class CommandedRobot(Protocol):
    """A robot that executes one command after another; `fault` is empty while it accepts them."""

    @property
    def phase(self) -> Phase: ...
    @property
    def blend(self) -> float: ...
    @property
    def fault(self) -> str: ...
    def hold(self) -> None: ...
    def free(self) -> None: ...
    def blend_in(self) -> None: ...
    def limited(self) -> dict[str, int]: ...
    def close(self) -> None: ...


RobotT = TypeVar("RobotT", bound=CommandedRobot)
MeasuredT = TypeVar("MeasuredT", bound=Measured)


class RealRobot(ABC, Generic[RobotT, MeasuredT]):
    """A robot that a policy drives through `robot_port.Robot`, and the simulation that shows it."""

    stopped_by: str | None = None

    def __init__(
        self, connect: Callable[[float], RobotT], operator: Operator, *, cycle_s: float, age_bound_s: float
    ) -> None:
        """`connect` takes the time [s] after which the robot holds without a command; its errors are raised."""
        self.operator, self.states = operator, StateMachine()
        self.is_called_off: Callable[[], bool] = lambda: False  # whether a motion to the start is to end
        self.stale_actions = 0
        self._connect, self._cycle_s, self._age_bound_s = connect, cycle_s, age_bound_s
        self._due_s, self._stop_reason, self._is_led = 0.0, "", False
        self._counts: dict[str, int] = {}
        self._lost: dict[str, int] = {}  # counts of closed connections
        self._robot = self._connected()
        self.state_seen = self._newest()

    @property
    def is_led(self) -> bool:
        """Whether a person leads the robot, or will once it is at rest."""
        return self._is_led or self.operator.has_taken_over

    # -- what an arm or a base adds

    @abstractmethod
    def _newest(self) -> MeasuredT:
        """Return the robot's newest state."""

    @abstractmethod
    def _show(self, state: MeasuredT) -> None:
        """Set the simulation to the robot's state."""

    # -- of the port

    def hold(self) -> None:
        """Decelerate and hold, unless a person leads the robot."""
        if not self.is_led:
            self._robot.hold()

    def advance(self) -> None:
        """Wait for the end of the control cycle and read the robot's state."""
        now = time.monotonic()
        self._due_s = max(self._due_s + self._cycle_s, now)  # a cycle that was missed is not caught up
        time.sleep(self._due_s - now)
        self._look()
        self._follow_states()

    def robot_info(self) -> dict[str, Any]:
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
        """Let a person lead the robot from the next control cycle on, or return it to the policy."""
        self.operator.toggle()

    def limited(self) -> dict[str, int]:
        """Return the number of commands in which each limit was applied, by element, and of stale actions."""
        counts = dict(self._lost)
        for name, count in self._robot.limited().items():
            counts[name] = counts.get(name, 0) + count
        return counts | ({"stale_action": self.stale_actions} if self.stale_actions else {})

    def close(self) -> None:
        """Stop the robot and close the connection."""
        self.states.enter(ControlState.STOP, "the environment is closed")
        self.operator.close()
        self._robot.close()

    # -- for an arm and a base

    def _recover(self) -> None:
        """Connect again after a fault, once a person agrees. Raises RobotError without, or if it is not ready."""
        if not self._note_fault() and self.states.state != ControlState.FAULT:
            return
        self.operator.confirm_restart(self._stop_reason)
        self._lost = self.limited()
        self._robot.close()
        self._robot = self._connected()

    def _begin(self) -> None:
        """Begin an episode, standing: the first command starts to blend in."""
        if not self.is_led and self.states.state != ControlState.FAULT:
            self.states.enter(ControlState.BLEND_IN)
            self._robot.blend_in()
        self.operator.watch_keys()
        self._due_s = time.monotonic()

    def _may_act(self) -> bool:
        """Return whether a command may go to the robot; hold if the observation is too old to act on."""
        if self.is_led or self.states.state == ControlState.FAULT:
            return False
        age_s = _age_s(self.state_seen)
        if age_s <= STALE_CYCLES * self._cycle_s + self._age_bound_s:
            return True
        self.stale_actions += 1
        self.hold()
        self.states.enter(ControlState.HOLD, f"the action is for an observation {age_s:.2f} s old")
        return False

    def _look(self) -> None:
        """Set the simulation to the robot's state; hold and wait until it is fresh."""
        limit = time.monotonic() + FRESH_S
        state = self._newest()
        while _age_s(state) > self._age_bound_s and not self._note_fault():
            if self.states.state in (ControlState.BLEND_IN, ControlState.RUN):  # said before it is waited for
                self.states.enter(ControlState.HOLD, f"the robot's newest state is {_age_s(state):.2f} s old")
            if time.monotonic() > limit:
                self.stopped_by = "stale_observation"
                self.hold()
                why = f"the robot's newest state is {_age_s(state):.2f} s old, after {FRESH_S:g} s"
                self._stop_reason = f"stale_observation: {why}"
                self.states.enter(ControlState.FAULT, why)
                break
            time.sleep(LOOK_S)
            state = self._newest()
        self.state_seen = state
        self._show(state)

    # -- parts

    def _connected(self) -> RobotT:
        self.states.enter(ControlState.CONNECT)
        robot = self._connect(LATE_CYCLES * self._cycle_s)
        self.states.enter(ControlState.CHECK)
        self.states.enter(ControlState.READY)
        return robot

    def _note_fault(self) -> bool:
        fault = self._robot.fault
        if fault and self.states.state != ControlState.FAULT:
            self.stopped_by, self._stop_reason = fault.partition(":")[0], fault
            self.states.enter(ControlState.FAULT, fault)
        return bool(fault)

    def _follow_states(self) -> None:
        """Follow the robot's phase and the operator at the terminal."""
        if self._note_fault() or self.states.state == ControlState.FAULT:
            return
        if self.operator.has_taken_over:
            self._is_led = True
            if self.states.state != ControlState.HUMAN:
                self._robot.free()
                if self._robot.phase == Phase.FREE:
                    self.states.enter(ControlState.HUMAN, "taken over")
                else:
                    self.states.enter(ControlState.HOLD, "a person takes over once it is at rest")
            return
        if self._is_led:
            self._is_led = False
            self._robot.blend_in()
            self.states.enter(ControlState.BLEND_IN, "given back")
            return
        phase = self._robot.phase
        if phase in _PHASE_STATES:
            self.states.enter(*_PHASE_STATES[phase])
        elif phase == Phase.FOLLOW:
            self.states.enter(ControlState.RUN if self._robot.blend >= 1.0 else ControlState.BLEND_IN)


def _age_s(state: Measured) -> float:
    return time.monotonic() - state.received_s + state.age_s
