"""The tutorial and the guides that train: their blocks run in order, as printed; trainings and exports in one Ray."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from documents import HOW_TO, TUTORIAL, ran
from rlservo.serve_app.runtime.policy import Policy
from trainings import OneRay

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tutorial(one_ray: OneRay, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the tutorial printed, and the folder it ran in."""
    folder = tmp_path_factory.mktemp("tutorial")
    return ran(TUTORIAL, folder, one_ray=one_ray), folder


def test_tutorial_runs_as_printed(tutorial: tuple[str, Path]) -> None:
    printed, folder = tutorial
    assert re.search(r"^\w+_00000 +1 +8,\d\d\d +-?\d", printed, re.MULTILINE)  # its first iteration
    assert list((folder / "runs" / "policies").glob("*/1/contract.json"))
    assert "production=2" in printed
    assert re.search(r"^success$", printed, re.MULTILINE)


def test_guide_to_training_runs_as_printed(one_ray: OneRay, tmp_path: Path) -> None:
    printed = ran(HOW_TO / "train.md", tmp_path, one_ray=one_ray)
    assert printed.count("best checkpoint: ") == 2
    with Policy.load(tmp_path / "runs" / "policies" / "cart-pole" / "2") as policy:
        assert policy.contract.provenance.env_id == "CartPole-v1"


def test_guide_to_learning_runs_as_printed(one_ray: OneRay, tmp_path: Path) -> None:
    printed = ran(HOW_TO / "learn.md", tmp_path, one_ray=one_ray)
    assert "BC from the weights of " in printed
    with Policy.load(tmp_path / "learning" / "ur5" / "2") as policy:
        assert policy.contract.provenance.algorithm == "BC"


def test_guide_to_online_learning_runs_as_printed(
    tutorial: tuple[str, Path], one_ray: OneRay, shipped: Path, tmp_path: Path
) -> None:
    shutil.copytree(shipped / "ur5", tmp_path / "policies" / "ur5")
    (checkpoint,) = tutorial[1].glob("runs/PPO-*/*/checkpoint_*")
    shutil.copytree(checkpoint, tmp_path / "runs" / "ppo" / "checkpoint")
    ran(HOW_TO / "learn-online.md", tmp_path, one_ray=one_ray)
