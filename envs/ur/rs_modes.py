"""The modes of robo-gym's robot server for the arm: what a state holds, and where.

Source: jr-robotics/robo-gym-robot-servers, ur_robot_server.
"""

from __future__ import annotations

from dataclasses import dataclass

ROS_ORDER = (
    2,
    1,
    0,
    3,
    4,
    5,
)  # elbow, shoulder, base, wrists; the same list turns ROS order back into the standard one


@dataclass(frozen=True)
class RsMode:
    """What a mode tells besides joints, end effector and collision."""

    objects: int
    forearm: bool


RS_MODES: dict[str, RsMode] = {
    "only_robot": RsMode(objects=0, forearm=False),
    "1object": RsMode(objects=1, forearm=False),
    "1moving2points": RsMode(objects=1, forearm=True),
    "2objects2points": RsMode(objects=2, forearm=True),
}


def rs_mode_of(name: str) -> RsMode:
    """Return the mode of that name, or raise ValueError naming those there are."""
    if name not in RS_MODES:
        raise ValueError(f"rs_mode {name!r} does not exist: expected one of {', '.join(RS_MODES)}")
    return RS_MODES[name]


def state_length(rs_mode: str) -> int:
    """Return how long the list of a mode is."""
    mode = rs_mode_of(rs_mode)
    return 7 * mode.objects + 20 + 7 * mode.forearm


def positions_in_list(rs_mode: str) -> slice:
    """Return where a mode's list holds the joint positions."""
    start = 7 * rs_mode_of(rs_mode).objects
    return slice(start, start + 6)
