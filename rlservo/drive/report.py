"""Report of a rollout: success, return, latency, deadline misses, as JSON and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from rich.table import Table

from rlservo.drive.driven_episode import DrivenEpisode
from rlservo.drive.smoothness import ACTION, StepSize

Rate = Literal["max", "real"]


@dataclass(frozen=True)
class EpisodeRow(DrivenEpisode):
    """One finished episode, and the time spent in its `act` calls."""

    latency_p50_ms: float
    latency_max_ms: float


@dataclass(frozen=True)
class Latency:
    """Time spent in `act`, over all steps of the run including unfinished episodes [ms]."""

    p50: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True)
class ConnectionCounts:
    """Counts of the connection to the policy, over all steps of the run."""

    fallback: str | None  # the action for a missing answer
    late: int  # no answer within the deadline
    unavailable: int  # no connection, or a server that refused temporarily
    lost: int  # the server had lost the episode's memory
    fallback_steps: int  # steps that got the fallback's action
    stale: int  # answers that came after their deadline and were dropped
    reconnects: int


@dataclass(frozen=True)
class RolloutReport:
    """A run of several episodes. Episode figures only count finished ones; None means that there were none.

    Success is None where no episode reports it; where one does, those that do not have failed.
    """

    env_id: str
    policy: str
    version: str
    rate: Rate
    seed: int | None
    requested_episodes: int
    interrupted: bool
    episodes: tuple[EpisodeRow, ...]
    successes: int | None
    success_rate: float | None
    success_interval: tuple[float, float] | None  # 95%, Wilson
    return_mean: float | None
    return_std: float | None
    length_mean: float | None
    final_status: dict[str, int]
    steps: int
    wall_s: float  # first reset to last step
    steps_per_s: float
    latency_ms: Latency | None
    control_rate_hz: float | None
    deadline_ms: float | None  # one control period
    deadline_misses: int | None  # steps in which `act` alone took longer than that
    overruns: int | None  # rate 'real': steps after which the loop was late for the next one
    video: str | None
    link: ConnectionCounts | None = None  # None: the policy was in process
    stopped: str | None = None  # why the loop ended early: the fallback is 'stop'
    disturbance: str | None = None  # the disturbance of the environment, as given
    step_sizes: dict[str, StepSize] = field(default_factory=dict)  # of "action", and of velocities by unit
    rehearsal: list[dict[str, Any]] | None = None  # a dry run's motions: [rad], [s], [rad/s], [m/s], [m]
    robot: dict[str, int] | None = None  # a real robot's limits: number of cycles in which each was applied

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


def latency_of(latencies_s: Sequence[float]) -> Latency | None:
    """Return the percentiles of latencies given in seconds, in milliseconds."""
    if not latencies_s:
        return None
    p50, p95, p99 = (float(p) for p in np.percentile(latencies_s, (50, 95, 99)))
    return Latency(1e3 * p50, 1e3 * p95, 1e3 * p99, 1e3 * max(latencies_s))


def render_steps(step_sizes: Mapping[str, StepSize], which: Literal["mean", "largest"]) -> str:
    """Return the sizes of steps as text: of the action, and of commanded velocities in their units."""
    return ", ".join(
        f"action {getattr(size, which):.3g}" if what == ACTION else f"velocity {getattr(size, which):.3g} {what}"
        for what, size in step_sizes.items()
    )


def render_report(report: RolloutReport) -> Table:
    """Return the report as a rich table of two columns."""
    version = f"{report.policy} version {report.version}"
    table = Table(title=f"{report.env_id}  <-  {version}", title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column()
    finished = len(report.episodes)
    note = "  (interrupted)" if report.interrupted else ""
    if report.disturbance is not None:
        table.add_row("disturbance", report.disturbance)
    table.add_row("episodes", f"{finished} of {report.requested_episodes}{note}")
    if report.success_rate is not None and report.success_interval is not None:
        low, high = report.success_interval
        table.add_row("success", f"{report.success_rate:.1%}  (95% interval {low:.1%} to {high:.1%})")
    else:
        table.add_row("success", "no rate: the environment does not report it")
    if report.return_mean is not None and report.length_mean is not None:
        spread = "" if report.return_std is None else f" +- {report.return_std:.3g}"
        table.add_row("return", f"{report.return_mean:.4g}{spread}")
        table.add_row("episode length", f"{report.length_mean:.1f} steps")
    if report.final_status:
        table.add_row("endings", ", ".join(f"{status}: {count}" for status, count in report.final_status.items()))
    if report.step_sizes:
        table.add_row("largest step", render_steps(report.step_sizes, "largest"))
        table.add_row("mean step", render_steps(report.step_sizes, "mean"))
    if report.latency_ms is not None:
        latency = report.latency_ms
        table.add_row(
            "latency of act",
            f"p50 {latency.p50:.3g}  p95 {latency.p95:.3g}  p99 {latency.p99:.3g}  max {latency.max:.3g} ms",
        )
    if report.deadline_ms is None:
        table.add_row("deadline misses", "no control rate known")
    else:
        table.add_row(
            "deadline misses",
            f"{report.deadline_misses} of {report.steps} steps over {report.deadline_ms:.4g} ms "
            f"({report.control_rate_hz:g} Hz)",
        )
    if report.overruns is not None:
        table.add_row(
            "overruns",
            f"{report.overruns} of {report.steps} steps (the whole loop, env.step included, took longer than a period)",
        )
    if report.link is not None:
        link = report.link
        table.add_row(
            "link",
            f"late {link.late}  unavailable {link.unavailable}  memory lost {link.lost}  dropped late answers "
            f"{link.stale}  reconnects {link.reconnects}",
        )
        if link.fallback is not None:
            table.add_row("fallback", f"{link.fallback_steps} of {report.steps} steps ({link.fallback})")
    for row in report.rehearsal or ():
        places = [f"({', '.join(f'{value + 0.0:.2f}' for value in row[name])})" for name in ("from", "to", "flange")]
        table.add_row(
            f"dry run, {row['motion']}",
            f"{row['time_s']:.1f} s from {places[0]} to {places[1]} rad, each joint at most {row['joint_speed']:.2g} "
            f"rad/s; flange to {places[2]} m in base_link, at most {row['flange_speed']:.2g} m/s, lowest z "
            f"{row['lowest_flange']:.2f} m",
        )
    if report.robot is not None:
        kept = ", ".join(f"{name} {count}" for name, count in report.robot.items()) or "none"
        table.add_row("limits kept", f"{kept} (cycles of the command stream)")
    if report.stopped is not None:
        table.add_row("stopped", report.stopped)
    table.add_row("speed", f"{report.steps_per_s:,.0f} steps/s over {report.wall_s:.1f} s, rate '{report.rate}'")
    if report.video is not None:
        table.add_row("video", report.video)
    return table
