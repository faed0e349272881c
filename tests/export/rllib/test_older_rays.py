"""Checkpoints that older Ray releases wrote, against the actions that those releases themselves computed."""

from __future__ import annotations

import pickle
import shutil
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ray.rllib.algorithms.ppo.ppo_catalog import PPOCatalog
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule

from rlservo.errors import UnsupportedError
from rlservo.export.checkpoints.facts import read_facts
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.unpickle import unpickle, user_code
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.policy.policy import Policy

OLDER_RAYS = Path(__file__).resolve().parents[2] / "older_rays"  # also the user's own code that they need


def names_in(archive: Path) -> list[str]:
    with tarfile.open(archive) as opened:
        return [Path(name).with_suffix("").as_posix() for name in opened.getnames() if name.endswith(".npz")]


CHECKPOINTS = [name for archive in sorted(OLDER_RAYS.glob("*.tar.xz")) for name in names_in(archive)]
REFUSED = {"2.24.0/ppo_new", "2.24.0/lstm_new"}
EXPORTED = [name for name in CHECKPOINTS if name not in REFUSED]


@pytest.fixture(scope="module")
def older_rays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of checkpoints `<Ray>/<name>/` and what was recorded, `<Ray>/<name>.npz`."""
    folder = tmp_path_factory.mktemp("older-rays")
    for archive in OLDER_RAYS.glob("*.tar.xz"):
        shutil.unpack_archive(archive, folder)
    return folder


def test_every_checkpoint_is_tried() -> None:
    """A matrix that has lost its files would pass."""
    assert {name.partition("/")[0] for name in EXPORTED} == {
        "2.1.0", "2.7.2", "2.9.3", "2.24.0", "2.33.0", "2.40.0", "2.44.1", "2.48.0", "2.50.1",
    }  # fmt: skip
    assert {f"{ray}/{algorithm}_new" for ray in ("2.40.0", "2.44.1", "2.48.0", "2.50.1")
            for algorithm in ("ppo", "dqn", "sac", "lstm")} <= set(EXPORTED)  # fmt: skip


@pytest.mark.parametrize("name", EXPORTED)
def test_an_export_acts_as_the_ray_that_trained_it(
    older_rays: Path, tmp_path: Path, notices: list[str], name: str
) -> None:
    checkpoint = older_rays / name
    result = export_checkpoint(checkpoint, tmp_path, name="older", app_dir=OLDER_RAYS, notify=notices.append)
    policy, seen = Policy.load(result.path), np.load(checkpoint.with_suffix(".npz"))
    for obs, action, restart in zip(seen["obs"], seen["action"], seen["restart"], strict=True):
        if restart:
            policy.reset()
        np.testing.assert_allclose(policy.act(obs), action, rtol=1e-5, atol=2e-6)
    ray, _, kind = name.partition("/")
    origin = result.contract.provenance
    assert origin.ray_version == ray
    assert origin.algorithm == {"dqn": "DQN", "sac": "SAC"}.get(kind.partition("_")[0], "PPO")
    assert origin.env_id == ("CartPole-v1" if kind.startswith(("dqn", "lstm")) else "Pendulum-v1")
    assert origin.env_steps == (32 if kind.startswith(("dqn", "sac")) else 512)
    assert origin.training_iterations == (None if ray == "2.1.0" else 2)  # 2.1 has it in Tune's own file
    assert not [notice for notice in notices if "cannot be read" in notice]
    counts = [step.values["count"] for step in result.contract.baked_in if step.step == "mean_std_filter"]
    assert len(counts) == kind.startswith(("ppo", "bare")) and all(512 <= count <= 520 for count in counts)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_a_checkpoint_without_its_connectors_is_refused(older_rays: Path, name: str) -> None:
    with pytest.raises(UnsupportedError, match=r"before 2.33 wrote them .* without the connectors"):
        locate_checkpoint(older_rays / name)


@pytest.mark.parametrize("name", ["2.9.3/ppo_old", "2.33.0/ppo_new", "2.44.1/ppo_new"])
def test_a_pruned_copy_of_an_older_checkpoint_is_the_same_policy(
    older_rays: Path, tmp_path: Path, notices: list[str], name: str
) -> None:
    prune_checkpoint(older_rays / name, tmp_path / "small", app_dir=OLDER_RAYS, notify=notices.append)
    whole, small = (locate_checkpoint(folder) for folder in (older_rays / name, tmp_path / "small"))
    assert small.sha256() == whole.sha256()
    export_checkpoint(tmp_path / "small", tmp_path / "out", name="older", app_dir=OLDER_RAYS, notify=notices.append)
    with user_code(OLDER_RAYS):
        assert read_facts(small.root, notices.append) == read_facts(whole.root, notices.append)


@pytest.fixture
def older_copy(older_rays: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies a checkpoint to where a test may change it."""
    return lambda name: Path(shutil.copytree(older_rays / name, tmp_path / "changed"))


def test_connectors_that_the_configuration_does_not_give_are_refused(
    older_copy: Callable[[str], Path], tmp_path: Path, notices: list[str]
) -> None:
    checkpoint = older_copy("2.33.0/ppo_new")
    (checkpoint / "env_runner/env_to_module_connector/AgentToModuleMapping").mkdir()
    with pytest.raises(UnsupportedError, match=r"holds the connectors .*AgentToModuleMapping.* did not save their"):
        export_checkpoint(checkpoint, tmp_path / "out", app_dir=OLDER_RAYS, notify=notices.append)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: state["policy_spec"].update(policy_class="A3CTorchPolicy"), "A3CTorchPolicy .* no longer has"),
        (lambda state: state["weights"].update({"encoder.lstm.weight": 0}), "an RLModule inside an old-stack policy"),
        (
            lambda state: vars(state["policy_spec"]["config"]["rl_module_spec"]).update(module_class=Path),
            "an RLModule inside an old-stack policy",
        ),
    ],
)
def test_a_policy_that_has_no_successor_is_refused_by_name(
    older_copy: Callable[[str], Path],
    tmp_path: Path,
    notices: list[str],
    change: Callable[[dict[str, Any]], None],
    words: str,
) -> None:
    checkpoint = older_copy("2.7.2/ppo_old")
    file = checkpoint / "policies/default_policy/policy_state.pkl"
    state = unpickle(file, missing_ok=True)
    spec = SimpleNamespace(module_class=DefaultPPOTorchRLModule, catalog_class=PPOCatalog)  # its own class is gone
    state["policy_spec"]["config"].update({"rl_module_spec": spec, "__marl_module_spec": None})
    change(state)
    file.write_bytes(pickle.dumps(state))
    with pytest.raises(UnsupportedError, match=words):
        export_checkpoint(checkpoint, tmp_path / "out", notify=notices.append)


def test_a_filter_that_is_not_in_the_policys_own_folder_is_missed_by_name(
    older_rays: Path, tmp_path: Path, notices: list[str]
) -> None:
    alone = Path(shutil.copytree(older_rays / "2.1.0/bare_old/policies/default_policy", tmp_path / "alone"))
    with pytest.raises(UnsupportedError, match=r"does not hold the observation filter's statistics: .*algorithm_state"):
        export_checkpoint(alone, tmp_path / "out", notify=notices.append)


@pytest.mark.skipif(sys.version_info[:2] == (3, 10), reason="the Python that pickled it")
def test_a_function_that_another_python_pickled_by_value_says_so_when_it_is_called(older_rays: Path) -> None:
    state = unpickle(older_rays / "2.1.0/ppo_old/algorithm_state.pkl", missing_ok=True)
    with pytest.raises(TypeError, match="pickled by value, by another Python"):
        state["worker"]["is_policy_to_train"]("default_policy")
