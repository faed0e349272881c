"""Paths that a user may give, and the message if one is not a checkpoint."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.location import locate_checkpoint, locate_modules
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.graph.onnx_file import run_onnx
from rlservo.export.rllib.restore import restore

MODULE = "learner_group/learner/rl_module/default_policy"


def test_a_folder_inside_a_checkpoint_means_the_checkpoint(zoo: Path) -> None:
    whole = locate_checkpoint(zoo / "pendulum")
    for inside in (MODULE, "learner_group", "env_runner/env_to_module_connector"):
        assert locate_checkpoint(zoo / "pendulum" / inside) == whole


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.write_text("x"), "is a file"),
        (lambda path: path.mkdir(), r"is not an RLlib checkpoint: looked for .*checkpoint_NNNNNN/ \(a Tune trial\)"),
    ],
)
def test_what_is_no_checkpoint_is_said_in_one_sentence(
    tmp_path: Path, make: Callable[[Path], object], words: str
) -> None:
    make(tmp_path / "given")
    with pytest.raises(CheckpointError, match=words):
        locate_checkpoint(tmp_path / "given")


def test_a_module_on_its_own_is_taken_with_a_warning_of_what_it_lacks(
    zoo: Path, tmp_path: Path, copy_of: Callable[[str], Path], notices: list[str]
) -> None:
    (copy_of("mixed") / MODULE).rename(tmp_path / "alone")
    result = export_checkpoint(tmp_path / "alone", tmp_path / "out", notify=notices.append)
    assert "a filter, one-hot or other step before it is NOT in the export" in " ".join(notices)
    seen = np.load(zoo / "mixed.npz")  # this policy has nothing before its module
    found = run_onnx(result.path / "policy.onnx")({"obs": seen["obs"]})["action"]
    np.testing.assert_allclose(found, seen["action"], rtol=1e-5, atol=2e-6)


def test_pipelines_that_were_not_saved_are_built_from_the_configuration(
    zoo: Path, copy_of: Callable[[str], Path], tmp_path: Path, notices: list[str]
) -> None:
    damaged = copy_of("clipped")
    shutil.rmtree(damaged / "env_runner")
    result = export_checkpoint(damaged, tmp_path / "out", notify=notices.append)
    assert "holds no connectors" in " ".join(notices)
    assert [step.step for step in result.contract.baked_in] == ["network", "mode", "clip"]  # as it was configured
    seen = np.load(zoo / "clipped.npz")
    found = run_onnx(result.path / "policy.onnx")({"obs": seen["obs"]})["action"]
    np.testing.assert_allclose(found, seen["action"], rtol=1e-5, atol=2e-6)


def test_a_filter_whose_statistics_were_not_saved_is_refused(
    copy_of: Callable[[str], Path], app: Path, tmp_path: Path, notices: list[str]
) -> None:
    damaged = copy_of("pendulum")
    shutil.rmtree(damaged / "env_runner")
    with pytest.raises(CheckpointError, match="the observation filter's statistics come from 0 observations"):
        export_checkpoint(damaged, tmp_path / "out", app_dir=app.parent, notify=notices.append)
    (damaged / "class_and_ctor_args.pkl").unlink()
    with pytest.raises(CheckpointError, match="it has neither env_runner/"):
        locate_checkpoint(damaged)


def test_several_trials_are_not_guessed_between(zoo: Path, tmp_path: Path) -> None:
    for trial in ("a", "b"):
        (tmp_path / trial).mkdir()
        (tmp_path / trial / "checkpoint_000001").symlink_to(zoo / "pendulum")
    with pytest.raises(CheckpointError, match=r"holds 2 trials with checkpoints \(a, b\)"):
        locate_checkpoint(tmp_path)
    (tmp_path / "b" / "checkpoint_000001").unlink()
    assert locate_checkpoint(tmp_path).root == tmp_path / "a" / "checkpoint_000001"


def test_several_modules_are_not_guessed_between(copy_of: Callable[[str], Path]) -> None:
    damaged = copy_of("pendulum")
    (damaged / MODULE).parent.joinpath("other").symlink_to(damaged / MODULE)
    with pytest.raises(CheckpointError, match=r"holds 2 modules \(default_policy, other\): name the one to export"):
        locate_checkpoint(damaged)
    assert locate_checkpoint(damaged, "other").module_id == "other"
    assert [files.module_id for files in locate_modules(damaged)] == ["default_policy", "other"]


def test_what_an_older_ray_wrote_is_refused_with_the_reason(copy_of: Callable[[str], Path], tmp_path: Path) -> None:
    (tmp_path / "old" / "learner" / "module_state" / "default_policy").mkdir(parents=True)
    with pytest.raises(UnsupportedError, match=r"as a Ray before 2\.33 wrote them .*; train again"):
        locate_checkpoint(tmp_path / "old")
    renamed = copy_of("pendulum")
    (renamed / MODULE / "module_state.pkl").rename(renamed / MODULE / "state.pkl")
    with pytest.raises(UnsupportedError, match=r"weights in state\.pkl, .*train again with a later Ray"):
        locate_checkpoint(renamed)


def test_the_hash_covers_weights_filter_and_scaling(zoo: Path, copy_of: Callable[[str], Path]) -> None:
    damaged = copy_of("pendulum")
    original = locate_checkpoint(zoo / "pendulum").sha256()
    assert locate_checkpoint(damaged).sha256() == original
    (damaged / "algorithm_state.pkl").unlink()  # not part of the policy
    assert locate_checkpoint(damaged).sha256() == original
    (damaged / "env_runner/env_to_module_connector/MeanStdFilter/state.pkl").write_bytes(b"other")
    assert locate_checkpoint(damaged).sha256() != original


@pytest.mark.parametrize(
    "file",
    [
        f"{MODULE}/module_state.pkl",
        f"{MODULE}/class_and_ctor_args.pkl",
        "env_runner/env_to_module_connector/class_and_ctor_args.pkl",
        "env_runner/env_to_module_connector/MeanStdFilter/state.pkl",
        "env_runner/module_to_env_connector/class_and_ctor_args.pkl",
    ],
)
def test_a_truncated_pickle_is_named(copy_of: Callable[[str], Path], notices: list[str], file: str) -> None:
    damaged = copy_of("pendulum")
    whole = (damaged / file).read_bytes()
    (damaged / file).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=r"truncated or damaged") as caught:
        restore(locate_checkpoint(damaged), Path(), notices.append)
    assert str(damaged) in caught.value.message


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        (f"{MODULE}/module_state.pkl", "module_state.pkl .the weights."),
        ("env_runner/module_to_env_connector/class_and_ctor_args.pkl", "the action scaling"),
    ],
)
def test_a_missing_file_is_named_with_what_it_held(copy_of: Callable[[str], Path], missing: str, words: str) -> None:
    damaged = copy_of("pendulum")
    (damaged / missing).unlink()
    with pytest.raises(CheckpointError, match=words):
        locate_checkpoint(damaged)


def test_a_lost_filter_state_is_refused_and_not_replaced_by_an_empty_filter(
    copy_of: Callable[[str], Path], notices: list[str]
) -> None:
    damaged = copy_of("pendulum")
    folder = damaged / "env_runner/env_to_module_connector/MeanStdFilter"
    folder.rename(damaged / "elsewhere")
    with pytest.raises(CheckpointError, match="the observation filter's statistics"):
        restore(locate_checkpoint(damaged), Path(), notices.append)


def rewrite_weights(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / MODULE / "module_state.pkl"
    state = pickle.loads(file.read_bytes())
    change(state)
    file.write_bytes(pickle.dumps(state))


def test_missing_weights_of_the_policy_are_refused_and_not_left_random(
    copy_of: Callable[[str], Path], notices: list[str]
) -> None:
    damaged = copy_of("pendulum")
    rewrite_weights(damaged, lambda state: state.pop("pi.net.mlp.0.weight"))
    with pytest.raises(CheckpointError, match=r"lacks weights .* pi\.net\.mlp\.0\.weight"):
        restore(locate_checkpoint(damaged), Path(), notices.append)


def test_without_the_critics_weights_there_is_no_value_output_and_a_notice(
    copy_of: Callable[[str], Path], notices: list[str]
) -> None:
    damaged = copy_of("pendulum")

    def drop_critic(state: dict[str, Any]) -> None:
        for key in [key for key in state if key.startswith(("vf.", "encoder.critic_encoder."))]:
            del state[key]

    rewrite_weights(damaged, drop_critic)
    assert restore(locate_checkpoint(damaged), Path(), notices.append).network.names == ("action_dist_inputs",)
    assert "no value head" in " ".join(notices)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_refused(
    copy_of: Callable[[str], Path], notices: list[str], number: float
) -> None:
    damaged = copy_of("pendulum")
    rewrite_weights(damaged, lambda state: np.copyto(state["pi.net.mlp.0.bias"], number))
    with pytest.raises(CheckpointError, match="training diverged"):
        restore(locate_checkpoint(damaged), Path(), notices.append)


def test_a_part_that_another_ray_wrote_and_this_one_cannot_read_says_so(copy_of: Callable[[str], Path]) -> None:
    damaged = copy_of("clipped")
    pipeline = damaged / "env_runner" / "env_to_module_connector"
    written = json.loads((pipeline / "metadata.json").read_text())
    (pipeline / "metadata.json").write_text(json.dumps({**written, "ray_version": "2.44.1"}))
    (pipeline / "class_and_ctor_args.pkl").write_bytes(pickle.dumps({"class": dict, "ctor_args_and_kwargs": ((), {})}))
    with pytest.raises(CheckpointError, match=r"Ray 2\.44\.1 wrote it and this is Ray .*: export with Ray 2"):
        restore(locate_checkpoint(damaged), Path(), lambda _: None)


def test_modules_saved_together_are_taken_one_by_one(wide_zoo: Path, tmp_path: Path, app: Path) -> None:
    together = tmp_path / "together"
    shutil.copytree(wide_zoo / "team" / "learner_group" / "learner" / "rl_module", together)
    with pytest.raises(CheckpointError, match=r"holds 2 modules \(arms, wheels\): name the one to export"):
        locate_checkpoint(together)
    with pytest.raises(CheckpointError, match="has no module 'legs': it holds arms, wheels"):
        locate_checkpoint(together, "legs")
    assert locate_checkpoint(together, "wheels").module == together / "wheels"  # type: ignore[union-attr]
    assert [files.module_id for files in locate_modules(together)] == ["arms", "wheels"]
