"""MuJoCo model of one arm on its table from the parameter table.

Link frames are those of the ROS description (ur_description), so that `tool0` is where robo-gym's robot server reports
the end effector. Each link is one or two capsules along the real housing's centre line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from rlservo.robots.ur.objects import ObjectModel, object_model
from rlservo.robots.ur.parameters import JOINTS, POSITION_LIMITS, TABLE_CENTRE, TABLE_SIZE, URParameters

TIMESTEP = 0.005  # [s], at most; a control cycle is a whole number of steps
BASE_HEIGHT = TABLE_CENTRE[2] + TABLE_SIZE[2] / 2  # [m], base_link above the world's ground

Table = bool | Literal["isaac"]

PARKED_HEIGHT = 3.0  # [m], of an object that has no place yet, above base_link

# The joint servo. Stiffness follows the effort limit (a quarter of the limit at 1 degree off), damping makes the
# stiffest link-side inertia of the joint well damped. Armature is the harmonic drive's reflected rotor inertia, of the
# order MuJoCo Menagerie uses for the UR5e.
STIFFNESS_PER_EFFORT = 14.0  # [1/rad]
DAMPING_PER_STIFFNESS = 0.1  # [s]
ARMATURE = 0.1  # [kg m^2]

# Housing radii, measured on the UR5 [m]; the other arms' scale with their joint size.
SHOULDER_RADIUS, UPPER_ARM_RADIUS, ELBOW_RADIUS, FOREARM_RADIUS, WRIST_RADIUS = 0.060, 0.054, 0.060, 0.040, 0.045


# Isaac Lab's table, at its far side of which the arm stands: size and centre [m] in base_link, whose origin is on top.
# Source: jr-robotics/robo-gym-robot-servers, simulation_objects/models/isaac_demotable_cuboid.
ISAAC_TABLE_SIZE, ISAAC_TABLE_CENTRE = (1.27, 0.9, 1.0), (0.4, 0.0, -0.5)

# How everything looks, and what touches what: of every arm's model.
LOOKS = """<visual>
    <global offwidth="1280" offheight="960"/>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.45 0.45 0.45" specular="0.1 0.1 0.1"/>
    <quality shadowsize="2048"/>
  </visual>
  <default>
    <default class="link"><geom type="capsule" contype="1" conaffinity="3" friction="0.6"/></default>
    <default class="scene"><geom contype="2" conaffinity="1" friction="0.8"/></default>
    <default class="seen"><geom contype="0" conaffinity="0" mass="0"/></default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.93 0.95 0.97" rgb2="0.70 0.76 0.83" width="64"
             height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="0.82 0.84 0.86" rgb2="0.76 0.78 0.81" width="256"
             height="256"/>
    <material name="floor" texture="tiles" texrepeat="8 8" texuniform="true" reflectance="0.05"/>
  </asset>"""

# Touching an object is noticed and hardly felt: a contact this soft yields a ten-thousandth of the usual force.
OBJECT_SOFTNESS = 'priority="1" condim="1" solimp="0.0001 0.0001 0.001 0.5 1"'


def model_xml(arm: URParameters, *, objects: Sequence[str] = ("sphere50_no_collision",), table: Table = True) -> str:
    """Return the model: the arm standing on the table (or 0.1 m above bare ground) and the objects named.

    With "isaac" the table is Isaac Lab's and the ground 1 m below the base; without a table a post that nothing
    collides with is drawn. Object i is the mocap body `object_<i>`.

    Joints are named as in `JOINTS`; `tool0` is a site at wrist_3's origin. Each joint has two actuators that together
    are one servo: `<joint>` integrates its control, a velocity [rad/s], into a position setpoint, `<joint>_velocity`
    feeds the same velocity forward. Their sum, gravity compensation included, is limited to the joint's effort.
    """
    s = arm.size
    housing, cap = "0.78 0.79 0.81 1", "0.29 0.52 0.75 1"

    def joint(index: int) -> str:
        limit, effort = POSITION_LIMITS[index], arm.effort_limits[index]
        return (
            f'<joint name="{JOINTS[index]}" axis="0 0 1" range="{-limit} {limit}" armature="{ARMATURE}" '
            f'actuatorfrcrange="{-effort} {effort}" actuatorgravcomp="true"/>'
        )

    def capsule(start: tuple[float, ...], end: tuple[float, ...], radius: float, mass: float, rgba: str) -> str:
        points = " ".join(f"{x:.6f}" for x in (*start, *end))
        return f'<geom class="link" fromto="{points}" size="{radius * s:.6f}" mass="{mass}" rgba="{rgba}"/>'

    m = arm.masses
    upper_arm_end = (arm.a2, 0.0, arm.shoulder_offset)
    flange = 0.045 * s  # the last capsule's round end stops at the flange
    return f"""
<mujoco model="ur">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast"/>
  {LOOKS}
  <worldbody>
    {scene(BASE_HEIGHT, table, [object_model(name) for name in objects])}
    <body name="base_link" pos="0 0 {BASE_HEIGHT}">
      <body name="base" euler="0 0 {math.pi}">
        {capsule((0, 0, SHOULDER_RADIUS * s), (0, 0, arm.d1), SHOULDER_RADIUS, m[0], cap)}
        <geom class="seen" type="cylinder" fromto="0 0 0 0 0 0.02" size="{0.075 * s}" rgba="0.3 0.31 0.33 1"/>
        <body name="shoulder" pos="0 0 {arm.d1}" gravcomp="1">
          {joint(0)}
          {capsule((0, 0, 0), (0, -arm.shoulder_offset, 0), SHOULDER_RADIUS, m[1], cap)}
          <body name="upper_arm" euler="{math.pi / 2} 0 0" gravcomp="1">
            {joint(1)}
            {capsule((0, 0, arm.shoulder_offset), upper_arm_end, UPPER_ARM_RADIUS, m[2] * 0.8, housing)}
            {capsule((arm.a2, 0, arm.elbow_offset), upper_arm_end, ELBOW_RADIUS, m[2] * 0.2, cap)}
            <body name="forearm" pos="{arm.a2} 0 0" gravcomp="1">
              {joint(2)}
              {capsule((0, 0, arm.elbow_offset), (arm.a3, 0, arm.elbow_offset), FOREARM_RADIUS, m[3], housing)}
              <body name="wrist_1" pos="{arm.a3} 0 {arm.d4}" gravcomp="1">
                {joint(3)}
                {capsule((0, 0, arm.elbow_offset - arm.d4), (0, 0, 0), WRIST_RADIUS, m[4], cap)}
                <body name="wrist_2" pos="0 {-arm.d5} 0" euler="{math.pi / 2} 0 0" gravcomp="1">
                  {joint(4)}
                  {capsule((0, 0, -arm.d5 / 2), (0, 0, 0), WRIST_RADIUS, m[5], cap)}
                  <body name="wrist_3" pos="0 {arm.d6} 0" euler="{-math.pi / 2} 0 0" gravcomp="1">
                    {joint(5)}
                    {capsule((0, 0, -arm.d6), (0, 0, -flange), WRIST_RADIUS, m[6], cap)}
                    <site name="tool0" size="0.01" rgba="0.1 0.6 0.2 1"/>
                    <site name="tool1" size="0.001" euler="0 {math.pi / 2} {math.pi}"/>
                    <!-- Without gravcomp: the arm does not know what it carries. -->
                    <body name="payload"><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/></body>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>
    <!-- MuJoCo leaves out parent and child, except if the parent is fixed to the world. -->
    <exclude body1="base" body2="shoulder"/>
    <exclude body1="base" body2="world"/>
  </contact>
  <actuator>
    {servos(JOINTS, [(-limit, limit) for limit in POSITION_LIMITS], arm.effort_limits)}
  </actuator>
</mujoco>
"""


def scene(base_height: float, table: Table, objects: Sequence[ObjectModel]) -> str:
    """Return light, ground, table and objects of a world in which an arm's base stands at `base_height` [m]."""
    size, (x, y, z) = TABLE_SIZE, TABLE_CENTRE
    if table == "isaac":
        size, (x, y, z) = ISAAC_TABLE_SIZE, ISAAC_TABLE_CENTRE
        z += base_height
    ground = z - size[2] / 2  # a table stands on it
    half = " ".join(str(edge / 2) for edge in size)
    if table:
        stand = f'<geom class="scene" name="table" type="box" size="{half}" pos="{x} {y} {z}" rgba="0.55 0.43 0.32 1"/>'
    else:  # a post that nothing collides with
        stand = f"""<geom class="seen" type="cylinder" fromto="0 0 -0.01 0 0 {base_height}" size="0.08"
      rgba="0.4 0.41 0.43 1"/>"""
    return f"""<light pos="1.2 -0.8 2.6" dir="-0.4 0.3 -1" diffuse="0.5 0.5 0.5" specular="0.1 0.1 0.1"/>
    <geom class="scene" name="ground" type="plane" size="3 3 0.1" pos="0 0 {ground:g}" material="floor"/>
    {stand}
    {_objects(base_height, objects)}"""


def _objects(base_height: float, objects: Sequence[ObjectModel]) -> str:
    lines = []
    for index, model in enumerate(objects):
        size = " ".join([str(model.half_size)] * (1 if model.shape == "sphere" else 3))
        # Seen by the links' contype, and by nothing else; the arm's base does not move and so never counts.
        touch = f'contype="0" conaffinity="1" {OBJECT_SOFTNESS}' if model.collides else 'class="seen"'
        # Out of the way until it is placed, as in the original.
        lines.append(f'<body name="object_{index}" mocap="true" pos="{index} 0 {PARKED_HEIGHT + base_height}">')
        lines.append(f'<geom name="object_{index}" {touch} type="{model.shape}" size="{size}" rgba="{model.rgb} 1"/>')
        if model.halo:
            lines.append(f'<geom class="seen" type="sphere" size="{model.halo}" rgba="{model.rgb} 0.15"/>')
        lines.append("</body>")
    return "\n    ".join(lines)


def servos(joints: Sequence[str], ranges: Sequence[tuple[float, float]], efforts: Sequence[float]) -> str:
    """Return the two actuators of each joint, from its range [rad] and its effort limit [Nm]."""
    lines = []
    for name, (low, high), effort in zip(joints, ranges, efforts, strict=True):
        stiffness = STIFFNESS_PER_EFFORT * effort
        lines.append(
            f'<intvelocity name="{name}" joint="{name}" kp="{stiffness}" actrange="{low} {high}"/>'
            f'<velocity name="{name}_velocity" joint="{name}" kv="{DAMPING_PER_STIFFNESS * stiffness}"/>'
        )
    return "\n    ".join(lines)
