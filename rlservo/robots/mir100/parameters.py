"""Parameters of the MiR100. Everything else about the robot is computed from them.

Sources: body, wheels, scanner poses, scanner range and noise from the robot description of DFKI-NI/mir_robot
(mir_100_v1.urdf.xacro, sick_s300.urdf.xacro), speed limits and the timeout from its diff_drive_controller settings
(diffdrive_controller.yaml), the dropped beams, the 0.04 m rule and the cycle from jr-robotics/robo-gym-robot-servers
(mir100_robot_server). The robot frame is base_link: its origin on the floor below the middle of the wheel axle, x
ahead, y to the left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CYCLE_S = 0.1  # [s], one command and one reading of everything

# Body
LENGTH, WIDTH, HEIGHT = 0.9, 0.58, 0.3  # [m]
BODY_CENTRE = (0.037646, 0.0, 0.2)  # [m], in base_link
MASS = 58.0  # [kg]
WHEEL_RADIUS, WHEEL_WIDTH, WHEEL_SEPARATION = 0.0625, 0.032, 0.445208  # [m]
CASTERS = ((0.303146, 0.203), (0.303146, -0.203), (-0.308354, 0.203), (-0.308354, -0.203))  # [m], x and y of the wheels
WHEEL_EFFORT = 100.0  # [Nm], what each drive wheel can exert

# Drive
MAX_LINEAR_VELOCITY, MAX_ANGULAR_VELOCITY = 1.0, 1.5  # [m/s], [rad/s]
MAX_LINEAR_ACCELERATION, MAX_ANGULAR_ACCELERATION = 2.0, 2.5  # [m/s^2], [rad/s^2]
COMMAND_TIMEOUT_S = 0.5  # [s], an older command stops the robot

# Laser scanners (SICK S300)
LASER_MIN, LASER_MAX = 0.05, 29.0  # [m]
LASER_NOISE = 0.01  # [m], standard deviation
SAFETY_DISTANCE = 0.04  # [m], no move is accepted while a beam is shorter


@dataclass(frozen=True)
class Scanner:
    """One scanner: 541 beams over -135 .. 135 degrees of its own x axis, counter-clockwise, ends dropped."""

    name: str
    position: tuple[float, float, float]  # [m], in base_link
    yaw: float  # [rad], of its x axis in base_link
    dropped_first: int
    dropped_last: int

    BEAMS = 541
    HALF_ANGLE = math.radians(135.0)

    @property
    def count(self) -> int:
        """Number of beams that are left."""
        return self.BEAMS - self.dropped_first - self.dropped_last

    @property
    def angles(self) -> NDArray[np.float64]:
        """The direction of each beam that is left, [rad] in base_link, (count,); not wrapped."""
        own = np.linspace(-self.HALF_ANGLE, self.HALF_ANGLE, self.BEAMS)
        return own[self.dropped_first : self.BEAMS - self.dropped_last] + self.yaw


# The robot's own housing blinds the dropped beams: on the real robot they read zero.
FRONT_SCANNER = Scanner("front", (0.4288, 0.2358, 0.1914), math.pi / 4, 30, 10)
BACK_SCANNER = Scanner("back", (-0.3548, -0.2352, 0.1914), -3 * math.pi / 4, 10, 20)
BEAM_COUNT = FRONT_SCANNER.count + BACK_SCANNER.count  # 501 + 511
