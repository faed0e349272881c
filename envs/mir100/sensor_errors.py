"""Errors of the MiR100's sensors, by observed element.

- Pose: bias 5 cm, the MiR100 data sheet's positioning accuracy; noise 1.7 cm, the same taken as 3 sigma.
- Velocities: noise 0.032 m/s and 0.071 rad/s. The real robot's odometry publishes a standard deviation of 3.2 mm for
  its position (DFKI-NI/mir_robot, diffdrive_controller.yaml: a variance of 1e-5 m^2), here over a control cycle; for
  turning, of wheels 0.445 m apart. Bias 2% of the largest command: wheels worn by 1.25 of 62.5 mm.
- Lasers: noise 0.01 m, robo-gym's figure for the SICK S300. It comes on top of the simulator's own 0.01 m: together
  1.4 cm, between the typical 12 and the largest 20 mm of SICK's scanners (SICK's knowledge base, LMS1xx). Bias 0.03 m,
  the typical systematic error there.
"""

from __future__ import annotations

import math

from rlservo.robots.disturbable import SensorError
from rlservo.robots.mir100.parameters import CYCLE_S, LASER_NOISE, WHEEL_SEPARATION

POSE_BIAS = 0.05  # [m]
POSE_NOISE = POSE_BIAS / 3  # [m]
TARGET_DISTANCE = 2.0  # [m], at which an error of the pose is turned into one of the target's direction
ODOMETRY_POSITION = math.sqrt(1e-5)  # [m]
WHEEL_WEAR = 0.02  # of the radius
LASER_BIAS = 0.03  # [m]


def sensor_errors(laser_count: int, largest_linear: float, largest_angular: float) -> dict[str, SensorError]:
    """Return the errors by element; the largest commands are in m/s and rad/s."""
    angular_noise = ODOMETRY_POSITION / WHEEL_SEPARATION / CYCLE_S
    errors = {
        "target_r": SensorError(POSE_NOISE, POSE_BIAS),
        "target_theta": SensorError(POSE_NOISE / TARGET_DISTANCE, POSE_BIAS / TARGET_DISTANCE),
        "linear_velocity": SensorError(ODOMETRY_POSITION / CYCLE_S, WHEEL_WEAR * largest_linear),
        "angular_velocity": SensorError(angular_noise, WHEEL_WEAR * largest_angular),
    }
    return errors | {f"laser_{index}": SensorError(LASER_NOISE, LASER_BIAS) for index in range(laser_count)}
