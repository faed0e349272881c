"""Settings of a robot server, checked before anything is started.

The names are those of robo-gym's launch files; see launch_line.py for the lines that carry them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

from rlservo.envs.robot_server.robots.robot import CLOCKS
from rlservo.envs.ur.rs_modes import RS_MODES
from rlservo.robots.arm_interface import MUJOCO, host_of
from rlservo.robots.mir100.worlds import WORLDS as MIR100_WORLDS
from rlservo.robots.ur.model import Table
from rlservo.robots.ur.objects import object_model
from rlservo.robots.ur.parameters import cycle_of, ur_parameters

ACTION_MODES = ("abs_pos", "delta_pos")
MAX_OBJECTS = 10

# The table an arm stands on, by the name of the Gazebo world; no arm feels gravity, in a `_no_gravity` world or not.
ARM_WORLDS: dict[str, Table] = {
    "empty": False,
    "2_box100": False,
    "tabletop": True,
    "tabletop_box50": True,
    "tabletop_sphere50": True,
    "tabletop_sphere50_no_collision": True,
    "tabletop_sphere50_green_sphere50_no_collision": True,
    "isaactabletop_sphere50_no_collision": "isaac",
}
# The robot's world in Gazebo -> ours.
MIR100_WORLD_NAMES = {"empty_world_target": "empty", **{name: name for name in MIR100_WORLDS}}
OBJECTS_BY_MODE = {
    "only_robot": (),
    "1object": ("sphere50_no_collision",),
    "1moving2points": ("sphere50",),
    "2objects2points": ("green_sphere50_no_collision", "sphere50"),
}


@dataclass(frozen=True)
class Common:
    """Settings of every robot server."""

    host: str = "127.0.0.1"
    port: int = 0  # 0: any free one
    clock: str = "fast"
    gui: bool = False
    seed: int | None = None  # of the objects' random paths and the lasers' noise; None: differs from run to run

    def __post_init__(self) -> None:
        _one_of("clock", self.clock, CLOCKS)
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port {self.port} does not exist: expected 0 (any free one) to 65535")


@dataclass(frozen=True)
class ArmSettings(Common):
    """A robot server for an arm."""

    RS_MODES: ClassVar[Mapping[str, int]]  # how many objects a mode's state has
    ACTION_MODES: ClassVar[tuple[str, ...]] = ACTION_MODES
    FRAMES: ClassVar[tuple[str, ...]]  # for poses
    EE_FRAMES: ClassVar[tuple[str, ...]]  # for the end effector

    rs_mode: str = "only_robot"
    action_mode: str = "abs_pos"
    reference_frame: str = ""  # "": the first of FRAMES
    ee_frame: str = ""  # "": the first of EE_FRAMES
    action_cycle_rate: float = 25.0  # [Hz]
    max_velocity_scale_factor: float = 1.0
    world: str = "tabletop"
    objects: tuple[str, ...] | None = None  # None: as many as the mode needs

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of("rs_mode", self.rs_mode, self.RS_MODES)
        _one_of("action_mode", self.action_mode, self.ACTION_MODES)
        _one_of("reference_frame", self.reference_frame or self.FRAMES[0], self.FRAMES)
        _one_of("ee_frame", self.ee_frame or self.EE_FRAMES[0], self.EE_FRAMES)
        _one_of("world", self.world, ARM_WORLDS, suffixes=(".world", "_no_gravity"))
        cycle_of(self.action_cycle_rate)
        if not 0.0 < self.max_velocity_scale_factor <= 1.0:
            raise ValueError(
                f"max_velocity_scale_factor is {self.max_velocity_scale_factor:g}: expected more than 0, at most 1"
            )
        objects = self.object_names
        for name in objects:
            object_model(name)
        if not self.RS_MODES[self.rs_mode] <= len(objects) <= MAX_OBJECTS:
            raise ValueError(
                f"rs_mode {self.rs_mode!r} needs {self.RS_MODES[self.rs_mode]} to {MAX_OBJECTS} objects, and there are "
                f"{len(objects)} (a launch line has them with objects_controller:=true n_objects:=... "
                "object_0_model_name:=...)"
            )

    @property
    def object_names(self) -> tuple[str, ...]:
        """The objects in the scene."""
        return OBJECTS_BY_MODE[self.rs_mode] if self.objects is None else tuple(self.objects)

    @property
    def table(self) -> Table:
        """The table that the arm stands on, if any."""
        return ARM_WORLDS[_plain(self.world)]


@dataclass(frozen=True)
class URSettings(ArmSettings):
    """A robot server for a UR arm."""

    RS_MODES: ClassVar[Mapping[str, int]] = {name: mode.objects for name, mode in RS_MODES.items()}
    FRAMES = ("base_link", "base")
    EE_FRAMES = ("tool0", "tool1")

    ur_model: str = "ur5"
    robot: str = MUJOCO  # or rtde://HOST
    limits: dict[str, Any] = field(default_factory=dict)  # of a real arm, as rlservo/robots/limits.py has them
    confirm: bool = True  # ask at the terminal before a real arm moves to a pose of SetState
    metrics: str | None = None  # HOST:PORT at which Prometheus reads a real arm's

    def __post_init__(self) -> None:
        super().__post_init__()
        ur_parameters(self.ur_model)
        host_of(self.robot)


@dataclass(frozen=True)
class PandaSettings(ArmSettings):
    """A robot server for the Panda."""

    RS_MODES: ClassVar[Mapping[str, int]] = {"only_robot": 0, "1object": 1}
    ACTION_MODES = (*ACTION_MODES, "abs_vel", "delta_vel")
    FRAMES = ("world", "base", "panda_link0")
    EE_FRAMES = ("panda_hand",)


@dataclass(frozen=True)
class Mir100Settings(Common):
    """A robot server for the mobile robot."""

    world: str = "empty"

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of("world", self.world, MIR100_WORLD_NAMES, suffixes=(".world",))

    @property
    def world_name(self) -> str:
        """The world's name in our simulator."""
        return MIR100_WORLD_NAMES[self.world.removesuffix(".world")]


Settings = URSettings | PandaSettings | Mir100Settings
_KINDS: dict[str, type[Settings]] = {"ur": URSettings, "panda": PandaSettings, "mir100": Mir100Settings}


def settings_to_json(settings: Settings) -> str:
    """Return the settings as one line that `settings_from_json` understands."""
    kind = next(name for name, one in _KINDS.items() if type(settings) is one)
    return json.dumps({"kind": kind, **asdict(settings)})


def settings_from_json(line: str) -> Settings:
    """Return the settings of a line written by `settings_to_json`."""
    values: dict[str, Any] = json.loads(line)
    kind = _KINDS[values.pop("kind")]
    if values.get("objects") is not None:
        values["objects"] = tuple(values["objects"])
    return kind(**values)


def _plain(world: str) -> str:
    return world.removesuffix(".world").removesuffix("_no_gravity")


def _one_of(name: str, value: str, names: Collection[str], *, suffixes: Sequence[str] = ()) -> None:
    plain = value
    for suffix in suffixes:
        plain = plain.removesuffix(suffix)
    if plain not in names:
        raise ValueError(f"{name} {value!r} does not exist: expected one of {', '.join(names)}")
