"""Options for a command's environment: constructor arguments, and rendering without a display."""

from __future__ import annotations

import json
import os
from typing import Any

from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import require


def parse_env_arguments(pairs: list[str]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is a string."""
    arguments: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise UsageError(f"--env-arg {pair!r}: expected NAME=VALUE, for example ur_model=ur10e")
        try:
            arguments[name] = json.loads(value)
        except json.JSONDecodeError:
            arguments[name] = value
    return arguments


def require_robot(robot: str) -> None:
    """Raise UsageError where the package that reaches a robot is not installed."""
    if robot.startswith("rosbridge://"):
        require("rosbridge", "roslibpy", what="a rosbridge")
    elif not robot.startswith("ros2:"):  # which names its own lack: ROS 2 is no package of PyPI's
        require("ur", "rtde_control", what="a real robot")


def choose_gl_backend() -> None:
    """Let MuJoCo render off screen if there is no display. Must be called before mujoco is imported."""
    if "MUJOCO_GL" in os.environ or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    from ctypes.util import find_library  # it imports subprocess

    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return
