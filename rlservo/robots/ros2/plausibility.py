"""Inputs of a base that come on time but cannot be true: odometry or a scan that stands while the base is driven."""

from __future__ import annotations

import math

import numpy as np

from rlservo.robots.arm_interface import Vector
from rlservo.robots.ros2.clearance import Pose

STANDING = np.array([0.02, 0.05])  # [m], [rad], by which an odometry that counts as standing may still change
UNFOLLOWED = np.array([0.5, 0.8])  # [m], [rad] of commands that such an odometry may leave unanswered
REPEATED = np.array([0.1, 0.2])  # [m], [rad] of motion in which at least one reading of a scan changes


def moved(pose: Pose, before: Pose) -> Vector:
    """Return the distance [m] and the turn [rad] between two poses, (2,)."""
    (x, y, yaw), (x0, y0, yaw0) = pose, before
    return np.array([math.hypot(x - x0, y - y0), abs(math.remainder(yaw - yaw0, 2.0 * math.pi))])


class Progress:
    """The way that was commanded since the odometry last moved."""

    def __init__(self) -> None:
        self._place, self._yaw = (0.0, 0.0), 0.0  # from which the odometry has not moved
        self._commanded = np.zeros(2)

    def note(self, velocity: tuple[float, float], passed_s: float, pose: Pose) -> str:
        """Note a command [m/s], [rad/s]; return what is not followed, empty if all is."""
        self._commanded = self._commanded + np.array(velocity) * passed_s
        has_moved = moved(pose, (*self._place, self._yaw)) > STANDING
        if has_moved[0]:
            self._place = pose[0], pose[1]
        if has_moved[1]:
            self._yaw = pose[2]
        self._commanded[has_moved] = 0.0
        linear, angular = np.abs(self._commanded) > UNFOLLOWED
        if linear:
            return f"shows 0.0 m of the {abs(self._commanded[0]):.1f} m that it was driven"
        return f"shows 0.0 rad of the {abs(self._commanded[1]):.1f} rad that it was turned" if angular else ""


class ScanChange:
    """The base's pose at which a scan's present readings came first."""

    def __init__(self) -> None:
        self._points, self._pose = np.zeros((0, 2)), (0.0, 0.0, 0.0)

    def check(self, points: Vector, pose: Pose) -> None:
        """Raise ValueError for the points (n, 2) of a scan whose readings the base's motion does not change."""
        if not len(points) or not np.array_equal(points, self._points):
            self._points, self._pose = points, pose
        elif (moved(pose, self._pose) > REPEATED).any():
            raise ValueError("its ranges are the same to the last digit, though the base has moved")
