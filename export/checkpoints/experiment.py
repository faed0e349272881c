"""Choice of a checkpoint of a Tune experiment by a metric, from the result.json files that Tune writes.

A metric is written as Tune prints it, `env_runners/episode_return_mean`. RLlib's results do not say which checkpoint
was saved with them; the training iteration in the checkpoint's own state does, which is a pickle.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rlservo.errors import CheckpointError, UsageError
from rlservo.export.checkpoints.facts import read_facts
from rlservo.export.checkpoints.unpickle import user_code

RESULTS = "result.json"
Pick = Literal["max", "min"]
_CHECKPOINT = re.compile(r"checkpoint_\d{6,}")


@dataclass(frozen=True)
class Candidate:
    """A checkpoint and the metric reported with it."""

    path: Path
    score: float


def best_checkpoint(
    folder: str | Path, metric: str, mode: Pick = "max", *, app_dir: str | Path = ".", notify: Callable[[str], None]
) -> Candidate:
    """Return the checkpoint with the largest (or smallest) metric of the trial, or of the trials, that `folder` holds.

    Raises CheckpointError when there is no checkpoint with such a number, naming the metrics that were reported.
    """
    if mode not in ("max", "min"):
        raise UsageError(f"mode {mode!r} does not exist: expected 'max' or 'min'")
    root = Path(folder).expanduser().absolute()
    if not root.is_dir():
        raise CheckpointError(f"{root} is not a folder: expected a Tune trial or experiment")
    trials = [root] if (root / RESULTS).is_file() else sorted(child.parent for child in root.glob(f"*/{RESULTS}"))
    if not trials:
        raise CheckpointError(
            f"{root} is not a Tune trial or experiment: looked for {RESULTS} in it and in its folders"
        )
    candidates: list[Candidate] = []
    reported: set[str] = set()
    with user_code(app_dir):
        for trial in trials:
            for path, result in _reported(trial, notify):
                numbers = dict(_numbers(result))
                reported |= set(numbers)
                score = numbers.get(metric)
                if score is not None and math.isfinite(score):
                    candidates.append(Candidate(path, score))
    if not candidates:
        raise CheckpointError(
            f"{root} has no checkpoint with a finite '{metric}'"
            + (f"; its checkpoints report {_closest(reported, metric)}" if reported else "")
        )
    chosen = max if mode == "max" else min
    return chosen(candidates, key=lambda one: one.score)


def _reported(trial: Path, notify: Callable[[str], None]) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield each checkpoint of a trial that still exists, and the result reported with it."""
    try:
        lines = (trial / RESULTS).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{trial / RESULTS} cannot be read: {error}") from error
    results: dict[int, Mapping[str, Any]] = {}
    for line in lines:
        try:
            result = json.loads(line)
            results[int(result["training_iteration"])] = result  # the last one counts if the trial was resumed
        except (ValueError, KeyError, TypeError):
            continue  # a line cut off by a crash
    for path in sorted(child for child in trial.iterdir() if _CHECKPOINT.fullmatch(child.name) and child.is_dir()):
        iteration = read_facts(path, notify).training_iterations
        if iteration is not None and iteration in results:
            yield path, results[iteration]


def _numbers(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, float]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{path}{key}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{path}{key}", float(value)


def _closest(names: set[str], wanted: str) -> str:
    likely = sorted(names, key=lambda name: (wanted.rpartition("/")[2] not in name, "return" not in name, name))
    return ", ".join(likely[:6]) + (f" and {len(likely) - 6} more" if len(likely) > 6 else "")
