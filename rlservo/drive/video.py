"""Mp4 video of an environment's `rgb_array` frames."""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import UsageError, first_line
from rlservo.extras import needs_extra
from rlservo.policy.acting_policy import Closeable

if TYPE_CHECKING:
    import gymnasium as gym


class VideoFile(Closeable):
    """An mp4 file that grows frame by frame, created with the first one. A context manager."""

    def __init__(self, path: str | Path, *, fps: float) -> None:
        """Check the name and the encoder's installation, so that a long run does not fail at its first frame."""
        self.path = Path(path)
        if self.path.suffix.lower() != ".mp4":
            raise UsageError(f"the video file is {str(path)!r}: expected a name that ends in .mp4")
        if not self.path.parent.is_dir():
            raise UsageError(f"the video file's folder {str(self.path.parent)!r} does not exist: create it first")
        with needs_extra("sim", what="a video"):
            for module in ("imageio.v2", "imageio_ffmpeg"):
                import_module(module)
        self._fps = fps
        self._writer: Any = None
        self.frames = 0

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append one (height, width, 3) uint8 picture."""
        if self._writer is None:
            import imageio.v2 as imageio

            # macro_block_size 2: yuv420p needs it; the default of 16 would rescale most pictures with a warning.
            self._writer = imageio.get_writer(self.path, fps=self._fps, codec="libx264", macro_block_size=2)
        try:
            self._writer.append_data(frame)
        except OSError as error:  # the encoder ended; it has written why, such as a full disk, to standard error
            raise UsageError(f"the video {self.path} cannot be written: {first_line(error)}") from error
        self.frames += 1

    def close(self) -> None:
        """Finish the file; harmless when repeated."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class FilmedEnv:
    """An environment that passes `add` its picture after each reset and step, or only after `steps` (0: the reset)."""

    def __init__(
        self, env: gym.Env[Any, Any], add: Callable[[NDArray[np.uint8]], object], steps: Collection[int] | None = None
    ) -> None:
        self._env = env
        self._add = add
        self._steps = steps
        self._step = 0

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        result = self._env.reset(seed=seed)
        self._step = 0
        self._draw()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self._env.step(action)
        self._step += 1
        self._draw()
        return result

    def _draw(self) -> None:
        if self._steps is None or self._step in self._steps:
            self._add(rgb_frame(self._env))


def rgb_frame(env: gym.Env[Any, Any]) -> NDArray[np.uint8]:
    """Return `env.render()` as (height, width, 3) uint8.

    Raises UsageError when the environment cannot draw: no GL library, no display, or no `rgb_array` mode.
    """
    try:
        frame: Any = env.render()
    except Exception as error:  # GL libraries raise ImportError, AttributeError, RuntimeError and mujoco.FatalError
        raise UsageError(
            f"the environment cannot draw a picture ({type(error).__name__}: {str(error)[:200]}). For MuJoCo without a "
            "display install the Debian package libegl1 and set MUJOCO_GL=egl, or libosmesa6 and MUJOCO_GL=osmesa"
        ) from error
    array = np.asarray(frame)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
        description = type(frame).__name__ if array.ndim == 0 else f"{array.dtype} {array.shape}"
        raise UsageError(f"the environment's rgb_array picture is {description}, expected uint8 (height, width, 3)")
    return array
