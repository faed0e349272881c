"""Options for a command's environment: constructor arguments, and rendering without a display."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from rlservo.errors import UsageError
from rlservo.extras import require


def parse_env_arguments(pairs: list[str], target: str | None = None) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is a string. Own environments take a target by that name."""
    arguments: dict[str, Any] = {} if target is None else {"target": target}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise UsageError(f"--env-arg {pair!r}: expected NAME=VALUE, for example ur_model=ur10e")
        try:
            arguments[name] = json.loads(value)
        except json.JSONDecodeError:
            arguments[name] = value
    return arguments


Target = Annotated[
    str | None,
    typer.Option(
        metavar="FRAME:NUMBERS",
        help="Target for rlservo's own robots. Arm: base_link:X,Y,Z or base:X,Y,Z (the pendant's frame) in m, with "
        ",ROLL,PITCH,YAW in rad for a task with an orientation; or joints:... (6, rad), for the flange's pose there. "
        "Base: odom:X,Y or base_link:X,Y in m.",
    ),
]


def require_robot(robot: str) -> None:
    """Raise UsageError where the package that reaches a robot is not installed."""
    if robot.startswith("rosbridge://"):
        require("rosbridge", "roslibpy", what="a rosbridge")
    elif not robot.startswith("ros2:"):  # which names its own lack: ROS 2 is no package of PyPI's
        from rlservo.robots.arm_interface import no_driver

        if find_spec("rtde_control") is None:
            raise UsageError(no_driver())


def choose_gl_backend() -> None:
    """Let MuJoCo render off screen if there is no display. Must be called before mujoco is imported."""
    if "MUJOCO_GL" in os.environ or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    from ctypes.util import find_library  # it imports subprocess

    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return
