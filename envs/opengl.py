"""OpenGL contexts for off-screen pictures, with or without a display, and a test whether a window can open."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from functools import cache
from importlib import import_module
from typing import Any

import mujoco

EGL_PROBE = "from mujoco.egl import GLContext; GLContext(8, 8).make_current()"
PROBE_TIMEOUT_S = 60.0


class CannotDrawError(RuntimeError):
    """This machine has no display, or no OpenGL that works without one."""


def has_display() -> bool:
    """Try to open an invisible window. MuJoCo ends or aborts the whole process if it cannot."""
    if not sys.platform.startswith("linux"):
        return True
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    import glfw  # MuJoCo's own dependency

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns if the display does not answer or has no OpenGL
        if not glfw.init():
            return False
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        window = glfw.create_window(8, 8, "", None, None)
        glfw.default_window_hints()
        if window:
            glfw.destroy_window(window)
        return bool(window)


def offscreen_context(width: int, height: int) -> Any:
    """Return an OpenGL context for pictures of width x height pixels, with `make_current` and `free`.

    MUJOCO_GL decides if it names egl or osmesa. Otherwise the display's OpenGL is used, and without a display EGL,
    then OSMesa. MuJoCo itself reads MUJOCO_GL only when it is imported, and fails without a display if it is unset.
    Raises CannotDrawError.
    """
    backend = os.environ.get("MUJOCO_GL", "").strip().lower()
    if not hasattr(mujoco, "GLContext"):
        raise CannotDrawError(f"no picture can be drawn: MUJOCO_GL={backend} turns MuJoCo's rendering off")
    if backend not in ("egl", "osmesa"):
        if has_display():
            return mujoco.GLContext(width, height)
        backend = "egl" if _egl_works() else "osmesa"
    try:
        return import_module(f"mujoco.{backend}").GLContext(width, height)
    except Exception as error:  # ImportError, AttributeError, RuntimeError, PyOpenGL's own: each library has its way
        raise CannotDrawError(
            f"no picture can be drawn: there is no display to draw with, and MuJoCo's {backend} fails ({error}); "
            f"install an OpenGL library, on Debian libegl1 or libosmesa6"
        ) from error


@cache
def _egl_works() -> bool:
    """Try EGL in another process: PyOpenGL keeps the first library that it loads, so OSMesa could not follow here."""
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    probe = [sys.executable, "-c", EGL_PROBE]
    try:
        return not subprocess.run(
            probe, env=environment, capture_output=True, timeout=PROBE_TIMEOUT_S, check=False
        ).returncode
    except (OSError, subprocess.TimeoutExpired):
        return False
