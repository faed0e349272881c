"""Parser of the roslaunch lines that robo-gym's environments send to a server manager.

Arguments and their defaults: jr-robotics/robo-gym-robot-servers, ur_robot_server/launch/ur_robot_server.launch,
panda_robot_server/launch/panda_robot_server.launch and mir100_robot_server/launch/sim_robot_server.launch. Unknown
arguments are refused by name; one that only concerns the windows of Gazebo and RViz is accepted and has no effect; one
that asks for something that is not simulated is refused.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping
from typing import Any

from rlservo.envs.robot_server.robot_server_settings import (
    MAX_OBJECTS,
    Mir100Settings,
    PandaSettings,
    Settings,
    URSettings,
)

# Accepted, without effect.
WINDOWS = {"gui", "rviz_gui", "gazebo_gui", "rviz_config_path", "rviz_config_file"}
# Accepted with the values that mean what is simulated anyway.
ZERO = ("0.0", "0")
ARM_ONLY = {
    "real_robot": ("false",),
    "object_trajectory_file_name": ("no_file", ""),
    **dict.fromkeys(("x", "y", "roll", "pitch", "yaw"), ZERO),
}
UR_ONLY = {**ARM_ONLY, "use_voxel_occupancy": ("false",), "camera1_gazebo": ("false",)}
UR_HEIGHT = ("0.1",)  # z on robo-gym's own table and without one; on Isaac Lab's table it is 0
PANDA_ONLY = {
    **ARM_ONLY, "z": ZERO, "custom_joint_states_handler": ("false",),
    **dict.fromkeys(("subsampling_factor", "new_vel_weight", "new_eff_weight"), ("1", "1.0")),
}  # fmt: skip
MIR100_ONLY: dict[str, tuple[str, ...]] = dict.fromkeys(("robot_x", "robot_y", "robot_yaw"), ZERO)
ARM_KNOWN = {
    "world_name", "max_velocity_scale_factor", "server_port", "action_cycle_rate", "reference_frame", "ee_frame",
    "rs_mode", "action_mode", "objects_controller", "n_objects",
}  # fmt: skip
UR_KNOWN = ARM_KNOWN | {"ur_model", "target_mode"}
MIR100_KNOWN = {"world_name", "server_port"}
_OBJECT = re.compile(r"object_([0-9]{1,3})_(model_name|frame)")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_PORT = re.compile(r"[0-9]{1,9}")
MAX_LINE, MAX_VALUE = 10_000, 1_000  # [characters]; robo-gym's own lines have about 600, their longest value 40


def parse_launch_line(line: str, *, gui: bool = False, clock: str = "fast", host: str = "127.0.0.1") -> Settings:
    """Return the settings of a roslaunch line.

    Raises ValueError naming the package, launch file, argument or value that is not known or not simulated.
    """
    if len(line) > MAX_LINE:  # before any work on it: anyone who reaches the manager's port can send a line
        raise ValueError(f"the line has {len(line):,} characters: expected at most {MAX_LINE:,}")
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise ValueError(f"the line cannot be split into words: {error}") from error
    if len(words) < 3 or words[0] != "roslaunch":
        raise ValueError(f"the line is {line[:200]!r}: expected 'roslaunch <package> <launch file> name:=value ...'")
    package, file = words[1:3]
    if package not in LAUNCH_FILES:
        raise ValueError(f"package {package[:200]!r} is not known: expected one of {', '.join(LAUNCH_FILES)}")
    known_file, parse = LAUNCH_FILES[package]
    if file != known_file:
        raise ValueError(f"launch file {file[:200]!r} of {package} is not known: expected {known_file}")
    arguments: dict[str, str] = {}
    for word in words[3:]:
        name, separator, value = word.partition(":=")
        if not separator or not _NAME.fullmatch(name):
            raise ValueError(f"{word[:200]!r} is not a launch argument: expected name:=value")
        if len(value) > MAX_VALUE or not value.isprintable():  # it may stand in the log, on a line of its own
            raise ValueError(f"{name} is {value[:200]!r}: expected at most {MAX_VALUE:,} printable characters")
        arguments[name] = value
    return parse(arguments, gui, clock, host)


def _parse_ur(arguments: Mapping[str, str], gui: bool, clock: str, host: str) -> URSettings:
    world = arguments.get("world_name", "empty.world")
    _check_names(arguments, UR_KNOWN, {**UR_ONLY, "z": ZERO if world.startswith("isaac") else UR_HEIGHT})
    if "ur_model" not in arguments:
        raise ValueError("the argument ur_model is missing, and the launch file has no default for it")
    mode = arguments.get("rs_mode", "false")
    if mode == "false":
        mode = arguments.get("target_mode", "only_robot")
    return URSettings(
        host=host,
        clock=clock,
        gui=gui,
        ur_model=arguments["ur_model"],
        rs_mode=mode,
        action_mode=arguments.get("action_mode", "abs_pos"),
        reference_frame=arguments.get("reference_frame", "base"),
        **_of_arm(arguments, world),
    )


def _parse_panda(arguments: Mapping[str, str], gui: bool, clock: str, host: str) -> PandaSettings:
    _check_names(arguments, ARM_KNOWN, PANDA_ONLY)
    return PandaSettings(
        host=host,
        clock=clock,
        gui=gui,
        rs_mode=arguments.get("rs_mode", "only_robot"),
        action_mode=arguments.get("action_mode", "delta_pos"),
        reference_frame=arguments.get("reference_frame", "base"),
        **_of_arm(arguments, arguments.get("world_name", "empty.world")),
    )


def _of_arm(arguments: Mapping[str, str], world: str) -> dict[str, Any]:
    return {
        "port": _port(arguments),
        "ee_frame": arguments.get("ee_frame", ""),
        "action_cycle_rate": _number(arguments, "action_cycle_rate", 25.0),
        "max_velocity_scale_factor": _number(arguments, "max_velocity_scale_factor", 1.0),
        "world": world,
        "objects": _objects(arguments),
    }


def _objects(arguments: Mapping[str, str]) -> tuple[str, ...]:
    if arguments.get("objects_controller", "false").lower() != "true":
        return ()
    count = _number(arguments, "n_objects", 0.0)
    if not (0 <= count <= MAX_OBJECTS and count == int(count)):
        raise ValueError(f"n_objects is {count:g}: expected a whole number from 0 to {MAX_OBJECTS}")
    names = []
    for index in range(int(count)):
        name = arguments.get(f"object_{index}_model_name", "")
        if not name:
            raise ValueError(f"n_objects is {count:g}, and the argument object_{index}_model_name is missing")
        names.append(name)
    return tuple(names)


def _parse_mir100(arguments: Mapping[str, str], gui: bool, clock: str, host: str) -> Mir100Settings:
    _check_names(arguments, MIR100_KNOWN, MIR100_ONLY)
    return Mir100Settings(
        host=host,
        port=_port(arguments),
        clock=clock,
        gui=gui,
        world=arguments.get("world_name", "empty_world_target.world"),
    )


LAUNCH_FILES: dict[str, tuple[str, Callable[[Mapping[str, str], bool, str, str], Settings]]] = {
    "ur_robot_server": ("ur_robot_server.launch", _parse_ur),
    "panda_robot_server": ("panda_robot_server.launch", _parse_panda),
    "mir100_robot_server": ("sim_robot_server.launch", _parse_mir100),
}


def _check_names(arguments: Mapping[str, str], known: set[str], only: Mapping[str, tuple[str, ...]]) -> None:
    has_objects = "n_objects" in known
    expected = known | WINDOWS | set(only)
    unknown = [name for name in arguments if name not in expected and not (has_objects and _OBJECT.fullmatch(name))]
    if unknown:
        more = f" and {len(unknown) - 5} more" if unknown[5:] else ""
        raise ValueError(
            f"unknown launch arguments: {', '.join(name[:50] for name in unknown[:5])}{more}; expected some of "
            f"{', '.join(sorted(expected))}" + (", object_<i>_model_name, object_<i>_frame" if has_objects else "")
        )
    for name, values in only.items():
        if name in arguments and arguments[name].lower() not in values:
            raise ValueError(f"{name}:={arguments[name]} is not simulated: expected {name}:={values[0]}")


def _port(arguments: Mapping[str, str]) -> int:
    text = arguments.get("server_port", "0")
    if not _PORT.fullmatch(text):
        raise ValueError(f"server_port:={text} is not a port: expected a whole number, 0 (any free one) to 65535")
    return int(text)


def _number(arguments: Mapping[str, str], name: str, default: float) -> float:
    text = arguments.get(name)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name}:={text} is not a number") from None
