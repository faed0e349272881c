"""State machine around a policy that drives a real arm."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

log = logging.getLogger("rlservo.robot")


class ControlState(str, Enum):
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


_MOVING = {
    ControlState.BLEND_IN,
    ControlState.RUN,
    ControlState.HOLD,
    ControlState.HUMAN,
    ControlState.READY,
    ControlState.GO_TO_START,
}
FOLLOWS: dict[ControlState, set[ControlState]] = {
    ControlState.CONNECT: {ControlState.CHECK},
    ControlState.CHECK: {ControlState.READY},
    ControlState.READY: {ControlState.GO_TO_START, ControlState.BLEND_IN, ControlState.HOLD, ControlState.HUMAN},
    ControlState.GO_TO_START: {ControlState.READY},
    ControlState.BLEND_IN: _MOVING,
    ControlState.RUN: _MOVING,
    ControlState.HOLD: _MOVING,
    ControlState.HUMAN: {ControlState.READY, ControlState.BLEND_IN, ControlState.HOLD},
    ControlState.STOP: {ControlState.CONNECT},
    ControlState.FAULT: {ControlState.CONNECT},
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
        self.state = ControlState.CONNECT
        self.changes: list[Change] = []
        self.on_change: Callable[[Change], object] = lambda _: None

    def enter(self, state: ControlState, why: str = "") -> None:
        """Change the state; does nothing if it is already in that state."""
        if state == self.state:
            return
        allowed = FOLLOWS[self.state] | {ControlState.STOP, ControlState.FAULT}
        assert state in allowed, f"state {state.value} cannot follow {self.state.value}"
        before, self.state = self.state, state
        level = logging.WARNING if state in (ControlState.FAULT, ControlState.HUMAN) else logging.INFO
        log.log(level, "robot: %s -> %s%s", before.value, state.value, f": {why}" if why else "")
        self.changes.append(Change(time.time(), state.value, why))
        self.on_change(self.changes[-1])

    def take_changes(self) -> list[Change]:
        """Return the changes since the last call."""
        changes, self.changes = self.changes, []
        return changes
