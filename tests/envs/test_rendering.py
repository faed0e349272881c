"""Pictures of every simulator: off screen, and in a real window on a virtual display."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from ctypes.util import find_library

import pytest

from rlservo.bundle.environment_id import NAMESPACE, importing_id

WINDOW = """
import sys
import gymnasium as gym
for env_id in sys.argv[1:]:
    env = gym.make(env_id, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
print("closed")
"""

PICTURES = """
import sys
import mujoco  # MuJoCo settles how it draws when it is imported, which may be before one of ours is made
import gymnasium as gym
env = gym.make("rlservo.envs:rlservo/EndEffectorPositioningURSim-v0", render_mode=sys.argv[1])
for _ in range(2):
    try:
        env.reset(seed=0)
        picture = env.render()
        print(picture.shape, picture.std() > 10)
    except RuntimeError as error:
        print(error)
env.close()
"""
NO_EGL = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/none"}  # EGL has no driver then
NO_OSMESA = {"PYOPENGL_PLATFORM": "egl"}  # MuJoCo refuses OSMesa then


def in_a_process(mode: str, display: str | None = None, **variables: str) -> list[str]:
    """Draw twice where MUJOCO_GL is unset, and return what was printed."""
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")  # the second is set by MuJoCo's EGL
    environment = {name: value for name, value in os.environ.items() if name not in hidden} | variables
    if display is not None:
        environment["DISPLAY"] = display
    command = [sys.executable, "-c", PICTURES, mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(find_library("EGL") is None, reason="needs EGL (Debian: libegl1)")
@pytest.mark.parametrize("display", [None, ":77"], ids=["no display", "a display that does not answer"])
def test_without_a_display_egl_draws(display: str | None) -> None:
    assert in_a_process("rgb_array", display, **NO_OSMESA) == ["(480, 640, 3) True"] * 2


@pytest.mark.skipif(find_library("OSMesa") is None, reason="needs OSMesa (Debian: libosmesa6)")
def test_without_a_display_and_egl_osmesa_draws() -> None:
    assert in_a_process("rgb_array", **NO_EGL) == ["(480, 640, 3) True"] * 2


def test_without_anything_to_draw_with_each_picture_is_an_exception_in_one_sentence() -> None:
    first, second = in_a_process("rgb_array", **NO_EGL, **NO_OSMESA)
    assert first == second
    assert first.startswith("no picture can be drawn: there is no display to draw with, and MuJoCo's osmesa fails (")
    assert first.endswith("; install an OpenGL library, on Debian libegl1 or libosmesa6")


@pytest.mark.parametrize("display", [None, ":77"], ids=["no display", "a display that does not answer"])
def test_a_window_without_a_display_is_an_exception_in_one_sentence(display: str | None) -> None:
    assert (
        in_a_process("human", display)
        == [
            "no window can be opened: DISPLAY and WAYLAND_DISPLAY name no display with OpenGL; "
            "render_mode='rgb_array' needs none"
        ]
        * 2
    )


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a virtual display (Debian: xvfb)")
@pytest.mark.skipif(find_library("EGL") is None, reason="needs EGL (Debian: libegl1)")
@pytest.mark.parametrize(("mode", "start"), [("rgb_array", "(480, 640, 3) True"), ("human", "no window can be opened")])
def test_a_display_without_opengl_counts_as_none(mode: str, start: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    command = ["xvfb-run", "-a", "-s", "-extension GLX", sys.executable, "-c", PICTURES, mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    assert [line.startswith(start) for line in done.stdout.splitlines()] == [True, True]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a virtual display (Debian: xvfb)")
def test_windows_open_and_close_one_after_another() -> None:
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    names = ("EndEffectorPositioningURSim", "EmptyEnvironmentPandaSim", "ObstacleAvoidanceMir100Sim")  # of each robot
    env_ids = [importing_id(f"{NAMESPACE}/{name}-v0") for name in names]
    done = subprocess.run(
        ["xvfb-run", "-a", "-s", "-screen 0 1024x768x24", sys.executable, "-c", WINDOW, *env_ids],
        capture_output=True,
        text=True,
        timeout=180,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "closed"
