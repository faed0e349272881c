"""The old API stack: checkpoint to bundle, against what environments saw in RLlib's own evaluation."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from numpy.typing import NDArray
from ray.rllib.connectors.agent.obs_preproc import ObsPreprocessorConnector
from ray.rllib.connectors.agent.pipeline import AgentConnectorPipeline
from ray.rllib.connectors.agent.state_buffer import StateBufferConnector
from ray.rllib.connectors.connector import ConnectorContext
from ray.rllib.models.preprocessors import get_preprocessor
from ray.rllib.policy.sample_batch import SampleBatch

from rlservo.bundle.bundle import load_bundle
from rlservo.bundle.contract import Parity
from rlservo.errors import CheckpointError, ParityError, RequestError, RlservoError, UnsupportedError
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import ExportResult, comparer_of, export_checkpoint
from rlservo.export.graph.onnx_file import run_onnx, write_onnx
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.torchscript_file import run_torchscript
from rlservo.export.proof.parity import GraphLoop, prove
from rlservo.export.proof.references import record
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.export.recipe.recipe import ObservationFilter, Preprocess, Recipe, StateLeaf
from rlservo.export.recipe.runners import Loop, first_step
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.rllib.old_stack.connectors import read_old_steps
from rlservo.export.rllib.old_stack.custom_models import Registration, find_registrations
from rlservo.export.rllib.restore import restore
from rlservo.export.sources.restored_policy import RestoredPolicy
from rlservo.export.verify_bundle import verify_bundle
from rlservo.policy.policy import Policy

STATE = "policies/default_policy/policy_state.pkl"
EXPORTED = [
    "pendulum", "cart_pole", "clipped", "shared", "free_std", "no_critic", "concurrent", "unbounded", "half_bounded",
    "mixed", "double", "started", "grid", "beams", "filtered_beams", "picture", "offset", "dqn", "plain_dqn",
    "distributional_dqn", "sac", "unnormalized_sac", "discrete_sac", "appo", "impala", "marwil", "cloned", "cql",
    "user_model", "bearing", "named_model", "lstm", "continuous_lstm", "user_recurrent", "choice", "shifted", "dials",
    "nested", "filtered_nested", "camera", "levers", "limbs", "masked", "named_distribution", "tempered", "counts",
    "gauge",
]  # fmt: skip
SEVERAL = ["several_arm", "several_cart"]


@pytest.fixture
def load(old_zoo: Path, app: Path, notices: list[str]) -> Callable[..., RestoredPolicy]:
    def load(name: str, folder: Path = old_zoo) -> RestoredPolicy:
        checkpoint, _, policy = name.partition("_") if name in SEVERAL else (name, "", None)
        files = locate_checkpoint(folder / checkpoint, policy)
        assert isinstance(files, OldStackFiles)
        with user_code(app):
            return restore(files, app, notices.append)

    return load


@pytest.fixture
def export(old_zoo: Path, app: Path, tmp_path: Path, notices: list[str]) -> Callable[..., ExportResult]:
    def export(name: str, **how: Any) -> ExportResult:
        checkpoint, _, policy = name.partition("_") if name in SEVERAL else (name, "", None)
        how = {"app_dir": app, "module_id": policy, "notify": notices.append, **how}
        return export_checkpoint(old_zoo / checkpoint, tmp_path / "out", **how)

    return export


@pytest.fixture
def kept(old_zoo: Path, exported: Callable[..., ExportResult]) -> Callable[[str], ExportResult]:
    """Return a function that gives the export of a checkpoint, made once. Its files are not to be written to."""

    def kept(name: str) -> ExportResult:
        checkpoint, _, policy = name.partition("_") if name in SEVERAL else (name, "", None)
        return exported(old_zoo / checkpoint, policy)

    return kept


@pytest.fixture
def old_copy(old_zoo: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies a checkpoint to where a test may damage it."""
    return lambda name: Path(shutil.copytree(old_zoo / name, tmp_path / "damaged" / name))


def rewrite(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    state = pickle.loads(file.read_bytes())
    change(state)
    file.write_bytes(pickle.dumps(state))


def drive(loop: Loop, seen: Mapping[str, NDArray[Any]], rows: int | None = None) -> dict[str, NDArray[Any]]:
    """Return a loop's actions for what the environment saw: step by step, or, without a memory, all at once."""
    obs = {name: values for name, values in seen.items() if name.startswith("obs")}
    restart = seen["restart"].copy()
    if rows is None:
        return loop.step(obs, np.ones(len(restart), np.bool_))
    restart[0] = True
    steps = [
        loop.step({name: values[t : t + 1] for name, values in obs.items()}, restart[t : t + 1]) for t in range(rows)
    ]
    return {name: np.concatenate([step[name] for step in steps]) for name in steps[0]}


def spec_leaves(space: Any, name: str) -> dict[str, Any]:
    """Return the contract's leaf spaces by name."""
    inside = getattr(space, "spaces", None)
    if inside is None:
        return {name: space}
    children = inside.items() if isinstance(inside, dict) else enumerate(inside)
    return {path: leaf for key, child in children for path, leaf in spec_leaves(child, f"{name}.{key}").items()}


def test_parts_whose_order_the_environment_decides_are_refused() -> None:
    parts = [("wheels", Box(-1.0, 1.0, (2,), np.float32)), ("arm", Box(-1.0, 1.0, (2,), np.float32))]
    obs = {"wheels": np.zeros(2, np.float32), "arm": np.ones(2, np.float32)}
    for space, refused in ((Dict(parts), True), (Dict(sorted(parts)), False)):
        preprocessor = get_preprocessor(space)(space)
        assert list(preprocessor.transform(obs)) == [1.0, 1.0, 0.0, 0.0]
        assert list(preprocessor.transform(OrderedDict(obs))) == [0.0, 0.0, 1.0, 1.0]
        context = ConnectorContext(config={}, observation_space=preprocessor.observation_space)
        pieces = AgentConnectorPipeline(context, [ObsPreprocessorConnector(context)])
        with pytest.raises(UnsupportedError, match="not in sorted order") if refused else nullcontext():
            assert len(read_old_steps(pieces)) == 1


def assert_same_actions(got: Mapping[str, NDArray[Any]], seen: Mapping[str, NDArray[Any]]) -> None:
    names = [name for name in seen if name.startswith("action")]
    assert names
    for name in names:
        expected = seen[name][: len(got[name])]
        if expected.dtype.kind == "i":
            np.testing.assert_array_equal(got[name], expected)
        else:
            np.testing.assert_allclose(got[name], expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("name", [*EXPORTED, *SEVERAL])
def test_an_old_stack_export_acts_as_rllib_did_in_its_own_evaluation(
    old_zoo: Path, kept: Callable[[str], ExportResult], name: str
) -> None:
    contract, path = (result := kept(name)).contract, result.path
    assert contract.provenance.api_stack == "old"
    seen = dict(np.load(old_zoo / f"{name}.npz"))
    names = [tuple(tensor.name for tensor in side) for side in (contract.inputs, contract.outputs)]
    state = [StateLeaf(leaf.name, np.full(leaf.shape, leaf.initial, leaf.dtype)) for leaf in contract.state]
    for run in (run_onnx(path / "policy.onnx"), run_torchscript(path / "policy.ts", *names)):
        got = drive(GraphLoop(run, state), seen, rows=len(seen["restart"]) if state else None)
        assert_same_actions(got, seen)
        for action, space in spec_leaves(contract.action_space, "action").items():
            assert str(got[action].dtype) == space.dtype


@pytest.mark.parametrize("name", [*EXPORTED, *SEVERAL])
def test_the_reference_is_what_the_environment_saw(
    old_zoo: Path, load: Callable[..., RestoredPolicy], name: str
) -> None:
    seen = dict(np.load(old_zoo / f"{name}.npz"))
    restored = load(name)
    # One by one in the evaluation, together here where there is no memory: sums may come in another order.
    assert_same_actions(drive(restored.start_loop(), seen, rows=45 if restored.recipe.state else None), seen)


@pytest.mark.parametrize("name", ["pendulum", "sac"])
def test_compute_single_action_is_not_what_the_environment_sees(
    old_zoo: Path, load: Callable[..., RestoredPolicy], name: str
) -> None:
    seen = np.load(old_zoo / f"{name}.npz")
    loop: Any = load(name).start_loop()
    policy = loop.policy
    alone = np.stack([policy.compute_single_action(obs, explore=False)[0] for obs in seen["obs"]])
    assert np.abs(alone - seen["action"]).max() > 1e-3  # no filter, no unsquashing


def test_an_old_stack_bundle_says_what_went_in(export: Callable[..., ExportResult], notices: list[str]) -> None:
    contract = export("pendulum", description="swings up").contract
    assert [step.step for step in contract.baked_in] == ["mean_std_filter", "network", "mode", "unsquash"]
    assert contract.baked_in[0].values["count"] > 60 and contract.baked_in[0].values["clip"] is None
    assert [output.name for output in contract.outputs] == ["action", "action_dist_inputs", "value"]
    assert "compute_actions_from_input_dict" in contract.parity.reference and contract.parity.samples > 700
    origin = contract.provenance
    assert (origin.algorithm, origin.env_id, origin.training_iterations, origin.env_steps) == (
        "PPO", "Pendulum-v1", 1, 64,
    )  # fmt: skip
    assert (origin.module_id, origin.ray_version) == ("default_policy", origin.ray_version)
    assert origin.module_class == "ray.rllib.models.torch.fcnet.FullyConnectedNetwork"
    assert "run code when loaded" in " ".join(notices)


def test_the_two_filters_of_the_old_stack_clip_differently(load: Callable[..., RestoredPolicy]) -> None:
    frozen = {name: load(name).recipe.filter for name in ("pendulum", "concurrent")}
    assert all(one is not None for one in frozen.values())
    assert {name: one.clip for name, one in frozen.items() if one} == {"pendulum": None, "concurrent": 10.0}


@pytest.mark.parametrize(
    ("name", "distribution", "mode", "transform", "names"),
    [
        ("pendulum", "diag_gaussian", "mean", "unsquash", ("action_dist_inputs", "value")),
        ("clipped", "diag_gaussian", "mean", "clip", ("action_dist_inputs", "value")),
        ("half_bounded", "diag_gaussian", "mean", "clip", ("action_dist_inputs", "value")),
        ("unbounded", "diag_gaussian", "mean", "none", ("action_dist_inputs", "value")),
        ("sac", "squashed_gaussian", "tanh_mean", "unsquash", ("action_dist_inputs",)),
        ("unnormalized_sac", "diag_gaussian", "mean", "clip", ("action_dist_inputs",)),
        ("discrete_sac", "categorical", "argmax", "none", ("action_dist_inputs",)),
        ("cql", "squashed_gaussian", "tanh_mean", "unsquash", ("action_dist_inputs",)),
        ("dqn", None, "argmax", "none", ("q_values",)),
        ("plain_dqn", None, "argmax", "none", ("q_values",)),
        ("marwil", "diag_gaussian", "mean", "unsquash", ("action_dist_inputs", "value")),
        ("cloned", "categorical", "argmax", "none", ("action_dist_inputs",)),
        ("no_critic", "categorical", "argmax", "none", ("action_dist_inputs",)),
    ],
)
def test_the_action_rule_is_the_policys_own(
    load: Callable[..., RestoredPolicy],
    name: str,
    distribution: str | None,
    mode: str,
    transform: str,
    names: tuple[str, ...],
) -> None:
    restored = load(name)
    recipe = restored.recipe
    assert (recipe.distribution, recipe.mode, recipe.transform) == (distribution, mode, transform)
    assert restored.network.names == names


@pytest.mark.parametrize(("name", "states", "initial"), [("lstm", ["h", "c"], 0.0), ("user_recurrent", ["0"], 0.25)])
def test_a_recurrent_models_state_goes_in_and_out_and_begins_as_the_model_says(
    kept: Callable[[str], ExportResult], name: str, states: list[str], initial: float
) -> None:
    contract = kept(name).contract
    assert [(leaf.name, leaf.shape, leaf.initial) for leaf in contract.state] == [
        (one, (8,), initial) for one in states
    ]
    assert [tensor.name for tensor in contract.inputs] == ["obs", *(f"state_in.{one}" for one in states)]


def test_swapped_recurrent_states_are_caught(load: Callable[..., RestoredPolicy], tmp_path: Path) -> None:
    restored = load("lstm")
    h, c = restored.recipe.network_state
    with pytest.raises(ParityError):
        prove_as(restored, dataclasses.replace(restored.recipe, network_state=(c, h)), tmp_path)


def test_one_hot_codes_count_from_the_spaces_start(load: Callable[..., RestoredPolicy], tmp_path: Path) -> None:
    restored = load("shifted")  # Discrete(4, start=3)
    told_wrong = (Preprocess(Discrete(4)), *restored.recipe.steps[1:])
    with pytest.raises(ParityError):
        prove_as(restored, dataclasses.replace(restored.recipe, steps=told_wrong), tmp_path)


def test_a_value_head_that_nothing_trained_is_left_out_with_a_notice(
    load: Callable[..., RestoredPolicy], notices: list[str]
) -> None:
    load("cloned")
    load("no_critic")
    assert "with beta=0 training leaves the value head as it is" in " ".join(notices)
    assert "with use_critic=False training leaves the value head as it is" in " ".join(notices)


def test_a_scan_of_128_beams_is_rescaled_as_rllib_takes_it_for_an_ataris_memory(
    load: Callable[..., RestoredPolicy], kept: Callable[[str], ExportResult], tmp_path: Path
) -> None:
    result = kept("filtered_beams")
    assert [step.step for step in result.contract.baked_in][:2] == ["rescale", "mean_std_filter"]
    restored = load("beams")
    assert [type(step) for step in restored.recipe.steps] == [Preprocess]
    with pytest.raises(ParityError):
        prove_as(restored, dataclasses.replace(restored.recipe, steps=()), tmp_path)


def prove_as(restored: RestoredPolicy, recipe: Recipe, tmp_path: Path) -> Parity:
    """Prove a graph built from `recipe` against RLlib's own pipeline of `restored`."""
    graph = PolicyGraph(recipe, restored.network)
    references = record(restored.start_loop, draw_batches(restored.recipe, seed=3))
    last = references[-1].batch
    example = GraphLoop(lambda inputs: inputs, recipe.state).complete(last.inputs, np.ones(len(last), np.bool_))
    write_onnx(graph, example, tmp_path / "policy.onnx")
    comparer = comparer_of(restored, graph, references)
    return prove(restored.recipe, references, {"onnx": run_onnx(tmp_path / "policy.onnx")}, (), "old", comparer)


@pytest.mark.parametrize("name", ["pendulum", "unbounded", "offset", "grid", "double", "sac", "filtered_beams"])
def test_a_dropped_old_stack_filter_is_caught(load: Callable[..., RestoredPolicy], tmp_path: Path, name: str) -> None:
    restored = load(name)
    steps = tuple(step for step in restored.recipe.steps if not isinstance(step, ObservationFilter))
    assert steps != restored.recipe.steps
    with pytest.raises(ParityError):
        prove_as(restored, dataclasses.replace(restored.recipe, steps=steps), tmp_path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("mixed", {"transform": "clip"}),
        ("clipped", {"transform": "unsquash"}),
        ("half_bounded", {"transform": "none"}),
        ("sac", {"mode": "mean"}),
    ],
)
def test_a_wrong_old_stack_action_rule_is_caught(
    load: Callable[..., RestoredPolicy], tmp_path: Path, name: str, change: dict[str, str]
) -> None:
    restored = load(name)
    if name == "half_bounded":  # actions of a fresh network are small: move one below its bound
        loop: Any = restored.start_loop()
        for model in (restored.network.module, loop.policy.model):
            model._logits._model[0].bias[0] = -1.0
    with pytest.raises(ParityError, match="output 'action'"):
        prove_as(restored, dataclasses.replace(restored.recipe, **change), tmp_path)  # type: ignore[arg-type]


def test_a_clip_the_filter_does_not_have_is_caught(load: Callable[..., RestoredPolicy], tmp_path: Path) -> None:
    restored = load("pendulum")
    frozen = restored.recipe.filter
    assert frozen is not None and frozen.clip is None
    clipped = dataclasses.replace(restored.recipe, steps=(dataclasses.replace(frozen, clip=10.0),))
    with pytest.raises(ParityError, match=r"output 'action(_dist_inputs)?'"):
        prove_as(restored, clipped, tmp_path)


def test_the_old_stack_reference_does_not_drift(load: Callable[..., RestoredPolicy]) -> None:
    restored = load("pendulum")
    inputs = {"obs": np.array([[0.1, 0.9, 3.0]], np.float32)}
    before = first_step(restored.start_loop(), inputs)
    for batch in draw_batches(restored.recipe, seed=5):  # some far outside the space
        first_step(restored.start_loop(), batch.inputs)
    for name, values in first_step(restored.start_loop(), inputs).items():
        np.testing.assert_array_equal(values, before[name])


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("attention", UnsupportedError, r"AttentionWrapper of policy PPOTorchPolicy .*\('state_in_0', shift -50:-1\)"),
        ("previous_lstm", UnsupportedError, r"LSTMWrapper of policy PPOTorchPolicy .*\('prev_actions', shift -1\)"),
        ("noisy_dqn", UnsupportedError, r"noisy layers \(noisy=True\)"),
        (
            "noisy_weights",
            UnsupportedError,
            "explores with ParameterNoise, and RLlib saves its weights with that moment's noise",
        ),
        (
            "previous_action",
            UnsupportedError,
            r"OldPreviousAction of policy PPOTorchPolicy .*\('prev_actions', shift -1",
        ),
        (
            "own_policy",
            UnsupportedError,
            r"OldOwnPolicy computes .* compute_actions_from_input_dict of its own \(old_zoo",
        ),
        ("clock_reader", UnsupportedError, r"OldClockReader reads 't' besides the observation"),
        ("clipped_limbs", UnsupportedError, r"parts that are unsquashed and parts that are only clipped"),
        ("batch_reader", UnsupportedError, "depends on the other observations of the batch"),
        ("several", CheckpointError, r"holds 2 policies \(arm, cart\): name the one to export with --module-id"),
    ],
)
def test_what_cannot_be_exported_of_the_old_stack_is_refused_by_name_and_leaves_nothing(
    export: Callable[..., ExportResult], tmp_path: Path, name: str, error: type[RlservoError], words: str
) -> None:
    with pytest.raises(error, match=words):
        export(name)
    assert not (tmp_path / "out").exists()


def test_an_algorithms_folder_its_policies_folder_and_a_trial_mean_the_same_policy(
    old_zoo: Path, tmp_path: Path, notices: list[str]
) -> None:
    whole = locate_checkpoint(old_zoo / "pendulum")
    assert locate_checkpoint(old_zoo / "pendulum" / "policies") == whole
    assert locate_checkpoint(old_zoo / "pendulum" / "policies" / "default_policy") == whole
    (tmp_path / "trial").mkdir()
    (tmp_path / "trial" / "checkpoint_000003").symlink_to(old_zoo / "pendulum")
    assert locate_checkpoint(tmp_path / "trial").sha256() == whole.sha256()
    inside = locate_checkpoint(old_zoo / "several" / "policies" / "cart")
    assert inside.module_id == "cart" and inside.root == old_zoo / "several"
    with pytest.raises(CheckpointError, match="has no policy 'leg': it holds arm, cart"):
        locate_checkpoint(old_zoo / "several", "leg")


def test_a_policys_folder_on_its_own_is_enough(old_zoo: Path, tmp_path: Path, notices: list[str]) -> None:
    alone = Path(shutil.copytree(old_zoo / "pendulum" / "policies" / "default_policy", tmp_path / "my_policy"))
    result = export_checkpoint(alone, tmp_path / "out", notify=notices.append)
    origin = result.contract.provenance
    assert (origin.algorithm, origin.env_id, origin.training_iterations) == ("PPO", "Pendulum-v1", None)
    assert (origin.module_id, result.contract.name) == ("my_policy", "pendulum")
    assert origin.checkpoint_sha256 == locate_checkpoint(old_zoo / "pendulum").sha256()


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda f: (f / "policy_state.msgpck").write_text("x"), UnsupportedError, "state as msgpack"),
        (lambda f: (f / "checkpoint-12").write_text("x"), UnsupportedError, "written by a Ray before 2.1"),
        (
            lambda f: (f / "rllib_checkpoint.json").write_text('{"checkpoint_version": "1.1"}'),
            CheckpointError,
            "this one holds no policy",
        ),
    ],
)
def test_what_is_no_readable_old_stack_checkpoint_is_said_in_one_sentence(
    tmp_path: Path, make: Callable[[Path], object], error: type[RlservoError], words: str
) -> None:
    make(tmp_path)
    with pytest.raises(error, match=words):
        locate_checkpoint(tmp_path)


def spec_of(state: dict[str, Any]) -> dict[str, Any]:
    return dict.__getitem__(state, "policy_spec")["config"]  # type: ignore[no-any-return]


def filter_of(state: dict[str, Any]) -> dict[str, Any]:
    return dict(state["connector_configs"]["agent"][1])["MeanStdObservationFilterAgentConnector"]  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (
            lambda state: spec_of(state).update(framework="tf2"),
            UnsupportedError,
            r"PPOTorchPolicy of .* written in tf2 \(TensorFlow\)",
        ),
        (
            lambda state: spec_of(state).update(enable_rl_module_and_learner=True),
            UnsupportedError,
            "an RLModule inside an old-stack policy",
        ),
        (
            lambda state: state.pop("connector_configs"),
            UnsupportedError,
            "holds no agent connectors, so it does not show what RLlib does to observations",
        ),
        (
            lambda state: state["connector_configs"]["action"][1].insert(1, ("MyActionDelay", None)),
            UnsupportedError,
            r"the action connector MyActionDelay \(after the network\)",
        ),
        (
            lambda state: state["connector_configs"]["action"][1].insert(1, ("ClipActionsConnector", None)),
            UnsupportedError,
            "ClipActionsConnector comes before NormalizeActionsConnector",
        ),
        (lambda state: state["weights"].pop("_logits._model.0.weight"), CheckpointError, "_logits._model.0.weight"),
        (
            lambda state: np.copyto(state["weights"]["_logits._model.0.bias"], np.nan),
            CheckpointError,
            "'_logits._model.0.bias' are not all finite: training diverged",
        ),
        (
            lambda state: filter_of(state)["running_stats"][0].pop("sum_sq_diff_array"),
            UnsupportedError,
            "the observation filter's statistics are in an unknown form",
        ),
        (
            lambda state: filter_of(state)["running_stats"][0].update(mean_array="eJyb"),
            CheckpointError,
            "policy_state.pkl cannot be restored",
        ),
        (lambda state: state.pop("policy_spec"), CheckpointError, "is not a policy's state"),
        (
            lambda state: spec_of(state)["model"].update(custom_model="unheard_of"),
            CheckpointError,
            r"names its custom model 'unheard_of' but does not hold the class: .*register_custom_model",
        ),
        (
            lambda state: spec_of(state)["model"].update(custom_action_dist="unheard_of"),
            CheckpointError,
            r"names its custom action distribution 'unheard_of' .*register_custom_action_dist\('unheard_of', \.\.\.\)",
        ),
    ],
)
def test_a_state_that_cannot_be_trusted_is_refused(
    old_copy: Callable[[str], Path],
    load: Callable[..., RestoredPolicy],
    change: Callable[[dict[str, Any]], object],
    error: type[RlservoError],
    words: str,
) -> None:
    damaged = old_copy("pendulum")
    rewrite(damaged / STATE, change)
    with pytest.raises(error, match=words):
        load("pendulum", damaged.parent)


def test_integer_actions_run_and_cannot_explore(old_zoo: Path, kept: Callable[[str], ExportResult]) -> None:
    policy, seen = Policy.load(kept("counts").path), np.load(old_zoo / "counts.npz")
    np.testing.assert_array_equal(policy.act(seen["obs"]), seen["action"])
    with pytest.raises(RequestError, match="explor"):
        policy.act(seen["obs"], explore=True)


def test_a_policys_own_folder_tells_its_facts_without_the_algorithm(
    old_zoo: Path, tmp_path: Path, notices: list[str]
) -> None:
    alone = Path(shutil.copytree(old_zoo / "pendulum" / "policies" / "default_policy", tmp_path / "lone"))
    provenance = export_checkpoint(alone, tmp_path / "out", notify=notices.append).contract.provenance
    assert (provenance.algorithm, provenance.env_id, provenance.api_stack) == ("PPO", "Pendulum-v1", "old")


def test_what_a_users_constructor_lacks_is_not_called_a_damaged_file(
    load: Callable[..., RestoredPolicy], app: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(app)
    import old_zoo_parts  # pyright: ignore[reportMissingImports]  # in app/

    def build(*_: Any, **__: Any) -> None:
        raise KeyError("gear_ratio")

    monkeypatch.setattr(old_zoo_parts.OldModel, "__init__", build)
    with pytest.raises(CheckpointError, match=r"cannot be restored: KeyError: 'gear_ratio'"):
        load("user_model")


def test_an_operator_inside_a_model_is_named_with_its_place(
    export: Callable[..., ExportResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "hypot", torch.nextafter)
    with pytest.raises(UnsupportedError, match=r"torch\.nextafter in Turned\.forward \(.*old_zoo_parts\.py:\d+\)"):
        export("bearing")


def test_a_truncated_policy_state_is_named(
    old_copy: Callable[[str], Path], load: Callable[..., RestoredPolicy]
) -> None:
    damaged = old_copy("pendulum")
    whole = (damaged / STATE).read_bytes()
    (damaged / STATE).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=r"policy_state\.pkl cannot be loaded: the file is truncated or damaged"):
        load("pendulum", damaged.parent)


def test_a_damaged_algorithm_state_costs_only_the_facts(
    old_copy: Callable[[str], Path], tmp_path: Path, notices: list[str]
) -> None:
    damaged = old_copy("pendulum")
    (damaged / "algorithm_state.pkl").write_bytes(b"\x80")
    result = export_checkpoint(damaged, tmp_path / "out", notify=notices.append)
    assert result.contract.provenance.algorithm == "unknown"
    assert "algorithm, environment and progress cannot be read" in " ".join(notices)


def test_settings_that_an_earlier_ray_did_not_know_take_their_defaults(
    old_copy: Callable[[str], Path], load: Callable[..., RestoredPolicy], old_zoo: Path
) -> None:
    newer = ("callbacks_on_", "offline_", "num_gpus_per_env_runner", "num_env_runners", "enable_rl_module", "torch_")

    def forget(state: dict[str, Any]) -> None:
        for key in [key for key in spec_of(state) if key.startswith(newer)]:
            del spec_of(state)[key]

    damaged = old_copy("pendulum")
    rewrite(damaged / STATE, forget)
    seen = dict(np.load(old_zoo / "pendulum.npz"))
    assert_same_actions(drive(load("pendulum", damaged.parent).start_loop(), seen), seen)


def test_a_gpu_checkpoint_is_read_on_the_cpu(
    old_copy: Callable[[str], Path], load: Callable[..., RestoredPolicy]
) -> None:
    damaged = old_copy("pendulum")
    rewrite(damaged / STATE, lambda state: spec_of(state).update(num_gpus=1))
    restored = load("pendulum", damaged.parent)
    assert {weights.device.type for weights in restored.network.module.parameters()} == {"cpu"}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("class M: ...\nModelCatalog.register_custom_model('mine', M)", [Registration("pkg.train", "M")]),
        ("from nets import M as N\nregister_custom_model('mine', N)", [Registration("nets", "M")]),
        ("import nets\nModelCatalog.register_custom_model('mine', nets.M)", [Registration("nets", "M")]),
        (
            "from pkg import nets\nModelCatalog.register_custom_model(model_name='mine', model_class=nets.M)",
            [Registration("pkg.nets", "M")],
        ),
        (
            "import nets\nregister_custom_model('mine', nets.T if framework == 'torch' else nets.F)",
            [Registration("nets", "T"), Registration("nets", "F")],
        ),
        ("ModelCatalog.register_custom_model('other', M)", []),
        ("ModelCatalog.register_custom_model(NAME, M)", []),
        ("register_custom_model('mine', (", []),
    ],
)
def test_a_registration_is_read_from_the_users_code_without_running_it(
    tmp_path: Path, text: str, found: list[Registration]
) -> None:
    file = tmp_path / "pkg" / "train.py"
    file.parent.mkdir()
    file.write_text(text)
    assert list(find_registrations(file, tmp_path, "mine")) == found


def test_verify_proves_an_old_stack_bundle_again_and_drives_with_both(
    old_zoo: Path, kept: Callable[[str], ExportResult], tmp_path: Path, notices: list[str]
) -> None:
    path = Path(shutil.copytree(kept("pendulum").path, tmp_path / "pendulum" / "1"))
    result = verify_bundle(path, old_zoo / "pendulum", env_id="Pendulum-v1", episodes=1, notify=notices.append)
    assert result.same_checkpoint and "old API stack" in result.parity.reference
    assert result.evaluation is not None and result.evaluation.return_bundle < -50
    assert result.evaluation.return_bundle == pytest.approx(result.evaluation.return_checkpoint, rel=1e-2)
    assert load_bundle(path).contract.evaluations == (result.evaluation,)


@pytest.mark.parametrize(("name", "policy"), [("sac", None), ("several", "arm")])
def test_a_pruned_old_stack_checkpoint_exports_to_the_same_policy(
    old_zoo: Path, app: Path, tmp_path: Path, notices: list[str], name: str, policy: str | None
) -> None:
    kept = prune_checkpoint(old_zoo / name, tmp_path / "small", module_id=policy, app_dir=app, notify=notices.append)
    assert {file.name for file in kept} == {"policy_state.pkl", "rlservo_facts.json", "rllib_checkpoint.json"}
    contracts = []
    for checkpoint in (tmp_path / "small", old_zoo / name):
        out = tmp_path / f"from_{checkpoint.name}"
        result = export_checkpoint(checkpoint, out, module_id=policy, app_dir=app, notify=notices.append)
        contracts.append(result.contract.model_dump(mode="json"))
        contracts[-1]["provenance"].pop("exported_at")
    assert contracts[0] == contracts[1]


@pytest.mark.parametrize("name", ["continuous_lstm", "pendulum"])
def test_the_gates_reference_acts_over_episodes_and_forgets_those_of_another_loop(
    old_zoo: Path, load: Callable[..., RestoredPolicy], name: str
) -> None:
    restored, seen = load(name), np.load(old_zoo / f"{name}.npz")
    for begins in (True, False):  # a new loop has no earlier episode that it could continue
        loop = restored.start_loop()
        for step, restart in enumerate(seen["restart"]):
            given = {"obs": seen["obs"][[step]], "reward": np.array([0.5], np.float32)}
            found = loop.step(given, np.array([restart and (step > 0 or begins)]))
            np.testing.assert_allclose(found["action"][0], seen["action"][step], rtol=1e-5, atol=2e-6)


def test_the_gates_reference_gives_connectors_the_last_reward_and_the_time(
    old_zoo: Path, load: Callable[..., RestoredPolicy], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[Any, Any]] = []
    transform = StateBufferConnector.transform

    def watched(self: Any, data: Any) -> Any:
        given.append((data.data.get(SampleBatch.REWARDS), data.data[SampleBatch.T]))
        return transform(self, data)

    monkeypatch.setattr(StateBufferConnector, "transform", watched)
    loop, seen = load("pendulum").start_loop(), np.load(old_zoo / "pendulum.npz")
    for step in range(3):
        loop.step({"obs": seen["obs"][[step]], "reward": np.array([step], np.float32)}, np.array([step == 0]))
    assert given == [(None, -1), (1.0, 0), (2.0, 1)]
