"""MuJoCo model of the Franka Emika Panda with its hand, from published figures.

Sources: kinematics from franka_description (frankaemika/franka_ros), limits from jr-robotics/robo-gym 2.1
(panda_parameters/panda.yaml), masses from Gaz et al., Dynamic identification of the Franka Emika Panda robot with
retrieval of feasible parameters, 2019. Links are capsules along the real housings; the fingers are open and still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rlservo.robots.ur.model import ARMATURE, LOOKS, TIMESTEP, Table, scene, servos
from rlservo.robots.ur.objects import object_model

JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
LINKS = tuple(f"link{number}" for number in range(1, 8))  # what moves; the hand is fixed to the last
LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # [rad]
HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)  # [rad]
MASSES = (4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522)  # [kg], LINKS
BASE_MASS, HAND_MASS = 2.814271, 0.73  # [kg]

# Each link's frame in the one before it, x y z [m] and the turn about x, and its capsules: two ends and a radius [m].
Capsule = tuple[tuple[float, float, float], tuple[float, float, float], float]
Q = math.pi / 2
FRAMES: tuple[tuple[tuple[float, float, float], float, tuple[Capsule, ...]], ...] = (
    ((0, 0, 0.333), 0.0, (((0, 0, -0.15), (0, 0, 0), 0.06),)),
    ((0, 0, 0), -Q, (((0, 0, 0), (0, -0.19, 0), 0.06),)),
    ((0, -0.316, 0), Q, (((0, 0, -0.12), (0, 0, 0), 0.055), ((0, 0, 0), (0.0825, 0, 0), 0.055))),
    ((0.0825, 0, 0), Q, (((0, 0, 0), (-0.0825, 0.10, 0), 0.055),)),
    ((-0.0825, 0.384, 0), -Q, (((0, 0, -0.26), (0, 0, 0), 0.05),)),
    ((0, 0, 0), Q, (((0, 0, 0), (0.088, 0, 0), 0.05),)),
    ((0.088, 0, 0), Q, (((0, 0, 0), (0, 0, 0.06), 0.045),)),
)
HAND_HEIGHT, HAND_TURN = 0.107, -math.pi / 4  # [m], [rad], of panda_hand in link7
HAND: tuple[Capsule, ...] = (
    ((0, -0.08, 0.035), (0, 0.08, 0.035), 0.03),
    ((0, -0.04, 0.06), (0, -0.04, 0.10), 0.012),
    ((0, 0.04, 0.06), (0, 0.04, 0.10), 0.012),
)


@dataclass(frozen=True)
class PandaParameters:
    """Limits by joint."""

    velocity_limits: tuple[float, ...] = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)  # [rad/s]
    effort_limits: tuple[float, ...] = (87.0, 87.0, 87.0, 87.0, 15.0, 12.0, 12.0)  # [Nm]


def model_xml(parameters: PandaParameters, *, objects: Sequence[str] = (), table: Table = True) -> str:
    """Return the model: the arm's base at the world's origin, in the middle of robo-gym's table.

    Joints and actuators are named as in JOINTS, each with two actuators that together are one servo, as a UR's are;
    `panda_hand` is a site. Object i is the mocap body `object_<i>`.
    """
    bodies = "".join(_link(index, parameters.effort_limits[index]) for index in range(7))
    hand = f"""
      <body name="hand" pos="0 0 {HAND_HEIGHT}" euler="0 0 {HAND_TURN}" gravcomp="1">
        {_capsules(HAND, HAND_MASS, "0.9 0.9 0.92 1")}
        <site name="panda_hand" size="0.01" rgba="0.1 0.6 0.2 1"/>
        <!-- Without gravcomp: the arm does not know what it carries. -->
        <body name="payload" pos="0 0 {HAND_HEIGHT}"><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/></body>
      </body>"""
    return f"""
<mujoco model="panda">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast"/>
  {LOOKS}
  <worldbody>
    {scene(0.0, table, [object_model(name) for name in objects])}
    <body name="link0">
      {_capsules((((-0.06, 0, 0.06), (0, 0, 0.06), 0.06),), BASE_MASS, "0.29 0.30 0.33 1")}
      {bodies}{hand}{"</body>" * 7}
    </body>
  </worldbody>
  <contact>
    <!-- MuJoCo leaves out parent and child, but not where the parent is fixed to the world. -->
    <exclude body1="link0" body2="link1"/>
    <exclude body1="link0" body2="world"/>
    <exclude body1="link5" body2="link7"/>
  </contact>
  <actuator>
    {servos(JOINTS, list(zip(LOW, HIGH, strict=True)), parameters.effort_limits)}
  </actuator>
</mujoco>
"""


def _link(index: int, effort: float) -> str:
    position, turn, capsules = FRAMES[index]
    x, y, z = position
    return f"""
      <body name="{LINKS[index]}" pos="{x} {y} {z}" euler="{turn} 0 0" gravcomp="1">
        <joint name="{JOINTS[index]}" axis="0 0 1" range="{LOW[index]} {HIGH[index]}" armature="{ARMATURE}"
               actuatorfrcrange="{-effort} {effort}" actuatorgravcomp="true"/>
        {_capsules(capsules, MASSES[index], "0.9 0.9 0.92 1")}"""


def _capsules(capsules: Sequence[Capsule], mass: float, rgba: str) -> str:
    lines = []
    for start, end, radius in capsules:
        points = " ".join(f"{value:.4f}" for value in (*start, *end))
        kind = f'fromto="{points}" size="{radius}"'
        lines.append(f'<geom class="link" {kind} mass="{mass / len(capsules):.6f}" rgba="{rgba}"/>')
    return "\n        ".join(lines)
