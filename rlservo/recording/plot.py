"""Picture of a recorded episode: observations, actions, rewards, latency and faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rlservo.errors import UsageError
from rlservo.extras import optional_package
from rlservo.recording.conversion.common import episodes_of_one
from rlservo.recording.episodes import Columns, RecordedEpisode
from rlservo.recording.policy_format import SpaceFormat
from rlservo.recording.reader import Recording

MOST_CURVES = 64


def plot_episode(recording: Recording, number: int, out: str | Path, *, name: str | None = None) -> RecordedEpisode:
    """Draw episode `number` (from 0, in the order they ended) of the policy `name` into the file `out` and return it.

    The numbers are those of an export. Raises UsageError if there is no such episode, the recording has several
    policies and no `name` is given, or matplotlib is missing.
    """
    figures = optional_package("matplotlib.figure", "a plot")
    episode = None
    for found, each in enumerate(episodes_of_one(recording, name)):  # to the end, where another policy may be
        episode = each if found == number else episode
    if episode is None:
        raise UsageError(f"the recording has no episode {number}: count from 0 (see `rlservo log info`)")
    panels = [*_panels(episode.obs, episode.policy.observations), *_panels(episode.executed, episode.policy.actions)]
    rows = len(panels) + 2
    figure = figures.Figure(figsize=(10, 1.6 * rows), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    time_s = episode.episode_s
    for axis, (unit, curves) in zip(axes, panels, strict=False):
        for label, values in curves:
            axis.plot(time_s, values, label=label, linewidth=1)
        axis.set_ylabel(unit)
        axis.legend(fontsize=5, loc="upper left", bbox_to_anchor=(1.0, 1.0), ncols=1 + len(curves) // 12)
    axes[-2].plot(time_s, episode.reward, linewidth=1)
    axes[-2].set_ylabel("reward")
    axes[-1].plot(time_s, episode.latency_ms, linewidth=1)
    axes[-1].set_ylabel("latency [ms]")
    rate_hz = episode.policy.contract.control_rate_hz
    axes[-1].set_xlabel(f"time [s] of steps at {rate_hz:g} Hz" if episode.is_faster_than_real else "time [s]")
    for axis in axes:
        _mark(axis, time_s, sorted({row for row, _ in episode.warnings}), "tab:orange")
        _mark(axis, time_s, np.flatnonzero(episode.fell_back | ~episode.acted).tolist(), "tab:red")
    end = episode.final_status or ("no end recorded" if not episode.ended else "ended")
    figure.suptitle(
        f"{episode.policy.title}, episode {number} ({episode.id or 'none'}), {len(episode)} decisions: {end}\n"
        f"orange: {len(episode.warnings)} warnings, red: {int((episode.fell_back | ~episode.acted).sum())} without the "
        "policy's action",
        fontsize=9,
    )
    figure.savefig(out, dpi=120)
    return episode


def _panels(columns: Columns, space: SpaceFormat) -> list[tuple[str, list[tuple[str, Any]]]]:
    """Return one panel for each tensor and unit: (its label, [(an element's name, its values)])."""
    found: dict[str, list[tuple[str, Any]]] = {}
    for name, leaf in columns.items():
        flat = leaf.reshape(len(leaf), -1)
        elements = space.leaves[name].elements
        for index, label in enumerate(space.labels(name)[:MOST_CURVES]):
            unit = elements[index].unit if index < len(elements) else ""
            found.setdefault(f"{name} [{unit}]" if unit else name, []).append((label, flat[:, index]))
    return list(found.items())


def _mark(axis: Any, time_s: Any, rows: list[int], colour: str) -> None:
    for row in rows:
        axis.axvline(time_s[row], color=colour, linewidth=0.5, alpha=0.6)
