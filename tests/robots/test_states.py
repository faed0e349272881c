"""State machine around a policy that drives a real arm."""

from __future__ import annotations

import logging

import pytest

from rlservo.robots.arm_states import ControlState, StateMachine


def test_each_change_is_one_log_line_and_is_given_away_once(caplog: pytest.LogCaptureFixture) -> None:
    machine = StateMachine()
    with caplog.at_level(logging.INFO, logger="rlservo.robot"):
        for state in (
            ControlState.CHECK,
            ControlState.READY,
            ControlState.READY,
            ControlState.BLEND_IN,
            ControlState.RUN,
        ):
            machine.enter(state)
        machine.enter(ControlState.FAULT, "protective_stop: look")
    assert len(caplog.messages) == 5
    assert caplog.messages[-1] == "robot: run -> fault: protective_stop: look"
    assert [change.state for change in machine.take_changes()] == ["check", "ready", "blend_in", "run", "fault"]
    assert machine.take_changes() == []


def test_nothing_but_a_new_connection_follows_a_fault() -> None:
    machine = StateMachine()
    machine.enter(ControlState.FAULT)
    with pytest.raises(AssertionError, match="state run cannot follow fault"):
        machine.enter(ControlState.RUN)
    machine.enter(ControlState.CONNECT)
