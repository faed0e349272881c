"""Picture of the demo: each robot at the start, midway and at the end, and all episodes as curves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlservo.drive.driven_episode import run_episode
from rlservo.drive.make_environment import make_env
from rlservo.drive.report import RolloutReport
from rlservo.drive.video import FilmedEnv
from rlservo.errors import UsageError
from rlservo.policy.acting_policy import ActingPolicy

Trace: TypeAlias = list[float]  # distance to the target [m] before each action of one episode
Frame: TypeAlias = NDArray[np.uint8]  # (height, width, 3)


@dataclass(frozen=True)
class DemoRobot:
    """One shipped policy and the simulator it drives."""

    policy: str
    checkpoint: str
    env_id: str
    title: str
    success_distance_m: float


@dataclass(frozen=True)
class RobotRun:
    """Run of one robot in the demo; `frames` is empty if the machine cannot draw."""

    robot: DemoRobot
    report: RolloutReport
    traces: list[Trace]
    frames: list[Frame]


def film(policy: ActingPolicy, env_id: str, *, seed: int, steps: int, note: Callable[[str], object]) -> list[Frame]:
    """Return the first, middle and last picture of an episode with this seed and number of steps.

    None, with a note, if the machine cannot draw. Only these are drawn: a picture costs more than a step and its
    action together.
    """
    try:
        env = make_env(env_id, {}, render=True)
    except UsageError as error:
        note(f"no pictures of the robots: {error.message}")
        return []
    frames: list[Frame] = []
    try:
        run_episode(FilmedEnv(env, frames.append, (0, steps // 2, steps)), policy, index=0, seed=seed)
    except UsageError as error:
        note(f"no pictures of the robots: {error.message}")
        return []
    finally:
        env.close()
    return frames


def draw_picture(file: Path, runs: list[RobotRun]) -> Path:
    """Write the picture as PNG and return its path."""
    from matplotlib.figure import Figure  # the object interface: no window system, no global state

    has_frames = any(run.frames for run in runs)
    columns = 4 if has_frames else 1
    figure = Figure(figsize=(4.0 * columns + (1.5 if has_frames else 4.0), 3.6 * len(runs)), layout="constrained")
    grid = figure.add_gridspec(len(runs), columns, width_ratios=[1, 1, 1, 1.3][-columns:])
    for row, run in enumerate(runs):
        for column, frame in enumerate(run.frames):
            axes = figure.add_subplot(grid[row, column])
            height = frame.shape[0]
            axes.imshow(frame[height // 8 : -height // 8])  # without the sky above and the floor below
            axes.set_axis_off()
            axes.set_title(f"{run.robot.title}, {('start', 'midway', 'end')[column]}", fontsize=10)
        _draw_curves(figure.add_subplot(grid[row, -1]), run)
    figure.savefig(file, dpi=110)
    return file


def _draw_curves(axes: Any, run: RobotRun) -> None:
    rate = run.report.control_rate_hz or 10.0
    for trace, episode in zip(run.traces, run.report.episodes, strict=True):
        seconds = np.arange(len(trace)) / rate
        axes.plot(seconds, trace, color="#2a6fb0" if episode.success else "#c0392b", alpha=0.6, linewidth=1.2)
        axes.plot(seconds[-1:], trace[-1:], "o", color="#2a6fb0" if episode.success else "#c0392b", markersize=3)
    axes.axhline(run.robot.success_distance_m, color="#2e7d32", linestyle="--", linewidth=1)
    axes.text(
        0.99,
        run.robot.success_distance_m,
        "success ",
        color="#2e7d32",
        ha="right",
        va="bottom",
        fontsize=8,
        transform=axes.get_yaxis_transform(),
    )
    axes.set_xlabel("time [s]")
    axes.set_ylabel("distance to target before each action [m]")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    axes.grid(alpha=0.25)
    latency = run.report.latency_ms
    answer = f", answer in {latency.p50:.2f} ms (median)" if latency else ""
    axes.set_title(
        f"{run.robot.title}: {run.report.successes} of {len(run.report.episodes)} at the target{answer}", fontsize=10
    )
