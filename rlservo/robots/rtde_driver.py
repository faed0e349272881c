"""A UR arm over RTDE, for the servo loop: the only place that knows ur_rtde's client."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rlservo.robots.arm_interface import RUNNING, SAFE_MODES, STOP_NAMES, RobotError, Vector, mode_name, no_driver
from rlservo.robots.arm_port import ZERO_SCALE, ArmReading, ServoSettings
from rlservo.robots.following_error import FollowingBound
from rlservo.robots.rtde_probe import no_answer
from rlservo.robots.ur.calibration import checked, frames_of, read_calibration
from rlservo.robots.ur.parameters import CB3, UR_PARAMETERS, model_of, rate_hz_of

FIRST_STATE_S = 5.0
SLOW_CALL_S = 0.3  # [s] for one command; beyond it, ur_rtde has lost the program or connected again
IS_PROGRAM_RUNNING = 2  # bit of the robot's status
PAUSING, PAUSED = 3, 4  # runtime_state
LINK_S = 0.03  # [s], for a command to reach the controller and its state to come back, over a cable
VARIABLES = [
    "timestamp", "actual_q", "actual_qd", "target_q", "robot_mode", "safety_mode", "robot_status_bits",
    "target_speed_fraction", "speed_scaling", "runtime_state",
]  # fmt: skip


class RtdeDriver:
    """The two connections of ur_rtde's client. Raises RobotError with what to do."""

    hint = "is something in its way, or does another program command it"

    def __init__(self, settings: ServoSettings) -> None:
        try:
            import dashboard_client
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise RobotError(no_driver()) from error
        self._control: Any = None
        host, limits = settings.host, settings.limits
        try:
            dashboard = dashboard_client.DashboardClient(host)
            dashboard.connect()
            self._check_model(settings, dashboard.getRobotModel(), dashboard.polyscopeVersion())
            is_local = settings.ur_model not in CB3 and not dashboard.isInRemoteControl()
            dashboard.disconnect()
        except RuntimeError as error:
            raise RobotError(no_answer(host, error)) from error
        self.frames: Vector | None = checked(frames_of(read_calibration(host)[0]), settings.ur_model)
        fastest = rate_hz_of(settings.ur_model)
        self.rate_hz = limits.rate_hz or fastest
        if self.rate_hz > fastest:
            raise RobotError(f"limits: rate_hz is {self.rate_hz:g}: the controller takes at most {fastest:g}")
        self._servo = limits.lookahead_s, limits.gain
        self.following = FollowingBound(0.005, limits.lookahead_s + LINK_S)
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(host, self.rate_hz, VARIABLES)
            self._check_modes(host)
            self._control = rtde_control.RTDEControlInterface(host, self.rate_hz)
            # It has seen the program run on a connection of its own; on a busy machine the other one is behind.
            _wait_until(lambda: self.read().is_program_running)
        except RobotError:
            raise
        except Exception as error:  # RuntimeError, logic_error as RuntimeError, boost's own
            hint = "see the pendant"
            if "in use" in str(error):
                hint = "end the other client or fieldbus adapter that writes them"
            elif is_local:
                hint = "enable remote control on the pendant (local, top right)"
            raise RobotError(f"the controller at {host} accepts no program ({str(error).strip()}): {hint}") from error
        self._control.setWatchdog(limits.watchdog_hz)  # from here on commands must follow immediately

    def read(self) -> ArmReading:
        """Return the newest state."""
        if not self._receive.isConnected():
            raise RobotError(self.silence())
        return reading_of(self._receive)

    def silence(self) -> str:
        """Return the only cause that can be known."""
        return "connection_lost: no state from the controller for 1 s: check its cable and its pendant"

    def send(self, setpoint: Vector) -> bool:
        """Command the next joint positions [rad] (6,); return whether the controller takes them."""
        began = time.monotonic()
        taken: bool = self._control.servoJ(setpoint.tolist(), 0.0, 0.0, 1.0 / self.rate_hz, *self._servo)
        return taken and time.monotonic() - began <= SLOW_CALL_S

    def hand_over(self, *, to_person: bool) -> None:
        """Let a person lead the arm, or hold it again where it is."""
        if to_person:
            self._control.servoStop()
            self._control.teachMode()
        else:
            self._control.endTeachMode()

    def keep_alive(self) -> None:
        """Feed the controller's watchdog."""
        self._control.kickWatchdog()

    def _check_model(self, settings: ServoSettings, model: str, version: str) -> None:
        found = model_of(model, version)
        if UR_PARAMETERS.get(found) != UR_PARAMETERS[settings.ur_model]:
            raise RobotError(f"the controller at {settings.host} is a {found}'s, but ur_model is {settings.ur_model}")

    def _check_modes(self, host: str) -> None:
        _wait_until(lambda: self._receive.getTimestamp() != 0.0)
        mode, safety = self._receive.getRobotMode(), self._receive.getSafetyMode()
        if safety not in SAFE_MODES:
            name = STOP_NAMES.get(safety, f"safety mode {safety}").replace("_", " ")
            raise RobotError(f"the robot at {host} is in {name}: find the cause, then unlock it on the pendant")
        if mode != RUNNING:
            raise RobotError(f"the robot at {host} is in {mode_name(mode)}: power it on and release the brakes")
        if self._receive.getTargetSpeedFraction() < ZERO_SCALE:
            raise RobotError(f"the speed slider of the robot at {host} is at 0: raise it on the pendant")

    def close(self) -> None:
        if self._control is not None:
            self._control.stopScript()
            self._control.disconnect()
        self._receive.disconnect()


def reading_of(receive: Any) -> ArmReading:
    """Return the newest state; what ends a program is read after the program, so that it is known as the cause."""
    return ArmReading(
        timestamp=receive.getTimestamp(),
        age_s=None,
        positions=np.array(receive.getActualQ()),
        velocities=np.array(receive.getActualQd()),
        targets=np.array(receive.getTargetQ()),
        scaling=receive.getTargetSpeedFraction() * receive.getSpeedScaling(),
        is_program_running=bool(receive.getRobotStatus() & IS_PROGRAM_RUNNING),
        is_program_paused=receive.getRuntimeState() in (PAUSING, PAUSED),
        robot_mode=receive.getRobotMode(),
        safety_mode=receive.getSafetyMode(),
    )


def _wait_until(condition: Callable[[], bool]) -> None:
    limit = time.monotonic() + FIRST_STATE_S
    while not condition() and time.monotonic() < limit:
        time.sleep(0.005)
