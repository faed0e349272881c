"""State machine around a policy that drives a real arm."""

from __future__ import annotations

import logging
import time
from enum import Enum
from typing import NamedTuple

log = logging.getLogger("rlservo.robot")


class State(str, Enum):
    """State of the control of an arm."""

    CONNECT = "connect"
    CHECK = "check"
    READY = "ready"
    GO_TO_START = "go_to_start"
    BLEND_IN = "blend_in"
    RUN = "run"
    HOLD = "hold"
    HUMAN = "human"
    STOP = "stop"
    FAULT = "fault"


_MOVING = {State.BLEND_IN, State.RUN, State.HOLD, State.HUMAN, State.READY, State.GO_TO_START}
FOLLOWS: dict[State, set[State]] = {
    State.CONNECT: {State.CHECK},
    State.CHECK: {State.READY},
    State.READY: {State.GO_TO_START, State.BLEND_IN, State.HUMAN},
    State.GO_TO_START: {State.READY},
    State.BLEND_IN: _MOVING,
    State.RUN: _MOVING,
    State.HOLD: _MOVING,
    State.HUMAN: {State.READY, State.BLEND_IN, State.HOLD},
    State.STOP: {State.CONNECT},
    State.FAULT: {State.CONNECT},
}
"""Allowed next states; every state may end in STOP or FAULT."""


class Change(NamedTuple):
    """One change of state."""

    wall_s: float  # seconds since 1970
    state: str
    why: str


class StateMachine:
    """The state and its changes, each logged and kept for a recording."""

    def __init__(self) -> None:
        self.state = State.CONNECT
        self.changes: list[Change] = []

    def enter(self, state: State, why: str = "") -> None:
        """Change the state; does nothing if it is already in that state."""
        if state == self.state:
            return
        allowed = FOLLOWS[self.state] | {State.STOP, State.FAULT}
        assert state in allowed, f"state {state.value} cannot follow {self.state.value}"
        before, self.state = self.state, state
        level = logging.WARNING if state in (State.FAULT, State.HUMAN) else logging.INFO
        log.log(level, "robot: %s -> %s%s", before.value, state.value, f": {why}" if why else "")
        self.changes.append(Change(time.time(), state.value, why))

    def take_changes(self) -> list[Change]:
        """Return the changes since the last call."""
        changes, self.changes = self.changes, []
        return changes
