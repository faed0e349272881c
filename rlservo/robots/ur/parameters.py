"""Parameters of the arms, in one table; everything else about them is computed from it.

Sources, of robo-gym's seven: kinematics, link frames, masses and limits from ros-industrial/universal_robot
(ur_description); workspace radii, the start pose and its randomisation from jr-robotics/robo-gym 2.0. Of the others:
UniversalRobots/Universal_Robots_ROS2_Description (a UR7e has the UR5e's figures, a UR12e the UR10e's); their workspace
radii are nine tenths of the reach. Joints are in standard order everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

RATES_HZ = (0.1, 1000.0)  # [Hz], the slowest and the fastest control rate
# ROS names by our own, in kinematic order.
JOINT_NAMES = {
    "base": "shoulder_pan_joint", "shoulder": "shoulder_lift_joint", "elbow": "elbow_joint",
    "wrist_1": "wrist_1_joint", "wrist_2": "wrist_2_joint", "wrist_3": "wrist_3_joint",
}  # fmt: skip
JOINTS = tuple(JOINT_NAMES)

POSITION_LIMITS = (2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi)  # [rad], +-

# The table the arm stands on: robo-gym's tabletop worlds. Poses in the world frame, the arm's base on top.
TABLE_SIZE = (1.0, 1.0, 0.1)  # [m]
TABLE_CENTRE = (-0.05, 0.2, 0.05)  # [m]


@dataclass(frozen=True)
class URParameters:
    """One arm. Lengths in m, masses in kg, velocities in rad/s, efforts in Nm."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    shoulder_offset: float  # the upper arm's centre line, along the shoulder axis
    elbow_offset: float  # the forearm's centre line, along the elbow axis
    masses: tuple[float, ...]  # [kg] of base, shoulder, upper_arm, forearm, wrist_1, wrist_2, wrist_3
    velocity_limits: tuple[float, ...]  # JOINTS
    effort_limits: tuple[float, ...]  # JOINTS
    workspace_radius: float
    workspace_min_radius: float

    @property
    def size(self) -> float:
        """The joint housings' size relative to the UR5, judged by the distance between the wrist axes."""
        return self.d5 / 0.09465


_PI = math.pi
_UR3 = {
    "masses": (2.0, 2.0, 3.42, 1.26, 0.8, 0.8, 0.35),
    "velocity_limits": (_PI, _PI, _PI, 2 * _PI, 2 * _PI, 2 * _PI),
    "effort_limits": (56.0, 56.0, 28.0, 12.0, 12.0, 12.0),
    "workspace_radius": 0.45,
    "workspace_min_radius": 0.2,
}
_UR5 = {
    "masses": (4.0, 3.7, 8.393, 2.275, 1.219, 1.219, 0.1879),
    "velocity_limits": (_PI,) * 6,
    "effort_limits": (150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    "workspace_radius": 0.75,
    "workspace_min_radius": 0.2,
}
_UR10 = {
    "masses": (4.0, 7.778, 12.93, 3.87, 1.96, 1.96, 0.202),
    "velocity_limits": (2.0944, 2.0944, _PI, _PI, _PI, _PI),
    "effort_limits": (330.0, 330.0, 150.0, 56.0, 56.0, 56.0),
    "workspace_radius": 1.3,
    "workspace_min_radius": 0.3,
}
_UR16 = _UR10 | {
    "masses": (4.0, 7.369, 10.45, 4.321, 2.18, 2.033, 0.907),
    "workspace_radius": 0.8,
}


_UR15 = {
    "masses": (4.0, 9.9883, 14.9255, 6.1015, 2.089, 2.0869, 1.0666),
    "velocity_limits": (_PI, _PI, 4 * _PI / 3, 5 * _PI / 3, 5 * _PI / 3, 5 * _PI / 3),
    "effort_limits": (433.0, 433.0, 204.0, 70.0, 70.0, 70.0),
    "workspace_radius": 1.17,
    "workspace_min_radius": 0.3,
}
_UR18 = _UR15 | {
    "masses": (4.0, 9.9883, 14.2009, 5.52, 2.089, 2.0869, 1.0666),
    "workspace_radius": 0.85,
}
# A UR8 Long has the UR15's joints and longer tubes. Its masses follow from the UR15's and UR18's by length, and its
# speeds are the UR20's, which has that reach and is slow: neither was found.
_UR8_LONG = _UR15 | {
    "masses": (4.0, 9.9883, 15.98, 6.75, 2.089, 2.0869, 1.0666),
    "velocity_limits": (2 * _PI / 3, 2 * _PI / 3, 5 * _PI / 6, 7 * _PI / 6, 7 * _PI / 6, 7 * _PI / 6),
    "workspace_radius": 1.57,
}
_UR20 = {
    "masses": (4.0, 16.343, 29.632, 7.879, 3.054, 3.126, 0.926),
    "velocity_limits": (2 * _PI / 3, 2 * _PI / 3, 5 * _PI / 6, 7 * _PI / 6, 7 * _PI / 6, 7 * _PI / 6),
    "effort_limits": (738.0, 738.0, 433.0, 107.0, 107.0, 107.0),
    "workspace_radius": 1.57,
    "workspace_min_radius": 0.4,
}
_UR30 = _UR20 | {
    "masses": (4.0, 16.343, 28.542, 7.156, 3.054, 3.126, 0.926),
    "workspace_radius": 1.17,
}


def _arm(kinematics: tuple[float, ...], shared: dict[str, object]) -> URParameters:
    return URParameters(*kinematics, **shared)  # type: ignore[arg-type]  # the dicts above spell the field names


UR_PARAMETERS: dict[str, URParameters] = {
    #                d1        a2        a3        d4        d5       d6      shoulder  elbow
    "ur3": _arm((0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819, 0.1198, 0.0275), _UR3),
    "ur3e": _arm((0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921, 0.120, 0.027), _UR3),
    "ur5": _arm((0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823, 0.13585, 0.0165), _UR5),
    "ur5e": _arm((0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996, 0.138, 0.007), _UR5),
    "ur10": _arm((0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922, 0.220941, 0.049042), _UR10),
    "ur10e": _arm((0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655, 0.1762, 0.0393), _UR10),
    "ur16e": _arm((0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655, 0.176, 0.04), _UR16),
    # These three centre lines are judged by their links' centres of mass, beside those of UR10e and UR20.
    "ur8long": _arm((0.2186, -0.8989, -0.7149, 0.1824, 0.1361, 0.1434, 0.21, 0.041), _UR8_LONG),
    "ur15": _arm((0.2186, -0.6475, -0.5164, 0.1824, 0.1361, 0.1434, 0.21, 0.041), _UR15),
    "ur18": _arm((0.2186, -0.475, -0.3389, 0.1824, 0.1361, 0.1434, 0.21, 0.041), _UR18),
    "ur20": _arm((0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543, 0.26, 0.043), _UR20),
    "ur30": _arm((0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543, 0.26, 0.043), _UR30),
}
UR_PARAMETERS |= {"ur7e": UR_PARAMETERS["ur5e"], "ur12e": UR_PARAMETERS["ur10e"]}

CB3 = ("ur3", "ur5", "ur10")  # of a controller with 125 Hz and no remote control; the others' have 500 Hz


def cycle_of(rate_hz: float) -> float:
    """Return the duration of a control cycle [s], or raise ValueError for a rate outside RATES_HZ."""
    low, high = RATES_HZ
    if not low <= rate_hz <= high:
        raise ValueError(f"action_cycle_rate is {rate_hz:g} Hz: expected {low:g} to {high:g} Hz")
    return 1.0 / rate_hz


def ur_parameters(model: str) -> URParameters:
    """Return the parameters of one arm, or raise ValueError naming all."""
    if model not in UR_PARAMETERS:
        raise ValueError(f"ur_model {model!r} does not exist: expected one of {', '.join(UR_PARAMETERS)}")
    return UR_PARAMETERS[model]


def model_of(reported: str, version: str) -> str:
    """Return the model by a controller's own words: 'UR5' is a ur5 or, with PolyScope 5 ('5.12.2'), a ur5e.

    A UR7e calls itself UR5, and a UR12e UR10: their figures are the same.
    """
    family = reported.strip().lower().replace(" ", "").replace("_", "")
    return family if version.startswith("3.") or f"{family}e" not in UR_PARAMETERS else f"{family}e"


def rate_hz_of(model: str) -> float:
    """Return the rate of a model's controller [Hz]."""
    return 125.0 if model in CB3 else 500.0
