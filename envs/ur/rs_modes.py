"""Modes of robo-gym's robot server for the arm: layout of the state.

Source: jr-robotics/robo-gym-robot-servers, ur_robot_server.
"""

from __future__ import annotations

from dataclasses import dataclass

from rlservo.robots.ur.parameters import JOINTS

# Elbow, shoulder, base, wrists; the same list turns ROS order back into the standard one.
ROS_ORDER = (2, 1, 0, 3, 4, 5)


@dataclass(frozen=True)
class RsMode:
    """Content of a mode's state besides joints, end effector and collision."""

    objects: int
    forearm: bool


RS_MODES: dict[str, RsMode] = {
    "only_robot": RsMode(objects=0, forearm=False),
    "1object": RsMode(objects=1, forearm=False),
    "1moving2points": RsMode(objects=1, forearm=True),
    "2objects2points": RsMode(objects=2, forearm=True),
}


def rs_mode_of(name: str) -> RsMode:
    """Return the mode of that name, or raise ValueError naming the modes."""
    if name not in RS_MODES:
        raise ValueError(f"rs_mode {name!r} does not exist: expected one of {', '.join(RS_MODES)}")
    return RS_MODES[name]


def state_names(rs_mode: str) -> list[str]:
    """Return the names of a mode's numbers, in the order of its list: joints in ROS order."""
    mode = rs_mode_of(rs_mode)
    joints = [JOINTS[index] for index in ROS_ORDER]
    return [
        *(name for index in range(mode.objects) for name in transform_names(f"object_{index}")),
        *(f"{joint}_joint_{quantity}" for quantity in ("position", "velocity") for joint in joints),
        *transform_names("ee"),
        "in_collision",
        *(transform_names("forearm") if mode.forearm else ()),
    ]


def transform_names(frame: str) -> list[str]:
    """Return the names of a frame's position and quaternion in the reference frame."""
    elements = [*(f"translation_{axis}" for axis in "xyz"), *(f"rotation_{axis}" for axis in "xyzw")]
    return [f"{frame}_to_ref_{element}" for element in elements]
