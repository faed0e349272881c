"""Interface of an arm: what the environments, the robot server and `robot-latency` ask of one, simulated or real."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]

RTDE, ROS2, ROSBRIDGE = "rtde://", "ros2:", "rosbridge://"
MUJOCO = "mujoco"
STOP_NAMES = {3: "protective_stop", 5: "safeguard_stop", 6: "emergency_stop", 7: "emergency_stop"}


class RobotError(ValueError):
    """The robot cannot be reached, is not ready, or has stopped; the message says what to do."""


class ArmState(NamedTuple):
    """An arm at a moment."""

    positions: Vector  # [rad], (6,), base to wrist_3
    velocities: Vector  # [rad/s], (6,)
    time_s: float  # the robot's own clock
    received_s: float  # time.monotonic() of its arrival
    age_s: float  # how old it was then, as far as the link's delay varies
    mode: str  # "running", or why not
    safety: str  # "normal", or which stop


class Arm(Protocol):
    """An arm that is commanded joint positions, one setpoint after the other."""

    def arm_state(self) -> ArmState:
        """Return the newest state."""
        ...

    def command(self, joint_positions: ArrayLike) -> None:
        """Replace the setpoint: move to joint positions [rad] (6,), all joints arriving together."""
        ...

    def hold(self) -> None:
        """Stop where the arm is."""
        ...


def host_of(robot: str) -> str | None:
    """Return the host of 'rtde://HOST', None of 'mujoco', 'ros2:...' as it is. Raises RobotError for anything else."""
    if robot == MUJOCO:
        return None
    if robot.startswith(ROS2):
        return robot
    host = robot.removeprefix(RTDE)
    if robot == host or not host or "/" in host or ":" in host:
        raise RobotError(f"robot {robot!r}: expected '{MUJOCO}', '{RTDE}HOST' or '{ROS2}'")
    return host
