"""Clearance of a base's motion: its body, a polygon, among scanned obstacles and space that no scan shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

INSTANTS = 5  # points checked on the path to a standstill
SPACING_M = 0.08  # [m] between two points of the body's edge that have to be seen
GAP_M = 0.06  # [m] from a point of space to the nearest beam with a reading, if the point counts as seen
SWEPT_M = 0.02  # [m] by which a turn moves a point of the edge outward before it has to be seen
FACING = 0.5  # cosine of an edge's direction to that of the motion, if it leads

Vector = NDArray[np.float64]
Pose = tuple[float, float, float]  # [m], [m], [rad]


class Scan(NamedTuple):
    """Beams of one scanner, in the base's frame."""

    origin: Vector  # [m], (2,)
    directions: Vector  # (n, 2)
    is_known: NDArray[np.bool_]  # (n,), whether a beam shows that its way is free, or what it meets
    points: Vector  # [m], (k, 2), that beams meet


class BaseMotion(NamedTuple):
    """Velocities that are kept for a while, and then braked from."""

    linear: float  # [m/s]
    angular: float  # [rad/s]
    kept_s: float
    braking_s: float

    @property
    def duration_s(self) -> float:
        """The time to standstill [s]."""
        return self.kept_s + self.braking_s

    def pose_after(self, share: float) -> Pose:
        """Return the pose after a share of the two times; decelerating, it covers half of the distance."""
        time_s = share * (self.kept_s + self.braking_s * (1.0 - share / 2.0))
        yaw = self.angular * time_s
        return self.linear * time_s * math.cos(yaw / 2.0), self.linear * time_s * math.sin(yaw / 2.0), yaw


@dataclass(frozen=True)
class Body:
    """A base's body in its own frame: corners [m] (n, 2) of a polygon."""

    corners: Vector

    @property
    def radius(self) -> float:
        """The farthest corner's distance from the frame's origin [m]."""
        return float(np.hypot(*self.corners.T).max())

    def distances(self, points: Vector, pose: Pose = (0.0, 0.0, 0.0)) -> Vector:
        """Return each point's distance [m] from the body at a pose, negative inside."""
        x, y, yaw = pose
        points = _turned(points - (x, y), -yaw)
        starts, edges = self.corners, np.roll(self.corners, -1, axis=0) - self.corners
        ways = points[:, None] - starts
        shares = np.clip((ways * edges).sum(axis=2) / (edges**2).sum(axis=1), 0.0, 1.0)
        outside: Vector = np.linalg.norm(ways - shares[..., None] * edges, axis=2).min(axis=1)
        return np.where(self._holds(points), -outside, outside)

    def edge(self) -> tuple[Vector, Vector]:
        """Return points [m] all along the edge (n, 2), and the directions outward there (n, 2)."""
        points, normals = [], []
        for start, end in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            way = end - start
            count = 1 + math.ceil(float(np.hypot(*way)) / SPACING_M)
            points.append(np.linspace(start, end, count))
            normals.append(np.tile((way[1], -way[0]) / np.hypot(*way), (count, 1)))
        edge, outward = np.concatenate(points), np.concatenate(normals)
        return edge, np.where(self._holds(edge + 1e-6 * outward)[:, None], -outward, outward)

    def is_clear(self, points: Vector, motion: BaseMotion, margin: float) -> bool:
        """Return whether the body keeps a margin [m] until standstill, or comes no nearer to points that are close."""
        before = self.distances(points)
        near = before < margin + motion.duration_s * (abs(motion.linear) + self.radius * abs(motion.angular))
        points, before = points[near], before[near]
        for share in np.linspace(1.0 / INSTANTS, 1.0, INSTANTS).tolist():
            distances = self.distances(points, motion.pose_after(share))
            if ((distances < margin) & (distances < before - 1e-4)).any():
                return False
        return True

    def is_seen(self, scans: Sequence[Scan], motion: BaseMotion, margin: float) -> bool:
        """Return whether beams show the space that the body would enter until standstill, and a margin [m] around.

        What lies outside of all fields of view has to be seen only where the body moves ahead, or back.
        """
        (x, y, yaw), (edge, outward) = motion.pose_after(1.0), self.edge()
        places = _turned(edge, yaw) + (x, y)
        leads = outward[:, 0] * np.sign(motion.linear) > FACING
        swept = ((places - edge) * outward).sum(axis=1) > SWEPT_M
        places = places + margin * _turned(outward, yaw)
        is_known, is_in_view = np.zeros((2, len(places)), dtype=np.bool_)
        for scan in scans:
            is_known |= _are_met(places, scan, scan.directions[scan.is_known])
            is_in_view |= _are_met(places, scan, scan.directions)
        return not (~is_known & (leads | (swept & is_in_view))).any()

    def _holds(self, points: Vector) -> NDArray[np.bool_]:
        """Return which points are inside: a ray from there crosses the edge an odd number of times."""
        (x0, y0), (x1, y1) = self.corners.T, np.roll(self.corners, -1, axis=0).T
        x, y = points[:, :1], points[:, 1:]
        crosses = (y0 > y) != (y1 > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            is_right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
        return np.asarray((crosses & is_right).sum(axis=1) % 2 == 1)


def _turned(vectors: Vector, yaw: float) -> Vector:
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned: Vector = vectors @ np.array([[cos, sin], [-sin, cos]])
    return turned


def _are_met(places: Vector, scan: Scan, directions: Vector) -> NDArray[np.bool_]:
    """Return which places (n, 2) a beam passes."""
    ways = places - scan.origin
    across = np.abs(ways[:, :1] * directions[:, 1] - ways[:, 1:] * directions[:, 0])
    return np.asarray(((across < GAP_M) & (ways @ directions.T > 0.0)).any(axis=1))
