"""A UR arm's own kinematics from its robot description (URDF), into which ur_calibration's figures are put.

Source: Universal_Robots_ROS2_Description (urdf/ur_macro.xacro): `base` is the controller's base frame, `tool0` the
flange, and each joint turns about z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from rlservo.robots.arm_interface import Vector

BASE, FLANGE = "base", "tool0"


def frames_of_description(text: str, joints: Sequence[str], prefix: str = "") -> Vector:
    """Return the frames (7, 4, 4), as in `calibration.py`, of the arm whose `joints` a URDF has, in kinematic order.

    `prefix` is that of its links. Raises ValueError if it is not a UR arm's.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not XML: {error}") from None
    above = {_of(joint, "child", "link"): joint for joint in root.findall("joint")}  # not ros2_control's

    def way(link: str) -> list[ElementTree.Element]:
        """Return the joints from the root to a link."""
        found: list[ElementTree.Element] = []
        while link in above and len(found) < len(above):
            found.insert(0, above[link])
            link = _of(above[link], "parent", "link")
        return found

    if missing := [name for name in (BASE, FLANGE) if prefix + name not in above]:
        raise ValueError(f"it has no link {prefix}{missing[0]}")
    chain = way(prefix + FLANGE)
    moving = [number for number, joint in enumerate(chain) if joint.get("type") != "fixed"][-len(joints) :]
    if (found := [chain[number].get("name") for number in moving]) != list(joints):
        raise ValueError(f"the joints before {prefix}{FLANGE} are {', '.join(map(str, found))}")
    if any([*map(float, _of(chain[number], "axis", "xyz").split())] != [0.0, 0.0, 1.0] for number in moving):
        raise ValueError("a joint does not turn about z")
    base = np.linalg.inv(_pose(way(prefix + BASE)))
    return np.array([base @ _pose(chain[: end + 1]) for end in (*moving, len(chain) - 1)])


def _of(joint: ElementTree.Element, part: str, name: str, default: str = "") -> str:
    found = joint.find(part)
    return default if found is None else found.get(name, default)


def _pose(joints: Sequence[ElementTree.Element]) -> Vector:
    """Return the pose (4, 4) behind joints that are at 0."""
    pose: Vector = np.eye(4)
    for joint in joints:
        step = np.eye(4)
        for axis, angle in zip((2, 1, 0), reversed(_numbers(joint, "rpy")), strict=True):  # yaw, pitch, roll
            turn, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
            turn[i, i] = turn[j, j] = math.cos(angle)
            turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
            step[:3, :3] = step[:3, :3] @ turn
        step[:3, 3] = _numbers(joint, "xyz")
        pose = pose @ step
    return pose


def _numbers(joint: ElementTree.Element, name: str) -> list[float]:
    given = _of(joint, "origin", name, "0 0 0")
    numbers = [float(number) for number in given.split()]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"the origin of {joint.get('name')} has {name} {given!r}")
    return numbers
