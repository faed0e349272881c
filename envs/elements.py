"""Descriptions of observation and action elements, for `describe()`: joints, points, directions and quaternions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlservo.robots.argument_checks import ElementInfo


def joint_elements(
    joints: Mapping[str, str],
    suffix: str,
    unit: str,
    quantity: str,
    scale: Sequence[float] | NDArray[np.float64] | None = None,
    offset: Sequence[float] | NDArray[np.float64] | None = None,
) -> list[ElementInfo]:
    """Return an element `<name>_<suffix>` for each joint; `joints` has their names in the URDF by our own."""
    elements: list[ElementInfo] = []
    for index, (name, joint) in enumerate(joints.items()):
        element: ElementInfo = {"name": f"{name}_{suffix}", "unit": unit, "quantity": quantity, "joint": joint}
        if scale is not None:
            element["scale"] = float(scale[index])
        if offset is not None:
            element["offset"] = float(offset[index])
        elements.append(element)
    return elements


def point_elements(name: str, frame: str) -> list[ElementInfo]:
    """Return a position's x, y, z [m]."""
    return [
        {"name": f"{name}_{axis}", "unit": "m", "quantity": "position", "axis": axis, "frame": frame} for axis in "xyz"
    ]


def quaternion_elements(name: str, frame: str, order: str) -> list[ElementInfo]:
    """Return a quaternion's parts, in the order `wxyz` or `xyzw`."""
    return [
        {"name": f"{name}_q{axis}", "unit": "1", "quantity": "quaternion", "axis": axis, "frame": frame}
        for axis in order
    ]


def polar_elements(name: str, frame: str) -> list[ElementInfo]:
    """Return r, theta = acos(z/r) and phi = atan2(y, x) of a point."""
    return [
        {"name": f"{name}_r", "unit": "m", "quantity": "distance", "frame": frame},
        {"name": f"{name}_theta", "unit": "rad", "quantity": "direction", "frame": frame},
        {"name": f"{name}_phi", "unit": "rad", "quantity": "direction", "frame": frame},
    ]
