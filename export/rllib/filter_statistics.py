"""Statistics of RLlib's running MeanStdFilter, of both API stacks, as the recipe's frozen filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.location import CheckpointFiles, Files
from rlservo.export.recipe.recipe import ObservationFilter, Recipe


def frozen_filter(running: Any) -> ObservationFilter:
    """Return the frozen form of a `ray.rllib.utils.filter.MeanStdFilter`. Raises CheckpointError if it diverged."""
    stats = running.running_stats
    mean, std = np.asarray(stats.mean, np.float64), np.asarray(stats.std, np.float32)
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise CheckpointError("the observation filter's mean or standard deviation is not finite: training diverged")
    clip = float(running.clip) if running.clip else None  # RLlib tests for truth: 0 also means no clipping
    return ObservationFilter(int(stats.n), mean, std, clip, bool(running.demean), bool(running.destd))


def why_untrained(files: Files, recipe: Recipe) -> str:
    """Return why the observation filter's statistics are not training's; '' if they are or there is no filter."""
    if (frozen := recipe.filter) is None:
        return ""
    seen = f"{frozen.count:,} observation{'' if frozen.count == 1 else 's'}"
    if isinstance(files, CheckpointFiles) and files.is_of_evaluation:
        return f"the observation filter's statistics come from {seen} in evaluation and none in training"
    if frozen.count > 1:
        return ""
    clipped = " and clips" if frozen.clip is not None else ""
    return f"the observation filter's statistics come from {seen}: RLlib divides by 1e-6{clipped}, unlike in training"
