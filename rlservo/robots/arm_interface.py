"""State, errors and address of a simulated or real arm."""

from __future__ import annotations

import platform
import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

RTDE, ROS2, ROSBRIDGE = "rtde://", "ros2:", "rosbridge://"
MUJOCO = "mujoco"
RUNNING, SAFE_MODES = 7, (1, 2)  # robot_mode, safety_mode: normal and reduced
STARTUP_MODES = ("disconnected", "confirm safety", "booting", "power off", "power on", "idle", "backdrive")
STOP_NAMES = {3: "protective_stop", 5: "safeguard_stop", 6: "emergency_stop", 7: "emergency_stop"}


class RobotError(ValueError):
    """The robot cannot be reached, is not ready, or has stopped; the message states the remedy."""


class RobotStoppedError(RobotError):
    """The robot has stopped and waits for a person: the run is over."""

    ends_run = True


class ArmState(NamedTuple):
    """State of an arm at one moment."""

    positions: Vector  # [rad], (6,), base to wrist_3
    velocities: Vector  # [rad/s], (6,)
    time_s: float  # the robot's own clock
    received_s: float  # time.monotonic() at its arrival
    age_s: float  # its age then, as far as the link's delay varies
    mode: str  # "running", or the reason why not
    safety: str  # "normal", or the kind of stop


def host_of(robot: str) -> str | None:
    """Return the host of 'rtde://HOST', None for 'mujoco', 'ros2:...' unchanged. Raises RobotError otherwise."""
    if robot == MUJOCO:
        return None
    if robot.startswith(ROS2):
        return robot
    host = robot.removeprefix(RTDE)
    if robot == host or not host or "/" in host or ":" in host:
        raise RobotError(f"robot {robot!r}: expected '{MUJOCO}', '{RTDE}HOST' or '{ROS2}'")
    return host


def mode_name(mode: int) -> str:
    return STARTUP_MODES[mode] if 0 <= mode < len(STARTUP_MODES) else f"robot mode {mode}"


def no_driver() -> str:
    """Return that ur-rtde is missing, and how to get it here."""
    how = "pip install '.[ur]' in the checkout of rlservo"
    here = f"Python {sys.version_info[0]}.{sys.version_info[1]} on {platform.machine()}"
    if here not in ("Python 3.11 on x86_64", "Python 3.12 on x86_64"):
        how = (
            f"ur-rtde has wheels for Python 3.11 and 3.12 on x86_64, and this is {here}: use one of these, compile it, "
            "or drive the arm through ROS 2 (robot=ros2:)"
        )
    return f"a real robot needs the Python package 'rtde_control': {how}"
