"""The whole path: checkpoint to bundle, against what environments saw in RLlib's own rollouts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from rlservo.bundle import bundle
from rlservo.bundle.bundle import load_bundle, write_contract
from rlservo.bundle.contract import contract_json
from rlservo.bundle.spaces import DiscreteSpec
from rlservo.errors import (
    BundleTamperedError,
    CheckpointError,
    RlservoError,
    UnsupportedError,
    UsageError,
)
from rlservo.export.bundle_names import default_name
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.graph.onnx_file import run_onnx
from rlservo.export.graph.torchscript_file import run_torchscript
from rlservo.export.proof import differences
from rlservo.policy.policy import Policy

EXPORTED = [
    "pendulum", "cart_pole", "clipped", "shared", "free_std", "relu", "unbounded", "mixed", "half_bounded", "double",
    "started", "offset", "grid", "sac", "dqn", "appo", "user_module",
]  # fmt: skip


@pytest.mark.parametrize("name", EXPORTED)
def test_an_export_acts_as_rllib_did_in_its_own_rollout(
    zoo: Path, exported: Callable[..., ExportResult], name: str
) -> None:
    result = exported(zoo / name)
    seen = np.load(zoo / f"{name}.npz")
    assert len(seen["obs"]) >= 90
    outputs = tuple(output.name for output in result.contract.outputs)
    for run in (run_onnx(result.path / "policy.onnx"), run_torchscript(result.path / "policy.ts", ["obs"], outputs)):
        action = run({"obs": seen["obs"]})["action"]
        if result.contract.action_space.kind == "discrete":
            assert action.dtype == np.int64
            np.testing.assert_array_equal(action, seen["action"])
        else:
            assert action.dtype == result.contract.action_space.dtype
            np.testing.assert_allclose(action, seen["action"], rtol=1e-5, atol=2e-6)


def test_a_bundle_says_what_went_in(zoo: Path, tmp_path: Path, notices: list[str]) -> None:
    result = export_checkpoint(zoo / "pendulum", tmp_path, description="swings up", notify=notices.append)
    assert result.path == tmp_path / "pendulum" / "1"
    contract = load_bundle(result.path).contract
    assert contract == result.contract
    assert (contract.name, contract.version, contract.description) == ("pendulum", "1", "swings up")
    assert [(tensor.name, tensor.dtype, tensor.shape) for tensor in contract.outputs] == [
        ("action", "float32", (-1, 1)),
        ("action_dist_inputs", "float32", (-1, 2)),
        ("value", "float32", (-1,)),
    ]
    assert [step.step for step in contract.baked_in] == ["mean_std_filter", "network", "mode", "unsquash"]
    assert contract.baked_in[0].values["count"] > 100
    assert contract.distribution is not None
    assert (contract.distribution.kind, contract.distribution.transform) == ("diag_gaussian", "unsquash")
    origin = contract.provenance
    assert (origin.algorithm, origin.env_id, origin.training_iterations) == ("PPO", "Pendulum-v1", 1)
    assert origin.env_steps is not None and origin.env_steps >= 128
    assert contract.parity.samples > 700 and set(contract.parity.formats) == {"onnx", "torchscript"}
    assert "run code when loaded" in " ".join(notices)
    assert {file.name for file in result.path.iterdir()} == {
        "policy.onnx",
        "policy.ts",
        "contract.json",
        "golden.npz",
        "SHA256SUMS",
    }


def test_the_onnx_file_carries_names_a_dynamic_batch_and_the_contract(
    zoo: Path, exported: Callable[..., ExportResult]
) -> None:
    result = exported(zoo / "mixed")
    model = onnx.load(str(result.path / "policy.onnx"))
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version <= 18 and model.ir_version <= 8
    assert {entry.key: entry.value for entry in model.metadata_props} == {
        "rlservo.contract": contract_json(result.contract)
    }
    session = onnxruntime.InferenceSession(str(result.path / "policy.onnx"), providers=["CPUExecutionProvider"])
    assert [tensor.shape for tensor in session.get_inputs()] == [["batch", 5]]
    assert [tensor.name for tensor in session.get_outputs()] == ["action", "action_dist_inputs", "value"]
    run = run_onnx(result.path / "policy.onnx")
    for size in (1, 2, 3, 1024):
        assert run({"obs": np.zeros((size, 5), np.float32)})["action"].shape == (size, 3)


def test_golden_vectors_are_finite_and_reproduced(zoo: Path, exported: Callable[..., ExportResult]) -> None:
    result = exported(zoo / "pendulum")
    inputs, outputs = load_bundle(result.path).golden()
    assert inputs["obs"].shape == (64, 3) and set(outputs) == {"action", "action_dist_inputs", "value"}
    assert all(np.isfinite(values).all() for values in (*inputs.values(), *outputs.values()))
    assert len(np.unique(outputs["action"])) > 10
    replayed = run_onnx(result.path / "policy.onnx")(inputs)
    for name, values in outputs.items():
        np.testing.assert_array_equal(replayed[name], values)


def test_versions_count_up_and_are_never_overwritten(zoo: Path, tmp_path: Path, notices: list[str]) -> None:
    first = export_checkpoint(zoo / "cart_pole", tmp_path, name="balance", version="7", notify=notices.append)
    second = export_checkpoint(zoo / "cart_pole", tmp_path, name="balance", notify=notices.append)
    assert (first.path.name, second.path.name) == ("7", "8")
    with pytest.raises(UsageError, match=r"balance/7 already exists"):
        export_checkpoint(zoo / "cart_pole", tmp_path, name="balance", version="7", notify=notices.append)


def test_an_edited_contract_with_valid_hashes_is_refused_at_load(
    zoo: Path, exported_copy: Callable[[Path], ExportResult]
) -> None:
    result = exported_copy(zoo / "pendulum")
    space = result.contract.action_space
    assert space.kind == "box"
    wider = space.model_copy(update={"low": -200.0, "high": 200.0})  # a robot would be let through
    write_contract(result.path, result.contract.model_copy(update={"action_space": wider}))
    with pytest.raises(BundleTamperedError, match="has been edited since the export: its 'action_space' is not what"):
        Policy.load(result.path)
    write_contract(result.path, result.contract)
    Policy.load(result.path)


def test_a_contract_is_replaced_whole_or_not_at_all(
    zoo: Path, exported_copy: Callable[[Path], ExportResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    result = exported_copy(zoo / "cart_pole")
    before = {file.name: file.read_bytes() for file in result.path.iterdir()}

    def full(_path: Path) -> str:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(bundle, "sha256", full)  # after the new contract has been written, before its hash
        with pytest.raises(OSError, match="No space left"):
            write_contract(result.path, result.contract.model_copy(update={"description": "another"}))
    assert {file.name: file.read_bytes() for file in result.path.iterdir()} == before


def test_the_value_head_can_be_left_out(zoo: Path, tmp_path: Path, notices: list[str]) -> None:
    result = export_checkpoint(zoo / "pendulum", tmp_path, value=False, notify=notices.append)
    assert [tensor.name for tensor in result.contract.outputs] == ["action", "action_dist_inputs"]


def test_a_discrete_space_that_starts_elsewhere_is_told(
    zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    result = export_checkpoint(zoo / "started", tmp_path, app_dir=app, notify=notices.append)
    assert set(np.load(zoo / "started.npz")["action"]) <= {0, 1, 2}  # what RLlib sent, in a space of 5, 6, 7
    assert result.contract.action_space == DiscreteSpec(n=3, start=0)
    assert "RLlib sends 0..2" in " ".join(notices)


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("user_connector", UnsupportedError, "connector Doubler"),
        ("batch_reader", UnsupportedError, "depends on the other observations of the batch"),
    ],
)
def test_what_cannot_be_exported_is_refused_by_name_and_leaves_nothing(
    zoo: Path, app: Path, tmp_path: Path, notices: list[str], name: str, error: type[RlservoError], words: str
) -> None:
    out = tmp_path / "out"
    with pytest.raises(error, match=words):
        export_checkpoint(zoo / name, out, app_dir=app, notify=notices.append)
    assert not out.exists()


def test_an_interrupt_leaves_nothing(
    zoo: Path, tmp_path: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_args: object, **_kwargs: object) -> None:
        assert any(folder.name.startswith(".export-") for folder in (tmp_path / "out" / "pendulum").iterdir())
        raise KeyboardInterrupt

    monkeypatch.setattr("rlservo.export.export_checkpoint.prove", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_checkpoint(zoo / "pendulum", tmp_path / "out", notify=notices.append)
    assert not (tmp_path / "out").exists()


def test_a_failed_export_leaves_earlier_versions_alone(
    zoo: Path, tmp_path: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = export_checkpoint(zoo / "pendulum", tmp_path, notify=notices.append)
    for name in ("RTOL", "ATOL", "LAST_BITS", "ROUNDING"):
        monkeypatch.setattr(differences, name, 0.0)
    with pytest.raises(UnsupportedError):
        export_checkpoint(zoo / "pendulum", tmp_path, notify=notices.append)
    assert [folder.name for folder in (tmp_path / "pendulum").iterdir()] == ["1"]
    assert load_bundle(first.path).contract == first.contract


# In a process of its own, of both API stacks: here other tests may have imported the user's modules, filled RLlib's
# registry, or started a Ray. One process for all of it: to import RLlib takes longer than the exports.
EXPORTS = """
import json, subprocess, sys
import gymnasium
def refuse(*a, **k): raise AssertionError('started')
subprocess.Popen.__init__ = refuse
gymnasium.make = refuse
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.errors import CheckpointError
zoo, old_zoo, app, empty = sys.argv[1:]
# Whatever else comes before it on the import path, as a class of the checkpoint's may bring.
def disturb(step): sys.path.insert(0, empty)
def export(checkpoint, **how):
    try:
        result = export_checkpoint(checkpoint, empty + '/out', notify=lambda line: None, **how)
    except CheckpointError as error:
        return f'refused: {error}'
    return f'module: {result.contract.provenance.module_class}'
for checkpoint in (zoo + '/pendulum', old_zoo + '/sac'):
    export(checkpoint)
import ray, psutil
found = {'started': [ray.is_initialized(), [p.name() for p in psutil.Process().children(recursive=True)]]}
found['empty user_module'] = export(zoo + '/user_module', app_dir=empty)
before = list(sys.path)
found['app user_module'] = export(zoo + '/user_module', app_dir=app)
found['same path'] = sys.path == before
for name in ('user_model', 'named_model'):
    for folder, path in (('empty', empty), ('app', app)):
        found[f'{folder} {name}'] = export(old_zoo + '/' + name, app_dir=path, progress=disturb)
print(json.dumps(found))
"""


@dataclass(frozen=True)
class Process:
    found: dict[str, Any]
    empty: Path
    home: Path


@pytest.fixture(scope="module")
def alone(zoo: Path, old_zoo: Path, app: Path, tmp_path_factory: pytest.TempPathFactory) -> Process:
    """The result of EXPORTS, and its folders."""
    home, empty = tmp_path_factory.mktemp("home"), tmp_path_factory.mktemp("empty")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", EXPORTS, *map(str, (zoo, old_zoo, app, empty))],
        capture_output=True, text=True, timeout=300, env={**os.environ, "HOME": str(home)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return Process(json.loads(done.stdout), empty, home)


def test_the_users_own_code_is_found_in_the_app_dir_and_only_there(alone: Process) -> None:
    refused = alone.found["empty user_module"]
    assert "the Python module 'zoo_parts'" in refused and str(alone.empty) in refused and "--app-dir" in refused
    assert alone.found["app user_module"] == "module: zoo_parts.UserModule"
    assert alone.found["same path"]


def test_the_users_own_old_models_are_found_in_the_app_dir_and_only_there(alone: Process) -> None:
    by_class, by_name = (alone.found[f"empty {name}"] for name in ("user_model", "named_model"))
    assert "the Python module 'old_zoo_parts'" in by_class and str(alone.empty) in by_class and "--app-dir" in by_class
    assert alone.found["app user_model"] == "module: old_zoo_parts.OldModel"
    assert "'named_model'" in by_name and str(alone.empty) in by_name and "--app-dir" in by_name
    assert alone.found["app named_model"] == "module: old_zoo_parts.OldNamedModel"


def test_an_export_of_either_stack_starts_no_ray_no_environment_and_no_process(alone: Process) -> None:
    assert alone.found["started"] == [False, []]
    assert not (alone.home / ".ray").exists()


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("rlservo/EndEffectorPositioningURSim-v0", "end-effector-positioning-ur"),
        ("rlservo/NoObstacleNavigationMir100Sim-v0", "no-obstacle-navigation-mir100"),
        ("CartPole-v1", "cart-pole"),
        ("my.package:ReachEnv", "reach"),
        ("Env-v0", "env"),
    ],
)
def test_a_policy_is_named_after_its_environment(env_id: str, name: str) -> None:
    assert default_name(env_id, {}, Path("anything")) == name
    assert default_name("rlservo/Randomized-v0", {"env_id": env_id}, Path("anything")) == name


def test_without_an_environment_a_policy_is_named_after_its_folder() -> None:
    assert default_name(None, {}, Path("/runs/checkpoint_000003")) == "checkpoint-000003"


def test_names_and_versions_that_cannot_be_used_are_refused_before_anything_is_loaded(
    zoo: Path, tmp_path: Path, notices: list[str]
) -> None:
    for name, version in (("../up", None), (None, "v1"), (None, "0")):
        with pytest.raises(UsageError):
            export_checkpoint(zoo / "pendulum", tmp_path, name=name, version=version, notify=notices.append)
    assert notices == []
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        export_checkpoint(zoo / "pendulum", tmp_path / "file", notify=notices.append)


def test_a_trial_folder_means_its_newest_checkpoint(zoo: Path, tmp_path: Path, notices: list[str]) -> None:
    trial = tmp_path / "trial"
    trial.mkdir()
    (trial / "checkpoint_000002").symlink_to(zoo / "cart_pole")
    (trial / "checkpoint_000010").symlink_to(zoo / "pendulum")
    result = export_checkpoint(trial, tmp_path / "out", notify=notices.append)
    assert result.contract.provenance.env_id == "Pendulum-v1"
    with pytest.raises(CheckpointError, match="has no module 'other'"):
        export_checkpoint(trial, tmp_path / "out", module_id="other", notify=notices.append)
