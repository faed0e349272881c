"""Observation filters, by where checkpoints hold their statistics, against runners that RLlib restored from them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from checkpoints import ZOO
from rlservo.errors import CheckpointError, ParityError
from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.export.reports import export_report
from rlservo.policy.policy import Policy

pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")


@pytest.fixture
def export(tmp_path: Path, notices: list[str]) -> Callable[..., ExportResult]:
    def export(checkpoint: Path, **options: Any) -> ExportResult:
        options = {"app_dir": ZOO, **options}  # it has the module of the configurations' functions
        return export_checkpoint(checkpoint, tmp_path / "out", notify=notices.append, **options)

    return export


@pytest.fixture
def damaged(layout_zoo: Path, tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: Path(shutil.copytree(layout_zoo / name, tmp_path / "damaged" / name))


def count(result: ExportResult) -> Any:
    return result.contract.baked_in[0].values["count"]


def assert_acts_as_restored(result: ExportResult, file: Path) -> None:
    seen, policy = np.load(file), Policy.load(result.path)
    actions = [policy.act(obs) for obs in seen["obs"]]
    np.testing.assert_allclose(np.stack(actions).reshape(seen["action"].shape), seen["action"], rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize(
    "name",
    ["local_evaluated", "remote_evaluated", "remote_evaluated_remotely", "no_local_evaluated",
     "no_local_evaluated_remotely"],
)  # fmt: skip
def test_the_statistics_are_trainings_wherever_rllib_saved_them(
    layout_zoo: Path, export: Callable[..., ExportResult], tmp_path: Path, name: str
) -> None:
    result = export(layout_zoo / name)
    assert count(result) == 129  # 128 steps and a start; evaluation's saw 200 more or none
    assert "statistics of 129 observations; training took 128 environment steps" in export_report(result.contract).plain
    assert_acts_as_restored(result, layout_zoo / f"{name}.npz")
    prune_checkpoint(layout_zoo / name, tmp_path / "pruned", app_dir=tmp_path, notify=lambda _: None)
    assert export(tmp_path / "pruned").contract.baked_in == result.contract.baked_in


def test_a_configuration_whose_functions_are_elsewhere_asks_for_their_folder(
    layout_zoo: Path, app: Path, export: Callable[..., ExportResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "train_zoo", raising=False)  # another test's, as the path
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).name != ZOO.name])
    words = r"local_evaluated: the connector pipelines cannot be built .* module 'train_zoo', .*--app-dir"
    with pytest.raises(CheckpointError, match=words):
        export(layout_zoo / "local_evaluated", app_dir=app)


def test_every_module_finds_its_agents_statistics_at_the_root(
    layout_zoo: Path, export: Callable[..., ExportResult]
) -> None:
    for agent in ("left", "right"):
        result = export(layout_zoo / "no_local_team", module_id=f"{agent}_arm")
        assert_acts_as_restored(result, layout_zoo / f"no_local_team_{agent}.npz")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("never_merged", r"come from 0 observations: RLlib divides .*; training took 128 environment steps"),
        ("imitation", r"come from \d+ observations in evaluation and none in training; "),
    ],
)
def test_statistics_that_are_not_trainings_are_exported_only_where_asked_for(
    layout_zoo: Path, export: Callable[..., ExportResult], notices: list[str], name: str, words: str
) -> None:
    with pytest.raises(CheckpointError, match=words + r".*--untrained-filter"):
        export(layout_zoo / name)
    result = export(layout_zoo / name, untrained_filter=True)
    assert any("the observation filter's statistics come from" in notice for notice in notices)
    assert_acts_as_restored(result, layout_zoo / f"{name}.npz")


@pytest.mark.parametrize("name", ["no_local_evaluated", "local_evaluated"])
def test_the_gate_does_not_read_statistics_where_the_exporter_does(
    layout_zoo: Path, export: Callable[..., ExportResult], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(CheckpointFiles, "runner", property(lambda files: files.root / "eval_env_runner"))
    with pytest.raises(ParityError, match="output 'action"):
        export(layout_zoo / name, untrained_filter=True)


@pytest.mark.parametrize(
    ("name", "lost", "place"),
    [("no_local_evaluated", ["env_to_module_connector", "module_to_env_connector"], r"no_local_evaluated/"),
     ("local_evaluated", ["env_runner"], r"env_runner/")],
)  # fmt: skip
def test_evaluations_statistics_do_not_stand_in_for_trainings(
    damaged: Callable[[str], Path], export: Callable[..., ExportResult], name: str, lost: list[str], place: str
) -> None:
    checkpoint = damaged(name)
    for folder in lost:
        shutil.rmtree(checkpoint / folder)
    words = rf"restore the connectors from {place}, which has none, and those in eval_env_runner/ are not training's"
    with pytest.raises(CheckpointError, match=words):
        export(checkpoint, untrained_filter=True)


def test_statistics_of_two_trainings_are_not_guessed_between(
    layout_zoo: Path, damaged: Callable[[str], Path], export: Callable[..., ExportResult]
) -> None:
    checkpoint = damaged("no_local_evaluated")
    shutil.copytree(layout_zoo / "local_evaluated" / "env_runner", checkpoint / "env_runner")
    with pytest.raises(CheckpointError, match="connectors both in env_runner/ and at its root"):
        export(checkpoint)
