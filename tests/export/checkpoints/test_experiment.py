"""Choice of a checkpoint from a Tune experiment's folder."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import pytest

from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.experiment import best_checkpoint

METRIC = "env_runners/episode_return_mean"


def write_trial(folder: Path, returns: list[float | None], *, kept: set[int] | None = None) -> Path:
    """Write what Tune and RLlib write: a result a line, and checkpoints that know their training iteration."""
    folder.mkdir(parents=True)
    lines = []
    for number, value in enumerate(returns):
        name = f"checkpoint_{number:06d}"
        if kept is None or number in kept:
            (folder / name).mkdir()
            (folder / name / "algorithm_state.pkl").write_bytes(pickle.dumps({"training_iteration": number + 1}))
        result: dict[str, Any] = {"training_iteration": number + 1}
        if value is not None:
            result["env_runners"] = {"episode_return_mean": value, "num_episodes": 3}
        lines.append(json.dumps(result))
    (folder / "result.json").write_text("\n".join(lines) + "\n")
    return folder


def test_the_best_of_all_trials_is_picked_by_metric_and_mode(tmp_path: Path) -> None:
    write_trial(tmp_path / "a", [1.0, 5.0, 3.0])
    write_trial(tmp_path / "b", [4.0, -2.0])
    (tmp_path / "tuner.pkl").write_text("beside them")
    best = best_checkpoint(tmp_path, METRIC, notify=print)
    assert (best.path, best.score) == (tmp_path / "a" / "checkpoint_000001", 5.0)
    assert best_checkpoint(tmp_path, METRIC, "min", notify=print).path == tmp_path / "b" / "checkpoint_000001"
    assert best_checkpoint(tmp_path / "b", METRIC, notify=print).path == tmp_path / "b" / "checkpoint_000000"


def test_checkpoints_that_tune_has_deleted_and_results_that_are_no_numbers_are_passed_over(tmp_path: Path) -> None:
    write_trial(tmp_path / "a", [9.0, float("nan"), 2.0, None], kept={1, 2, 3})
    with (tmp_path / "a" / "result.json").open("a") as file:
        file.write('{"cut off')
    assert best_checkpoint(tmp_path, METRIC, notify=print).score == 2.0


def test_what_cannot_be_picked_is_said_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="is not a Tune trial or experiment"):
        best_checkpoint(tmp_path, METRIC, notify=print)
    write_trial(tmp_path / "a", [1.0])
    with pytest.raises(CheckpointError, match=f"its checkpoints report {METRIC}"):
        best_checkpoint(tmp_path, "episode_return_mean", notify=print)
