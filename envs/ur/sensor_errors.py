"""Errors of a UR arm's sensors, by observed element.

- Joint positions: noise 4e-5 rad, a repeatability of 0.1 mm (UR5 data sheet) at 0.85 m reach, taken as 3 sigma. Bias
  0.01 rad, what 1 cm at the tool comes to; the CB3 manual states a trueness of 1.15 degrees for the safety system.
- Joint velocities: noise 0.007 rad/s, the difference of two such positions 8 ms apart (the CB3 controller's 125 Hz).
- Tool: noise 0.1 mm, the repeatability. Bias 1 cm: without a robot's own calibration its position may be off "in the
  magnitude of centimeters" (ur_calibration's README, Universal_Robots_ROS_Driver).
- Targets and objects are seen by a depth camera of at most 2% error (Intel RealSense D435 data sheet): noise 5 mm, that
  at 0.75 m, taken as 3 sigma; bias 1 cm, that at 0.5 m.
"""

from __future__ import annotations

import math

from rlservo.robots.disturbable import SensorError
from rlservo.robots.ur.parameters import JOINTS, POSITION_LIMITS

REACH = 0.85  # [m], UR5
REPEATABILITY = 1e-4  # [m]
CONTROLLER_CYCLE_S = 0.008  # [s]
CALIBRATION = 0.01  # [m], at the tool
CAMERA_NOISE, CAMERA_BIAS = 0.005, 0.01  # [m]
TARGET_DISTANCE = 0.5  # [m], at which a camera's error is turned into an angle

JOINT_NOISE = REPEATABILITY / 3 / REACH  # [rad]
JOINT_BIAS = 0.01  # [rad]
VELOCITY_NOISE = math.sqrt(2.0) * JOINT_NOISE / CONTROLLER_CYCLE_S  # [rad/s]


def joint_errors(suffix: str) -> dict[str, SensorError]:
    """Return the errors of the six joint positions, over their limits; elements are called `<joint>_<suffix>`."""
    return {
        f"{joint}_{suffix}": SensorError(JOINT_NOISE / limit, JOINT_BIAS / limit)
        for joint, limit in zip(JOINTS, POSITION_LIMITS, strict=True)
    }


def velocity_errors() -> dict[str, SensorError]:
    """Return the errors of the six joint velocities; a difference of biased positions has no bias."""
    return {f"{joint}_velocity": SensorError(VELOCITY_NOISE, 0.0) for joint in JOINTS}


def polar_errors(prefix: str) -> dict[str, SensorError]:
    """Return the errors of a camera's positions, in polar coordinates."""
    angle = SensorError(CAMERA_NOISE / TARGET_DISTANCE, CAMERA_BIAS / TARGET_DISTANCE)
    return {
        f"{prefix}_r": SensorError(CAMERA_NOISE, CAMERA_BIAS),
        f"{prefix}_theta": angle,
        f"{prefix}_phi": angle,
    }


def position_errors() -> dict[str, SensorError]:
    """Return the errors of the target's and the tool's coordinates."""
    target = {f"target_{axis}": SensorError(CAMERA_NOISE, CAMERA_BIAS) for axis in "xyz"}
    return target | {f"ee_{axis}": SensorError(REPEATABILITY, CALIBRATION) for axis in "xyz"}
