"""The robot's two worlds, as in robo-gym's Gazebo.

Source: jr-robotics/robo-gym-robot-servers, mir100_robot_server/worlds. Poses are x, y [m] and yaw [rad] in the map
frame.
"""

from __future__ import annotations

from dataclasses import dataclass

CUBE_SIZE = 0.5  # [m]
WALL_THICKNESS, WALL_HEIGHT = 0.15, 0.5  # [m]

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """A box standing on the floor, along the axes of the map."""

    name: str
    centre: tuple[float, float]
    size: tuple[float, float]  # along x, along y


@dataclass(frozen=True)
class World:
    """Walls that stand, cubes that can be placed."""

    name: str
    walls: tuple[Wall, ...] = ()
    cubes: tuple[Pose, ...] = ()  # their poses before they are placed


def _room(name: str, centre: tuple[float, float], size: tuple[float, float], cubes: tuple[Pose, ...]) -> World:
    """Return a rectangular room. `size` is measured over the outer faces of the walls."""
    (x, y), (width, depth) = centre, size
    dx, dy = (width - WALL_THICKNESS) / 2, (depth - WALL_THICKNESS) / 2
    walls = (
        Wall("wall_north", (x, y + dy), (width, WALL_THICKNESS)),
        Wall("wall_south", (x, y - dy), (width, WALL_THICKNESS)),
        Wall("wall_east", (x + dx, y), (WALL_THICKNESS, depth)),
        Wall("wall_west", (x - dx, y), (WALL_THICKNESS, depth)),
    )
    return World(name, walls, cubes)


EMPTY = World("empty")
# The original's room stands a little off the origin.
LAB_6X8 = _room(
    "lab_6x8",
    centre=(-0.027, 0.014),
    size=(6.0, 8.0),
    cubes=((-1.54295, -0.508579, 0.0), (0.08192, -0.508549, 0.0), (1.57208, -0.832156, 0.0)),
)
WORLDS = {world.name: world for world in (EMPTY, LAB_6X8)}


def find_world(name: str) -> World:
    """Return the world of that name, or raise ValueError naming the worlds."""
    if name not in WORLDS:
        raise ValueError(f"world {name!r} does not exist: expected one of {', '.join(WORLDS)}")
    return WORLDS[name]
