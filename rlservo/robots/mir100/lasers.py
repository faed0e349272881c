"""The two laser scanners, by casting rays at the walls and cubes of the model.

A reading is as robo-gym's robot server passes it on: Gaussian noise added by the sensor, clipped to the scanner's
range.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlservo.robots.mir100.model import BEAM_GROUP
from rlservo.robots.mir100.parameters import BACK_SCANNER, BEAM_COUNT, FRONT_SCANNER, LASER_MAX, LASER_MIN, Scanner

Vector = NDArray[np.float64]


class LaserScanners:
    """Both scanners. All arrays are made once; a measurement fills them."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, noise: float) -> None:
        self.readings: Vector = np.full(BEAM_COUNT, LASER_MAX)  # [m]
        self.nearest = LASER_MAX  # [m], the shortest true distance
        self._model, self._data, self._noise = model, data, noise
        self._robot = model.body("base_link").id
        groups = np.zeros(6, dtype=np.uint8)
        groups[BEAM_GROUP] = 1
        self._groups = groups

        angles = np.concatenate([FRONT_SCANNER.angles, BACK_SCANNER.angles])
        self._in_robot: Vector = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAM_COUNT)], axis=1)
        self._in_map: Vector = np.zeros((BEAM_COUNT, 3))
        self._robot_to_map: Vector = np.eye(3)  # transposed, so that rows of vectors are turned by `rows @ matrix`
        self._distances: Vector = np.zeros(BEAM_COUNT)
        self._geoms = np.zeros(BEAM_COUNT, dtype=np.int32)
        self._misses = np.zeros(BEAM_COUNT, dtype=np.bool_)
        self._scanners = [
            _Beams(scanner, slice(start, start + scanner.count), self._in_map, self._distances, self._geoms)
            for scanner, start in ((FRONT_SCANNER, 0), (BACK_SCANNER, FRONT_SCANNER.count))
        ]

    def measure(self, rng: np.random.Generator) -> None:
        """Cast all beams from the robot's present pose."""
        x, y, yaw = self._data.qpos.tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = self._robot_to_map
        turn[0, 0] = turn[1, 1] = cos
        turn[0, 1], turn[1, 0] = sin, -sin
        np.matmul(self._in_robot, turn, out=self._in_map)
        for beams in self._scanners:
            beams.origin[0] = x + cos * beams.ahead - sin * beams.left
            beams.origin[1] = y + sin * beams.ahead + cos * beams.left
            mujoco.mj_multiRay(
                self._model, self._data, beams.origin, beams.directions, self._groups, 1, self._robot, beams.geoms,
                beams.distances, None, beams.count, LASER_MAX,
            )  # fmt: skip

        distances, readings = self._distances, self.readings
        np.less(distances, 0.0, out=self._misses)  # MuJoCo's -1
        distances[self._misses] = LASER_MAX
        self.nearest = float(distances.min())
        if self._noise > 0.0:
            rng.standard_normal(out=readings)
            readings *= self._noise
            readings += distances
            readings[self._misses] = LASER_MAX
        else:
            readings[:] = distances
        np.clip(readings, LASER_MIN, LASER_MAX, out=readings)

    def ends(self, readings: Vector) -> Vector:
        """Return both ends of the beams in the map frame [m] (n, 2, 3): of all, or of as many picked evenly."""
        picked = pick_beams(len(readings))
        x, y, yaw = self._data.qpos.tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        robot_to_map = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])  # transposed, as above
        origins = np.repeat(
            [FRONT_SCANNER.position, BACK_SCANNER.position], [FRONT_SCANNER.count, BACK_SCANNER.count], axis=0
        )[picked]
        ends = np.stack([origins, origins + readings[:, None] * self._in_robot[picked]], axis=1)
        in_map: Vector = ends @ robot_to_map + (x, y, 0.0)
        return in_map


def pick_beams(count: int) -> NDArray[np.intp]:
    """Return the indices of `count` beams picked evenly from all, as robo-gym picks those it observes."""
    return np.rint(np.linspace(0, BEAM_COUNT - 1, count)).astype(np.intp)


class _Beams:
    """One scanner's share of the arrays, in MuJoCo's form."""

    def __init__(
        self, scanner: Scanner, share: slice, directions: Vector, distances: Vector, geoms: NDArray[np.int32]
    ) -> None:
        self.count = scanner.count
        self.ahead, self.left, height = scanner.position  # [m], in base_link
        self.origin: Vector = np.array([0.0, 0.0, height])  # [m], in the map frame
        self.directions = directions[share].reshape(-1)  # views: writing the whole writes the parts
        self.distances = distances[share]
        self.geoms = geoms[share]
