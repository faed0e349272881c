"""The tutorial and the guides that train: their blocks run in order, as printed; trainings and exports in one Ray."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from documents import HOW_TO, TUTORIAL, ran
from rlservo.bundle.spaces import BoxSpec
from rlservo.policy.policy import Policy
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


def test_guide_to_training_runs_as_printed(one_ray: OneRay, tmp_path: Path) -> None:
    printed = ran(HOW_TO / "train.md", tmp_path, one_ray=one_ray)
    assert printed.count("best checkpoint: ") == 2
    with Policy.load(tmp_path / "runs" / "policies" / "cart-pole" / "2") as policy:
        assert policy.contract.provenance.env_id == "CartPole-v1"


def test_guide_to_ones_own_environment_runs_as_printed(one_ray: OneRay, tmp_path: Path) -> None:
    alone = "export RAY_ADDRESS=local RAY_AUTH_MODE=disabled\n"  # not the cluster of other tests
    printed = ran(HOW_TO / "your-own-environment.md", tmp_path, one_ray=one_ray, before=alone)
    assert "reach.Scaled, your own" in printed and re.search(r"success +│ +\d+\.\d%", printed)
    with Policy.load(tmp_path / "policies" / "reach") as policy:
        assert policy.contract.control_rate_hz == 20.0
        assert isinstance(policy.contract.observation_space, BoxSpec)
        assert [element.name for element in policy.contract.observation_space.elements] == ["position", "velocity"]


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
