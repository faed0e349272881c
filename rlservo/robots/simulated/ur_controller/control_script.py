"""ur_rtde's control script as the simulated controller runs it: command numbers in, motions out.

Source of numbers and registers: ur_rtde 1.5 and 1.6, scripts/rtde_control.script. A generator represents the program:
each `next` runs the script's part between two `sync()`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator

from rlservo.robots.simulated.ur_controller.controller import Controller, RobotMode, SafetyMode
from rlservo.robots.simulated.ur_controller.tool import NO_OFFSET
from rlservo.robots.ur.parameters import POSITION_LIMITS

log = logging.getLogger("rlservo.ur_controller")

MARK = "RTDE Control Script"  # part of the text of every version
NO_COMMAND, STOP_SCRIPT = 0, 255
READY, DONE = 1, 2  # output_int_register_0
SERVOJ, SPEEDJ = 11, 9
REAL_TIME = {SERVOJ, SPEEDJ, 26, 27, 38, 58}  # answered with READY in the same cycle and read again in the next
_OFFSET = re.compile(r"reg_offset_int\s*=[^\n]*\n?\s*([0-9]+)")


def load_program(controller: Controller, text: str) -> None:
    """Run a URScript program; only ur_rtde's control script is supported. A running program is ended."""
    if not controller.is_remote:
        log.warning("a program was refused: the controller is in local control")
        return
    if controller.robot_mode != RobotMode.RUNNING or controller.safety_mode != SafetyMode.NORMAL:
        modes = (controller.robot_mode.name, controller.safety_mode.name)
        log.warning("a program was refused: the robot is %s, %s", *modes)
        return
    controller.start_program(control_program(controller, text))


def control_program(controller: Controller, text: str) -> Iterator[None]:
    """Return the running program; anything but ur_rtde's control script ends at once with a log line."""
    if MARK not in text:
        log.warning("a program of %d characters was not run: it is not ur_rtde's control script", len(text))
        return
    found = _OFFSET.search(text)
    program = _ControlScript(controller, int(found[1]) if found else 0)
    yield from program.run()


class _ControlScript:
    def __init__(self, controller: Controller, offset: int) -> None:
        self._arm, self._offset = controller, offset
        self._is_moving_async = False
        self._async_progress = -1

    def run(self) -> Iterator[None]:
        """Read the command register once a cycle until the stop command."""
        self._write_int(2, self._async_progress)
        self._write_int(0, READY)
        is_executing = False
        while True:
            command = self._int(0)
            if self._is_moving_async and not self._arm.is_moving:
                self._finish_async()
            if command in REAL_TIME:
                COMMANDS[command](self)
                self._write_int(0, READY)
            elif command == NO_COMMAND:
                is_executing = False
                self._write_int(0, READY)
            elif command == STOP_SCRIPT:
                return
            elif not is_executing:
                if command not in COMMANDS:
                    log.error("command %d of ur_rtde is not simulated: the program ends", command)
                    return
                yield from COMMANDS[command](self) or ()
                self._write_int(0, DONE)
                is_executing = True
            yield

    # -- registers

    def _int(self, index: int) -> int:
        return self._arm.inputs_int[index + self._offset]

    def _double(self, index: int) -> float:
        return self._arm.inputs_double[index + self._offset]

    def _six(self, first: int = 0) -> list[float]:
        start = first + self._offset
        return self._arm.inputs_double[start : start + 6]

    def _write_int(self, index: int, value: int) -> None:
        self._arm.outputs_int[index + self._offset] = value

    def _write_doubles(self, values: list[float]) -> None:
        self._arm.outputs_double[self._offset : self._offset + len(values)] = values

    # -- commands

    def movej(self) -> Iterator[None] | None:
        self._arm.move(self._six(), self._double(6), self._double(7))
        if self._int(1) == 1:
            self._is_moving_async = True
            self._write_int(2, 0)
            return None
        return self._wait()

    def servoj(self) -> None:
        self._arm.servo(self._six(), self._double(9))

    def speedj(self) -> None:
        self._arm.speed(self._six(), self._double(6))

    def stop(self) -> Iterator[None]:
        if self._is_moving_async:
            self._finish_async()
        self._arm.stop(self._double(0))
        return self._wait()

    def set_payload(self) -> None:
        self._arm.payload_kg = self._double(0)
        self._arm.payload_centre = self._six()[1:4]

    def set_tool(self) -> None:
        self._arm.tool.offset = self._six()

    def free(self) -> None:
        self._arm.set_free(True)

    def hold(self) -> None:
        self._arm.set_free(False)

    def step_time(self) -> None:
        self._write_doubles([self._arm.dt])

    def history(self) -> None:
        self._write_doubles(self._arm.positions_before(self._int(1)))

    def protective_stop(self) -> None:
        self._arm.stop_protectively("requested by the program")

    def set_watchdog(self) -> None:
        self._arm.set_watchdog(self._offset, self._double(0))

    def joints_within_limits(self) -> None:
        self._write_int(1, int(all(abs(q) <= limit for q, limit in zip(self._six(), POSITION_LIMITS, strict=True))))

    def tcp_offset(self) -> None:
        self._write_doubles([*self._arm.tool.offset])

    def tool_pose(self) -> None:
        self._write_doubles(self._arm.tool.pose(self._arm.simulation.joint_positions))

    def tool_pose_at(self) -> None:
        self._write_doubles(self._arm.tool.pose(self._six(), self._six(6)))

    def flange_pose(self) -> None:
        self._write_doubles(self._arm.tool.pose(self._arm.simulation.joint_positions, NO_OFFSET))

    def external_torques(self) -> None:
        self._write_doubles([0.0] * 6)  # a contact stops the arm, and nothing else pushes it

    def is_steady(self) -> None:
        self._write_int(1, int(not self._arm.is_moving))

    def _wait(self) -> Iterator[None]:
        while self._arm.is_moving:
            yield

    def _finish_async(self) -> None:
        self._is_moving_async = False
        self._async_progress = -2 if self._async_progress == -1 else -1
        self._write_int(2, self._async_progress)


COMMANDS: dict[int, Callable[[_ControlScript], Iterator[None] | None]] = {
    1: _ControlScript.movej,
    SPEEDJ: _ControlScript.speedj,
    SERVOJ: _ControlScript.servoj,
    15: _ControlScript.stop,
    16: _ControlScript.stop,
    17: _ControlScript.set_payload,
    18: _ControlScript.free,
    19: _ControlScript.hold,
    26: _ControlScript.step_time,
    27: _ControlScript.history,
    29: _ControlScript.set_tool,
    31: _ControlScript.protective_stop,
    33: _ControlScript.stop,
    34: _ControlScript.stop,
    35: _ControlScript.set_watchdog,
    37: _ControlScript.joints_within_limits,
    38: _ControlScript.external_torques,
    40: _ControlScript.tcp_offset,
    43: _ControlScript.tool_pose,
    44: _ControlScript.tool_pose_at,
    47: _ControlScript.is_steady,
    52: _ControlScript.free,
    53: _ControlScript.hold,
    58: _ControlScript.flange_pose,
    65: _ControlScript.set_payload,  # and an inertia, which is not reported
}
