"""Pictures of a simulator: `rgb_array` frames, `human` in MuJoCo's viewer, and the interface of other viewers."""

from __future__ import annotations

import threading
from abc import abstractmethod
from typing import Any, ClassVar, Literal

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.opengl import CannotDrawError, has_display, offscreen_context

RENDER_MODES = ("human", "rgb_array")
MAX_GEOMS = 10_000  # in a picture, as mujoco.Renderer has it

Start = Literal["own", "random", "here"]
Vector = NDArray[np.float64]


class RenderedEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment that shows its simulator; one that derives from it sets `_camera`.

    Positions in the methods below are in MuJoCo's world.
    """

    IS_PLANAR: ClassVar[bool] = False  # whether robot and movable objects stay on the floor

    _camera: Camera

    def __init__(self, render_mode: str | None, *, gui: bool) -> None:
        if gui and render_mode is None:
            render_mode = "human"  # as robo-gym's `gui`
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode {render_mode!r} does not exist: expected one of {', '.join(RENDER_MODES)}")
        self.render_mode = render_mode

    def render(self) -> Any:
        """Return an (480, 640, 3) uint8 frame in mode rgb_array; the window of mode human refreshes by itself."""
        return self._camera.frame() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the GL context and close the window."""
        self._camera.close()

    @property
    def model(self) -> mujoco.MjModel:
        """The simulator's model."""
        return self._camera.model

    @property
    def data(self) -> mujoco.MjData:
        """The simulator's state."""
        return self._camera.data

    @abstractmethod
    def robot_position(self) -> Vector:
        """Return the position of the part of the robot that must reach the target [m] (3,)."""

    def target_position(self) -> Vector | None:
        """Return the position of the target, or of the obstacle to avoid [m] (3,); None for a task without either."""
        return None

    def move_target(self, position: ArrayLike) -> None:
        """Move the target within the episode. Raises ValueError for a task without one."""
        raise ValueError(f"{type(self).__name__} has no target to move to {np.asarray(position).tolist()}")

    def obstacle_positions(self) -> Vector:
        """Return the positions of the movable obstacles [m] (n, 3)."""
        return np.zeros((0, 3))

    def move_obstacle(self, index: int, position: ArrayLike) -> None:
        """Move an obstacle within the episode. Raises ValueError if it does not exist."""
        raise ValueError(f"{type(self).__name__} has no obstacle {index} to move to {np.asarray(position).tolist()}")

    def viewpoint(self) -> tuple[Vector, Vector]:
        """Return the positions of the camera and of the point it looks at [m] (3,) each."""
        return self._camera.viewpoint()

    def beams(self) -> Vector:
        """Return both ends of every laser beam [m] (n, 2, 3); none for a robot without lasers."""
        return np.zeros((0, 2, 3))

    def reset_options(self, *, start: Start = "own", keep_target: bool = False) -> dict[str, Any]:  # noqa: ARG002
        """Return options of `reset` for an episode that starts at the task's pose, at random, or at the robot's pose.

        With `keep_target` the target stays as well. A task that cannot start there starts in its own way.
        """
        return {}

    @abstractmethod
    def start_at(self, position: ArrayLike) -> dict[str, Any]:
        """Return options of `reset` that start an episode with `robot_position` at, or near, a position [m] (3,)."""

    @abstractmethod
    def show_observations(self, observations: NDArray[np.floating[Any]], row: int) -> None:
        """Show robot and target as in row `row` of an episode's observations (n, size): to look at, not to act.

        Anything that the observations do not contain keeps a new environment's value.
        """

    def _refresh_window(self) -> None:
        if self.render_mode == "human":
            self._camera.show()


class Camera:
    """One camera on one simulator. Nothing is allocated, and no GL context made, before the first frame."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        *,
        lookat: tuple[float, float, float],
        distance: float,
        azimuth: float,
        elevation: float,
        width: int = 640,
        height: int = 480,
    ) -> None:
        self.model, self.data = model, data
        self._width, self._height = width, height
        self._view = mujoco.MjvCamera()
        self._view.lookat[:] = lookat
        self._view.distance, self._view.azimuth, self._view.elevation = distance, azimuth, elevation
        self._picture: _Picture | None = None
        self._viewer: Any = None
        self._viewer_threads: set[threading.Thread] = set()

    def frame(self) -> NDArray[np.uint8]:
        """Return the current view as (height, width, 3) uint8. Raises CannotDrawError."""
        if self._picture is None:
            self._picture = _Picture(self.model, self._width, self._height)
        return self._picture.draw(self.data, self._view)

    def viewpoint(self) -> tuple[Vector, Vector]:
        """Return the positions of the camera and of the point it looks at [m] (3,) each."""
        azimuth, elevation = np.radians([self._view.azimuth, self._view.elevation])
        ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        return self._view.lookat - self._view.distance * ahead, self._view.lookat.copy()

    def show(self) -> None:
        """Open the viewer window at the first call, refresh it at the next ones.

        Raises CannotDrawError if there is no display.
        """
        if self._viewer is None:
            if not has_display():
                raise CannotDrawError(
                    "no window can be opened: DISPLAY and WAYLAND_DISPLAY name no display with OpenGL; "
                    "render_mode='rgb_array' needs none"
                )
            import mujoco.viewer  # opens a display connection when imported

            before = set(threading.enumerate())
            self._viewer = mujoco.viewer.launch_passive(self.model, self.data)
            self._viewer_threads = set(threading.enumerate()) - before
            self._viewer.cam.lookat[:] = self._view.lookat
            self._viewer.cam.distance = self._view.distance
            self._viewer.cam.azimuth = self._view.azimuth
            self._viewer.cam.elevation = self._view.elevation
        self._viewer.sync()

    def close(self) -> None:
        """Free the GL context and close the window."""
        if self._picture is not None:
            self._picture.free()
            self._picture = None
        if self._viewer is not None:
            # The window lives in threads of its own. Left to themselves they crash a second window, or Python's exit.
            self._viewer.close()
            for thread in self._viewer_threads:
                thread.join(timeout=10.0)
            self._viewer = None


class _Picture:
    """Off-screen buffer of one camera. `mujoco.Renderer` could not: it does not take our OpenGL context."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._model = model
        self._gl = offscreen_context(width, height)
        self._gl.make_current()
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._options = mujoco.MjvOption()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._pixels: NDArray[np.uint8] = np.empty((height, width, 3), dtype=np.uint8)

    def draw(self, data: mujoco.MjData, view: mujoco.MjvCamera) -> NDArray[np.uint8]:
        """Return a picture of the simulation's state, (height, width, 3) uint8."""
        self._gl.make_current()  # another camera's may be
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._options, None, view, everything, self._scene)
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._rectangle, self._context)
        return np.array(self._pixels[::-1])  # OpenGL's rows start at the bottom

    def free(self) -> None:
        """Free the graphics memory."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
