"""robo-gym's RobotServer service for a robot: the only file here that knows both.

An error is answered with `success = false`: the message has no field for a reason, which is in the log.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import grpc

from rlservo.envs.robot_server.clock import Clock
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, Action, Empty, State, Success
from rlservo.envs.robot_server.robots.robot import RobotState, ServedRobot
from rlservo.envs.robot_server.rpc_handler import rpc_handler

log = logging.getLogger("rlservo.robot_server")


class RobotService:
    """The four calls. One command at a time; looking at the state never waits for a cycle to end."""

    def __init__(self, robot: ServedRobot, clock: Clock, *, gui: bool = False) -> None:
        self._robot, self._clock, self._gui = robot, clock, gui
        self._state_lock = threading.Lock()  # held while the simulation runs
        self._turn = threading.Lock()  # held by a command until its cycle is over

    def handler(self) -> grpc.GenericRpcHandler:
        """Return the handler for a gRPC server."""
        calls: dict[str, Callable[[bytes], Any]] = {
            "GetState": self.get_state,
            "SetState": self.set_state,
            "SendAction": self.send_action,
            "SendActionGetState": self.send_action_get_state,
        }
        kinds = {"GetState": State, "SendActionGetState": State, "SetState": Success, "SendAction": Success}

        def fail(name: str, _reason: str) -> Any:
            return kinds[name](success=False)

        return rpc_handler(ROBOT_SERVER, calls, fail, log)

    def get_state(self, request: bytes) -> Any:
        """Answer GetState."""
        Empty.FromString(request)
        with self._state_lock:
            self._catch_up()
            return _message(self._robot.state())

    def set_state(self, request: bytes) -> Any:
        """Answer SetState."""
        message = State.FromString(request)
        target = RobotState(
            values=list(message.state),
            names=dict(message.state_dict),
            float_params=dict(message.float_params),
            string_params=dict(message.string_params),
        )
        with self._turn:
            with self._state_lock:
                due = self._clock.count_cycles(self._robot.set_state(target))
                self._show()
            self._clock.wait(due)
        return Success(success=True)

    def send_action(self, request: bytes) -> Any:
        """Answer SendAction."""
        self._act(request)
        return Success(success=True)

    def send_action_get_state(self, request: bytes) -> Any:
        """Answer SendActionGetState."""
        return _message(self._act(request, with_state=True))

    def _act(self, request: bytes, *, with_state: bool = False) -> RobotState:
        action = list(Action.FromString(request).action)
        with self._turn:
            with self._state_lock:
                self._catch_up()
                self._robot.act(action)
                due = self._clock.count_cycles(1)
                state = self._robot.state() if with_state else RobotState()
                self._show()
            self._clock.wait(due)
        return state

    def _catch_up(self) -> None:
        cycles = self._clock.count_missed_cycles()
        if cycles:
            self._robot.idle(cycles)

    def _show(self) -> None:
        if not self._gui:
            return
        try:
            self._robot.camera.show()
        except Exception as error:  # whatever a display can do; the robot continues without a window
            log.warning("%s: the robot continues without a window", error)
            self._gui = False


def _message(state: RobotState) -> Any:
    return State(state=state.values, state_dict=state.names, success=True)
