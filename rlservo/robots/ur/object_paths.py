"""Paths of moving objects: robo-gym's object functions as positions of one round trip, 100 a second.

Functions, parameter names and figures: jr-robotics/robo-gym-robot-servers, simulation_objects/scripts/
objects_controller.py. Positions are in whatever frame the parameters are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

UPDATE_RATE_HZ = 100
MAX_POINTS = 1_000_000  # of one path: nearly three hours
REDRAWS = 10_000  # of a spline that crosses the arm's base; roughly one in five does not

# Distances that the splines of `3d_spline_ur5_workspace` keep [m].
BASE_CYLINDER, BASE_SPHERE = 0.2, 0.35
FIRST_POINT = (0.5, 1.0)  # the range of |x| and |y| of their first point

Path = NDArray[np.float64]  # (n, 3) [m]; after the last position comes the first


class PathParameters:
    """The parameters of one object, by their short names; a missing or impossible one is named in full."""

    def __init__(self, index: int, values: Mapping[str, float]) -> None:
        self._index, self._values = index, values

    def number(self, name: str, shared_name: str | None = None) -> float:
        """Return `object_<i>_<name>` (or the parameter `shared`, which older servers had for all objects)."""
        full = f"object_{self._index}_{name}"
        value = self._values.get(full)
        if value is None and shared_name is not None:
            value = self._values.get(shared_name)
        if value is None:
            raise ValueError(f"float_params lacks {full!r}, which the object's function needs")
        if not math.isfinite(value):
            raise ValueError(f"float_params[{full!r}] is {value:g}: expected a finite number")
        return float(value)

    def point(self, suffix: str = "") -> NDArray[np.float64]:
        """Return x, y, z [m] of the parameters with that suffix."""
        return np.array([self.number(f"{axis}{suffix}") for axis in "xyz"])

    def count(self, name: str, low: int, shared_name: str | None = None) -> int:
        """Return a whole number of at least `low` (rounded down, as the original does)."""
        value = self.number(name, shared_name)
        if not low <= value <= MAX_POINTS:
            raise ValueError(
                f"float_params['object_{self._index}_{name}'] is {value:g}: expected {low} to {MAX_POINTS:,}"
            )
        return int(value)

    def samples(self, name: str) -> int:
        """Return the number of positions in a time [s], zero included."""
        seconds = self.number(name)
        if not 0.0 <= seconds * UPDATE_RATE_HZ <= MAX_POINTS:
            raise ValueError(
                f"float_params['object_{self._index}_{name}'] is {seconds:g} s: "
                f"expected 0 to {MAX_POINTS // UPDATE_RATE_HZ:,} s"
            )
        return int(UPDATE_RATE_HZ * seconds)


def object_path(function: str, index: int, values: Mapping[str, float], rng: np.random.Generator) -> Path:
    """Return the path of object `index`, whose parameters are `object_<index>_<name>` in `values`.

    Raises ValueError for a function that does not exist and for a missing or impossible parameter, naming it.
    """
    if function not in FUNCTIONS:
        raise ValueError(
            f"string_params['object_{index}_function'] is {function!r}: expected one of {', '.join(FUNCTIONS)}"
        )
    return FUNCTIONS[function](PathParameters(index, values), rng)


def fixed_position(parameters: PathParameters, _rng: np.random.Generator) -> Path:
    """Stay at x, y, z."""
    return parameters.point()[None, :]


def triangle_wave(parameters: PathParameters, _rng: np.random.Generator) -> Path:
    """Go up and down at x, y: from z_offset - z_amplitude to z_offset + z_amplitude and back, z_frequency [Hz]."""
    frequency = parameters.number("z_frequency")
    if not UPDATE_RATE_HZ / MAX_POINTS <= frequency <= UPDATE_RATE_HZ:
        raise ValueError(
            f"the triangle wave's z_frequency is {frequency:g} Hz: "
            f"expected {UPDATE_RATE_HZ / MAX_POINTS:g} to {UPDATE_RATE_HZ} Hz"
        )
    count = int(UPDATE_RATE_HZ / frequency)
    phase = np.linspace(0.0, 1.0, count)  # both ends included, so the lowest position comes twice
    path = np.empty((count, 3))
    path[:, 0], path[:, 1] = parameters.number("x"), parameters.number("y")
    path[:, 2] = parameters.number("z_offset") + parameters.number("z_amplitude") * (1.0 - np.abs(2.0 - 4.0 * phase))
    return path


def spline_3d(parameters: PathParameters, rng: np.random.Generator) -> Path:
    """Follow a closed curve through n_points random points of a box, in n_sampling_points steps."""
    return interpolate(_random_points(parameters, rng), _sampling_points(parameters))


def spline_3d_ur5_workspace(parameters: PathParameters, rng: np.random.Generator) -> Path:
    """Follow such a curve that keeps away from the arm's base."""
    count = _sampling_points(parameters)
    for _ in range(REDRAWS):
        points = _random_points(parameters, rng)
        points[0, :2] = rng.choice((-1.0, 1.0), 2) * rng.uniform(*FIRST_POINT, 2)
        points[-1] = points[0]
        path = interpolate(points, count)
        horizontal = np.hypot(path[:, 0], path[:, 1])
        if horizontal.min() > BASE_CYLINDER and np.hypot(horizontal, path[:, 2]).min() > BASE_SPHERE:
            return path
    raise ValueError(
        f"none of {REDRAWS:,} random splines keeps {BASE_CYLINDER} m from the z axis and {BASE_SPHERE} m from the "
        f"origin: expected a larger box in x_min .. z_max"
    )


def fixed_position_a_b(parameters: PathParameters, _rng: np.random.Generator) -> Path:
    """Stay at a for hold_a [s], then at b for hold_b [s]."""
    return _not_empty(_hold(parameters, "a"), _hold(parameters, "b"))


def interpolated_a_b_c(parameters: PathParameters, _rng: np.random.Generator) -> Path:
    """Stay at a, move straight to b, stay, move to c, stay; then start again at a."""
    a, b, c = parameters.point("_a"), parameters.point("_b"), parameters.point("_c")
    to_b = np.linspace(a, b, parameters.count("n_sampling_points_ab", 0))
    to_c = np.linspace(b, c, parameters.count("n_sampling_points_bc", 0))
    return _not_empty(_hold(parameters, "a"), to_b, _hold(parameters, "b"), to_c, _hold(parameters, "c"))


FUNCTIONS: dict[str, Callable[[PathParameters, np.random.Generator], Path]] = {
    "fixed_position": fixed_position,
    "triangle_wave": triangle_wave,
    "3d_spline": spline_3d,
    "3d_spline_ur5_workspace": spline_3d_ur5_workspace,
    "fixed_position_a_b": fixed_position_a_b,
    "interpolated_a_b_c": interpolated_a_b_c,
    # The same two as robo-gym's ROS 2 servers spell them.
    "fixed_position_ab": fixed_position_a_b,
    "interpolated_abc": interpolated_a_b_c,
}


def interpolate(points: NDArray[np.float64], count: int) -> Path:
    """Return `count` positions, both ends included, evenly in the parameter of the curve through `points` (n, 3).

    The curve is the cubic spline of scipy's `splprep(points, s=0)`: parameterised by the chords' lengths, with the
    not-a-knot condition at both ends. Raises ValueError for fewer than four points, or if two neighbours coincide.
    """
    if len(points) < 4:
        raise ValueError(f"the spline has {len(points)} points: expected at least 4")
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not (chords > 0.0).all():
        raise ValueError("two neighbouring points of a spline coincide: expected a box with some extent")
    knots = np.concatenate([[0.0], np.cumsum(chords)]) / chords.sum()
    second = _second_derivatives(knots, points)

    at = np.linspace(0.0, 1.0, count)
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    width = (knots[left + 1] - knots[left])[:, None]
    before, after = (at - knots[left])[:, None], (knots[left + 1] - at)[:, None]
    curved = (second[left] * after**3 + second[left + 1] * before**3) / (6.0 * width)
    from_left = (points[left] / width - second[left] * width / 6.0) * after
    from_right = (points[left + 1] / width - second[left + 1] * width / 6.0) * before
    path: Path = curved + from_left + from_right
    return path


def _second_derivatives(knots: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    n, h = len(knots), np.diff(knots)
    matrix, right = np.zeros((n, n)), np.zeros((n, 3))
    slopes = np.diff(points, axis=0) / h[:, None]
    for i in range(1, n - 1):  # the first derivative is continuous at the inner knots
        matrix[i, i - 1 : i + 2] = h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]
        right[i] = 6.0 * (slopes[i] - slopes[i - 1])
    # Not-a-knot: the third derivative is continuous at the second knot and at the last but one.
    matrix[0, :3] = h[1], -(h[0] + h[1]), h[0]
    matrix[-1, -3:] = h[-1], -(h[-2] + h[-1]), h[-2]
    second: NDArray[np.float64] = np.linalg.solve(matrix, right).astype(np.float64, copy=False)
    return second


def _random_points(parameters: PathParameters, rng: np.random.Generator) -> NDArray[np.float64]:
    low, high = parameters.point("_min"), parameters.point("_max")
    if (low > high).any():
        raise ValueError(f"the spline's box is from {low.tolist()} to {high.tolist()} m: expected min below max")
    points = rng.uniform(low, high, (parameters.count("n_points", 4), 3))
    points[-1] = points[0]  # closed
    return points


def _sampling_points(parameters: PathParameters) -> int:
    return parameters.count("n_sampling_points", 2, shared_name="n_sampling_points")


def _hold(parameters: PathParameters, where: str) -> Path:
    return np.repeat(parameters.point(f"_{where}")[None, :], parameters.samples(f"hold_{where}"), axis=0)


def _not_empty(*parts: Path) -> Path:
    path = np.concatenate(parts)
    if not len(path):
        raise ValueError("the object's function has no duration: expected a hold of at least 0.01 s somewhere")
    return path
