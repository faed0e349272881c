"""The objects a scene can hold, by the names of robo-gym's Gazebo models.

Source of the sizes: jr-robotics/robo-gym-robot-servers, simulation_objects/models (a name's figure is its size in mm).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ObjectModel:
    """A sphere or a cube that moves and pushes nothing, as in Gazebo (`collide_without_contact`)."""

    shape: str  # MuJoCo's geom type
    half_size: float  # [m], a sphere's radius, half a cube's edge
    collides: bool  # whether touching it counts as a collision
    rgb: str
    halo: float = 0.0  # [m], radius of a translucent sphere round it: how near is near enough


OBJECT_MODELS: dict[str, ObjectModel] = {
    "sphere50": ObjectModel("sphere", 0.025, collides=True, rgb="0.95 0.55 0.10"),
    "sphere50_no_collision": ObjectModel("sphere", 0.025, collides=False, rgb="0.85 0.15 0.15", halo=0.1),
    "green_sphere50_no_collision": ObjectModel("sphere", 0.025, collides=False, rgb="0.15 0.65 0.25", halo=0.1),
    "box50": ObjectModel("box", 0.025, collides=True, rgb="0.15 0.65 0.25"),
    "box100": ObjectModel("box", 0.05, collides=True, rgb="0.15 0.65 0.25"),
    "box100_2": ObjectModel("box", 0.05, collides=True, rgb="0.85 0.15 0.15"),
}


def object_model(name: str) -> ObjectModel:
    """Return the object of that name, or raise ValueError naming the objects."""
    if name not in OBJECT_MODELS:
        raise ValueError(f"object model {name!r} does not exist: expected one of {', '.join(OBJECT_MODELS)}")
    return OBJECT_MODELS[name]
