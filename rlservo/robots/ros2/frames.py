"""Frames of a robot: tf2's static transforms between them.

A transform is a matrix (4, 4) that turns a point of one frame [m] into the other's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

LONGEST_CHAIN = 100  # frames between two others; a loop would have no end
LEVEL = math.cos(math.radians(5.0))  # cosine of a plane's inclination up to which it counts as horizontal

Matrix = NDArray[np.float64]


def planar_transform(x: float, y: float, yaw: float) -> Matrix:
    """Return the transform of a frame at x, y [m] that is turned by yaw [rad]."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def planar_pose(transform: Matrix) -> tuple[float, float, float]:
    """Return a transform's x, y [m] and yaw [rad]. Raises ValueError if its z axis does not point up."""
    if transform[2, 2] < LEVEL:
        raise ValueError("its z axis does not point up")
    return float(transform[0, 3]), float(transform[1, 3]), math.atan2(transform[1, 0], transform[0, 0])


def inverse(transform: Matrix) -> Matrix:
    """Return the transform in the other direction."""
    return np.asarray(np.linalg.inv(transform), dtype=np.float64)


def plain(frame: str) -> str:
    """Return a frame's name without the slash that tf of ROS 1 put before it."""
    return frame.removeprefix("/")


class Frames:
    """The tree of static transforms, as far as it has been published."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Matrix]] = {}

    def take(self, message: Any) -> None:
        """Take a TFMessage. Raises ValueError for a transform that is none; the others are taken."""
        wrong = []
        for one in message.transforms:
            matrix = _matrix(one.transform)
            if np.isfinite(matrix).all():
                self._parents[plain(one.child_frame_id)] = plain(one.header.frame_id), matrix
            else:
                wrong.append(one.child_frame_id)
        if wrong:
            raise ValueError(f"the transform of {', '.join(wrong)} has numbers that are not finite")

    def transform(self, frame: str, into: str) -> Matrix | None:
        """Return the transform of `frame` into another one; None if nothing static connects them."""
        root, matrix = self._to_root(plain(frame))
        other, base = self._to_root(plain(into))
        return inverse(base) @ matrix if root == other else None

    def _to_root(self, frame: str) -> tuple[str, Matrix]:
        matrix = np.eye(4)
        for _ in range(LONGEST_CHAIN):
            if frame not in self._parents:
                break
            frame, step = self._parents[frame]
            matrix = step @ matrix
        return frame, matrix


def _matrix(transform: Any) -> Matrix:
    """Return a geometry_msgs/Transform as a matrix; NaN if its quaternion is zero."""
    place, turn = transform.translation, transform.rotation
    length = math.hypot(turn.x, turn.y, turn.z, turn.w) or math.nan
    x, y, z, w = turn.x / length, turn.y / length, turn.z / length, turn.w / length
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), place.x],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), place.y],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), place.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
