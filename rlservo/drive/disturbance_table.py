"""Table of disturbances: success, return and endings of a policy under each of them, over the same seeds."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from rlservo.bundle.contract import Evaluation
from rlservo.drive.control_loop import rollout
from rlservo.drive.disturbance import DisturbanceError, disturb_env, parse_disturbance
from rlservo.drive.make_environment import make_env
from rlservo.drive.report import EpisodeRow, RolloutReport
from rlservo.drive.smoothness import StepSize
from rlservo.drive.success import SuccessRate, success_rates
from rlservo.errors import UsageError
from rlservo.extras import optional_package
from rlservo.policy.acting_policy import ActingPolicy

NOMINAL = "none"
STANDARD = (
    "latency=1", "latency=3", "latency=5", "observation_latency=1", "observation_latency=3", "late=3", "drop=0.1",
    "drop=0.3", "noise=real", "noise=3*real", "bias=real", "bias=2*real", "payload=1", "payload=3", "model=0.05",
    "model=0.1", "base=0.01", "base=0.03",
)  # fmt: skip
EVERYTHING = (
    "latency=0..3", "observation_latency=0..1", "drop=0.05", "noise=real", "bias=real", "payload=0..3", "model=0.05",
    "base=0..0.01",
)  # fmt: skip
OUT_OF_DEPTH = ("target=outside", "start=corner", "stuck=any")

COLUMNS = ("disturbance", "success", "return", "endings", "step, largest / mean")
PROGRESS_EVERY_S = 5.0
WIDEST = 44  # [characters], of a column
Z_95 = 1.96


@dataclass(frozen=True)
class DisturbedRow:
    """Result under one disturbance. Success is None if the environment reports it in no row."""

    disturbance: str
    episodes: int
    first_seed: int
    successes: int | None
    success_rate: float | None
    success_interval: tuple[float, float] | None  # 95%, Wilson
    return_mean: float
    return_interval: tuple[float, float] | None  # 95%, of the mean, normal; None for one episode
    length_mean: float
    endings: dict[str, int]
    step_sizes: dict[str, StepSize]


@dataclass(frozen=True)
class DisturbanceTable:
    """The measured rows, and reasons for the skipped ones."""

    env_id: str
    policy: str
    version: str
    rows: tuple[DisturbedRow, ...]
    skipped: dict[str, str]  # disturbance: the method that the environment lacks
    robot: dict[str, Any]  # that was simulated, as the environment describes it

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


def measure_disturbances(
    policy: ActingPolicy,
    env_id: str,
    disturbances: Sequence[str] = (),
    *,
    episodes: int,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    progress: Callable[[str], object],
) -> DisturbanceTable:
    """Drive `env_id` without disturbances and under each of them, over the seeds from `seed`.

    By default the standard ones, except those that the environment does not support; a given one that is not supported
    raises UsageError. `progress` gets a line for each row and every few seconds.
    """
    arguments = dict(env_kwargs or {})
    for text in disturbances:
        parse_disturbance(text)
    given, skipped, robot = _possible(env_id, arguments, disturbances)
    reports = []
    for number, text in enumerate((NOMINAL, *given)):
        beat = _Beat(f"{text} ({number + 1} of {len(given) + 1})", episodes, progress)
        report = rollout(
            policy,
            env_id,
            episodes=episodes,
            seed=seed,
            env_kwargs=arguments,
            on_episode=beat,
            disturb=None if text == NOMINAL else text,
        )
        if report.interrupted:  # part of a table would compare different episodes
            raise KeyboardInterrupt
        reports.append(report)
        progress(f"{beat.label}: {_success(report)}, return {report.return_mean:.4g}")
    # Of all rows: one in which every episode fails may have no report.
    rates = success_rates(*([row.success for row in report.episodes] for report in reports))
    rows = [_row(*row, seed) for row in zip((NOMINAL, *given), reports, rates, strict=True)]
    return DisturbanceTable(env_id, policy.contract.name, policy.contract.version, tuple(rows), skipped, robot)


def evaluations_of(table: DisturbanceTable, evaluated_at: str) -> tuple[Evaluation, ...]:
    """Return the rows as evaluations for the bundle's contract."""
    return tuple(
        Evaluation(
            env_id=table.env_id,
            episodes=row.episodes,
            first_seed=row.first_seed,
            return_bundle=row.return_mean,
            return_interval=row.return_interval,
            success_rate_bundle=row.success_rate,
            success_interval=row.success_interval,
            disturbance=row.disturbance,
            endings=row.endings,
            robot=table.robot,
            evaluated_at=evaluated_at,
        )
        for row in table.rows
    )


def render_table(table: DisturbanceTable) -> Table:
    """Return the table for a terminal."""
    shown = Table(title=f"{table.env_id}  <-  {table.policy} version {table.version}", title_justify="left")
    for column in COLUMNS:
        shown.add_column(column, overflow="fold", max_width=WIDEST)
    for row in table.rows:
        shown.add_row(*_cells(row))
    return shown


def check_plot(out: Path) -> None:
    """Raise now the UsageError that `plot_table` would raise after minutes: no such folder, no matplotlib."""
    if not out.parent.is_dir():
        raise UsageError(f"the plot's folder {str(out.parent)!r} does not exist: create it first")
    formats = optional_package("matplotlib.figure", "a plot").Figure().canvas.get_supported_filetypes()
    if out.suffix.removeprefix(".") not in formats:
        raise UsageError(f"the plot is {str(out)!r}: expected a name that ends in .{', .'.join(sorted(formats))}")


def plot_table(table: DisturbanceTable, out: str | Path) -> None:
    """Draw success (or else the return) with its interval, one line per disturbance.

    Raises UsageError if matplotlib is missing.
    """
    figures = optional_package("matplotlib.figure", "a plot")
    rows = table.rows[::-1]
    figure = figures.Figure(figsize=(8, 1.2 + 0.3 * len(rows)), layout="constrained")
    axis = figure.subplots()
    has_success = all(row.success_rate is not None for row in rows)
    labels = ["\n".join(textwrap.wrap(row.disturbance.replace(",", ", "), WIDEST)) for row in rows]
    for height, row in enumerate(rows):
        if row.success_rate is not None and row.success_interval is not None and has_success:
            centre = 100.0 * row.success_rate
            low, high = (100.0 * share for share in row.success_interval)
        else:
            centre = row.return_mean
            low, high = row.return_interval or (centre, centre)
        axis.plot([low, high], [height, height], color="tab:blue", linewidth=2, alpha=0.5)
        axis.plot([centre], [height], "o", color="tab:blue", markersize=4)
    axis.set_yticks(range(len(rows)), labels, fontsize=7)
    axis.set_xlabel("success [%], 95% interval" if has_success else "mean return, 95% interval")
    if has_success:
        axis.set_xlim(-2, 102)
    axis.grid(axis="x", alpha=0.3)
    figure.suptitle(f"{table.policy} version {table.version}, {table.env_id}, {rows[0].episodes} episodes", fontsize=9)
    figure.savefig(out, dpi=100)


def _cells(row: DisturbedRow) -> tuple[str, ...]:
    low_high = "" if row.return_interval is None else " ({:.4g} to {:.4g})".format(*row.return_interval)
    endings = ", ".join(f"{count} {status}" for status, count in sorted(row.endings.items())) or "-"
    return (
        row.disturbance,
        _success(row),
        f"{row.return_mean:.4g}{low_high}",
        endings,
        ", ".join(f"{what} {size.largest:.3g} / {size.mean:.2g}" for what, size in row.step_sizes.items()) or "-",
    )


def _success(row: DisturbedRow | RolloutReport) -> str:
    if row.success_rate is None or row.success_interval is None:
        return "-"
    low, high = row.success_interval
    return f"{row.success_rate:.1%} ({low:.1%} to {high:.1%})"


def _possible(
    env_id: str, arguments: Mapping[str, Any], disturbances: Sequence[str]
) -> tuple[tuple[str, ...], dict[str, str], dict[str, Any]]:
    """Return the disturbances to measure, the standard ones that the environment does not support, and its robot."""
    env = make_env(env_id, arguments, render=False)
    robot = dict(getattr(env.unwrapped, "robot_facts", {}))
    try:
        if disturbances:
            for text in disturbances:
                disturb_env(env, parse_disturbance(text))
            return tuple(disturbances), {}, robot
        lacking: dict[str, str] = {}
        for text in (*STANDARD, *EVERYTHING, *OUT_OF_DEPTH):
            try:
                disturb_env(env, parse_disturbance(text))
            except DisturbanceError as error:
                lacking[text] = error.message.partition(": ")[2]
        everything = ",".join(text for text in EVERYTHING if text not in lacking)
        possible = tuple(text for text in (*STANDARD, everything, *OUT_OF_DEPTH) if text not in lacking)
        named = {text: why for text, why in lacking.items() if text not in EVERYTHING or text in STANDARD}
        return possible, named, robot
    finally:
        env.close()


def _row(text: str, report: RolloutReport, success: SuccessRate | None, seed: int) -> DisturbedRow:
    assert report.return_mean is not None and report.length_mean is not None, "every episode has finished"
    interval = None
    if report.return_std is not None:
        half = Z_95 * report.return_std / len(report.episodes) ** 0.5
        interval = (report.return_mean - half, report.return_mean + half)
    return DisturbedRow(
        disturbance=text,
        episodes=len(report.episodes),
        first_seed=seed,
        successes=success and success.successes,
        success_rate=success and success.rate,
        success_interval=success and success.interval,
        return_mean=report.return_mean,
        return_interval=interval,
        length_mean=report.length_mean,
        endings=report.final_status,
        step_sizes=report.step_sizes,
    )


class _Beat:
    """Progress lines, one every few seconds."""

    def __init__(self, label: str, episodes: int, progress: Callable[[str], object]) -> None:
        self.label = label
        self._episodes, self._progress = episodes, progress
        self._last = time.monotonic()

    def __call__(self, episode: EpisodeRow) -> None:
        if time.monotonic() - self._last >= PROGRESS_EVERY_S:
            self._last = time.monotonic()
            self._progress(f"{self.label}: {episode.index + 1} of {self._episodes} episodes")
