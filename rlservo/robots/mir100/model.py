"""MuJoCo model of the robot in one of its worlds.

The robot is a planar body (x, y, yaw of base_link) driven as two wheels on an axle drive it: a motor ahead, a motor for
turning, and a grip that lets nothing slide sideways. Rolling wheels and casters were tried: at the same physics step a
control cycle took 144 us instead of 23 us, and the body shivered on its six contacts.
"""

from __future__ import annotations

from rlservo.robots.mir100.parameters import (
    BACK_SCANNER,
    BODY_CENTRE,
    CASTERS,
    FRONT_SCANNER,
    HEIGHT,
    LENGTH,
    MASS,
    WHEEL_EFFORT,
    WHEEL_RADIUS,
    WHEEL_SEPARATION,
    WHEEL_WIDTH,
    WIDTH,
)
from rlservo.robots.mir100.worlds import CUBE_SIZE, WALL_HEIGHT, World

TIMESTEP = 0.01  # [s]
BEAM_GROUP = 1  # the geom group of what the lasers can see

# Time constant with which the wheels' speed controllers reduce a velocity error.
DRIVE_TIME_CONSTANT = 0.005  # [s], half a physics step: the shortest that cannot oscillate at the force limit
GRIP_TIME_CONSTANT = 0.001  # [s], sideways: a corner at full speed slides by 1.5 mm/s

DRIVE_FORCE = 2 * WHEEL_EFFORT / WHEEL_RADIUS  # [N], both wheels
TURN_TORQUE = DRIVE_FORCE * WHEEL_SEPARATION / 2  # [Nm]
# The body as a homogeneous box, about the axle (parallel axes).
YAW_INERTIA = MASS * ((LENGTH**2 + WIDTH**2) / 12 + BODY_CENTRE[0] ** 2)  # [kg m^2]


def model_xml(world: World) -> str:
    """Return the model.

    Joints `x`, `y`, `yaw` are base_link's pose. Actuators `drive` [m/s], `grip` [m/s, to the left] and `turn` [rad/s]
    are velocity servos in the robot's own frame. Mocap bodies: `target` and `cube_0`, `cube_1`, ... Only the robot's
    body collides, with walls and cubes.
    """
    return f"""
<mujoco model="mir100 in {world.name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast"><flag gravity="disable"/></option>
  <statistic center="0 0 0.2" extent="6"/>
  <visual>
    <global offwidth="1280" offheight="960"/>
    <headlight ambient="0.42 0.42 0.43" diffuse="0.22 0.22 0.22" specular="0.05 0.05 0.05"/>
    <quality shadowsize="4096" offsamples="8"/>
    <map znear="0.01" zfar="40" shadowclip="1.2"/>
  </visual>
  <default>
    <default class="seen"><geom contype="0" conaffinity="0" group="0" mass="0"/></default>
    <default class="scenery"><geom type="box" contype="0" conaffinity="1" group="{BEAM_GROUP}"/></default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.95 0.96 0.97" rgb2="0.74 0.79 0.85" width="64"
             height="384"/>
    <texture name="tile" type="2d" builtin="flat" mark="edge" rgb1="0.63 0.67 0.71" markrgb="0.50 0.54 0.59"
             width="128" height="128"/>
    <material name="floor" texture="tile" texrepeat="2 2" texuniform="true" specular="0.1"/>
    <material name="shell" rgba="0.90 0.91 0.92 1" specular="0.4" shininess="0.5"/>
    <material name="dark" rgba="0.13 0.14 0.16 1" specular="0.2"/>
    <material name="light" rgba="0.10 0.78 0.95 1" emission="0.8"/>
    <material name="scanner" rgba="0.98 0.78 0.08 1" specular="0.3"/>
    <material name="wall" rgba="0.87 0.89 0.92 1"/>
    <material name="cube" rgba="0.86 0.55 0.27 1" specular="0.1"/>
    <mesh name="arrow" vertex="0.10 0 0  -0.07 0.09 0  -0.03 0 0  0.10 0 0.004  -0.07 0.09 0.004  -0.03 0 0.004"/>
    <mesh name="arrow_right"
          vertex="0.10 0 0  -0.07 -0.09 0  -0.03 0 0  0.10 0 0.004  -0.07 -0.09 0.004  -0.03 0 0.004"/>
  </asset>
  <worldbody>
    <light type="directional" pos="2 -3 8" dir="-0.25 0.35 -1" diffuse="0.60 0.60 0.57" specular="0.1 0.1 0.1"/>
    <geom class="seen" name="floor" type="plane" size="14 14 0.1" material="floor"/>
    {_scenery(world)}
    {_target()}
    <body name="base_link">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" type="hinge" axis="0 0 1"/>
      <site name="axle" rgba="0 0 0 0"/>
      <geom name="body" type="box" pos="{_xyz(*BODY_CENTRE)}" size="{_xyz(LENGTH / 2, WIDTH / 2, HEIGHT / 2)}"
            mass="{MASS}" contype="1" conaffinity="0" group="3"/>
      {_housing()}
      {_wheels()}
    </body>
  </worldbody>
  <actuator>
    <velocity name="drive" site="axle" gear="1 0 0 0 0 0" kv="{MASS / DRIVE_TIME_CONSTANT}"
              forcerange="{-DRIVE_FORCE} {DRIVE_FORCE}"/>
    <velocity name="grip" site="axle" gear="0 1 0 0 0 0" kv="{MASS / GRIP_TIME_CONSTANT}"/>
    <velocity name="turn" site="axle" gear="0 0 0 0 0 1" kv="{YAW_INERTIA / DRIVE_TIME_CONSTANT}"
              forcerange="{-TURN_TORQUE} {TURN_TORQUE}"/>
  </actuator>
</mujoco>
"""


def _scenery(world: World) -> str:
    lines = [
        f'<geom class="scenery" name="{wall.name}" pos="{_xyz(*wall.centre, WALL_HEIGHT / 2)}" '
        f'size="{_xyz(wall.size[0] / 2, wall.size[1] / 2, WALL_HEIGHT / 2)}" material="wall"/>'
        for wall in world.walls
    ]
    half = CUBE_SIZE / 2
    lines += [
        f'<body name="cube_{index}" mocap="true" pos="{_xyz(x, y, half)}" euler="0 0 {yaw}">'
        f'<geom class="scenery" name="cube_{index}" size="{_xyz(half, half, half)}" material="cube"/></body>'
        for index, (x, y, yaw) in enumerate(world.cubes)
    ]
    return "\n    ".join(lines)


def _target() -> str:
    """A disc of the radius within which the robot has arrived, and a post to find it by."""
    green = "0.13 0.66 0.33"
    return f"""<body name="target" mocap="true" pos="0 0 0">
      <geom class="seen" type="cylinder" size="0.20 0.004" pos="0 0 0.004" rgba="{green} 0.55"/>
      <geom class="seen" type="cylinder" size="0.05 0.006" pos="0 0 0.006" rgba="{green} 1"/>
      <geom class="seen" type="cylinder" size="0.012 0.3" pos="0 0 0.3" rgba="{green} 1"/>
      <geom class="seen" type="sphere" size="0.05" pos="0 0 0.62" rgba="{green} 1"/>
    </body>"""


def _housing() -> str:
    """The white shell with the scanners' dark slit, the light band, the dark top."""
    centre_x = BODY_CENTRE[0]

    def slab(low: float, high: float, inset: float, material: str, corner: float = 0.06) -> str:
        """A box with rounded corners between two heights: two crossed boxes and four cylinders."""
        half_x, half_y, half_z = LENGTH / 2 - inset, WIDTH / 2 - inset, (high - low) / 2
        z = (low + high) / 2
        parts = [
            f'<geom class="seen" type="box" pos="{_xyz(centre_x, 0, z)}" size="{_xyz(x, y, half_z - lower)}" '
            f'material="{material}"/>'
            # Surfaces in one plane would flicker: each part is a tenth of a millimetre lower than the one before.
            for x, y, lower in ((half_x, half_y - corner, 0.0), (half_x - corner, half_y, 0.0001))
        ]
        parts += [
            f'<geom class="seen" type="cylinder" size="{corner:g} {half_z - 0.0002:g}" '
            f'pos="{_xyz(centre_x + sx * (half_x - corner), sy * (half_y - corner), z)}" material="{material}"/>'
            for sx in (1, -1)
            for sy in (1, -1)
        ]
        return "\n      ".join(parts)

    lines = [
        slab(0.070, 0.150, 0.0, "shell"),
        slab(0.150, 0.225, 0.035, "dark"),
        slab(0.225, 0.237, 0.0, "light"),
        slab(0.237, 0.335, 0.004, "shell"),
        slab(0.335, 0.352, 0.03, "dark"),
        f'<geom class="seen" type="mesh" mesh="arrow" pos="{_xyz(0.33, 0, 0.354)}" material="light"/>',
        f'<geom class="seen" type="mesh" mesh="arrow_right" pos="{_xyz(0.33, 0, 0.354)}" material="light"/>',
    ]
    for scanner in (FRONT_SCANNER, BACK_SCANNER):
        x, y, _ = scanner.position
        lines.append(
            f'<geom class="seen" type="cylinder" size="0.045 0.036" pos="{_xyz(x, y, 0.1875)}" material="scanner"/>'
        )
    return "\n      ".join(lines)


def _wheels() -> str:
    places = [(0.0, WHEEL_SEPARATION / 2), (0.0, -WHEEL_SEPARATION / 2), *CASTERS]
    return "\n      ".join(
        f'<geom class="seen" type="cylinder" size="{WHEEL_RADIUS} {WHEEL_WIDTH / 2}" zaxis="0 1 0" '
        f'pos="{_xyz(x, y, WHEEL_RADIUS)}" material="dark"/>'
        for x, y in places
    )


def _xyz(x: float, y: float, z: float) -> str:
    return f"{x:.6f} {y:.6f} {z:.6f}"
