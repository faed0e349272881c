"""Every space, recurrent policy, connector and algorithm, against what environments saw in RLlib's own rollouts."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from command_line import rlservo_here
from rlservo.bundle.bundle import load_bundle
from rlservo.bundle.contract import Contract
from rlservo.bundle.nested import build_action
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import ObservationError, ParityError, RequestError, RlservoError, UnsupportedError
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.graph.onnx_file import run_onnx, write_onnx
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.torchscript_file import run_torchscript
from rlservo.export.proof.parity import GraphLoop, prove
from rlservo.export.proof.references import record
from rlservo.export.recipe.recipe import Flatten, FrameStack, Previous, Recipe, StateLeaf
from rlservo.export.recipe.runners import first_step
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.recipe.trees import named_leaves
from rlservo.export.rllib.restore import restore
from rlservo.export.sources.restored_policy import RestoredPolicy
from rlservo.policy.policy import Policy

RECURRENT = ["lstm_box", "lstm_discrete", "lstm_previous", "previous", "user_gru", "appo_lstm", "stacked",
             "stacked_vectors", "act_nested", "dqn_lstm"]  # fmt: skip
STATELESS = [
    "obs_discrete", "obs_below_zero", "obs_multi_discrete", "obs_multi_binary", "obs_integers",
    "obs_integers_filtered_first", "obs_bytes", "obs_dict", "obs_tuple", "obs_nested", "dict_module", "greedy_module",
    "image", "byte_image", "act_multi_discrete", "act_dict", "act_tuple", "act_scalar", "masked", "autoregressive",
    "scaled", "halved", "impala", "sac_discrete", "tqc", "dqn_plain", "dqn_distributional", "dqn_distributional_plain",
    "bc", "marwil", "cql", "iql", "byte_masked", "user_distribution", "old_model_inside",
    "polar", "bearing_module",
]  # fmt: skip
# RLlib's own classes and zoo environments, on the way from a checkpoint to the contract.
pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")


@pytest.fixture(scope="session")
def export(wide_zoo: Path, exported: Callable[..., ExportResult]) -> Callable[[str], ExportResult]:
    """Return a function that gives the export of a checkpoint of the zoo."""
    return lambda name: exported(wide_zoo / name)


def observation(contract: Contract, seen: Mapping[str, Any], rows: Any) -> Any:
    """Return what an environment gave, in the space's own form: one row or a slice of them."""
    return build_action(contract.observation_space, {name: values[rows] for name, values in seen.items()}, "obs")


def assert_sent(contract: Contract, got: Mapping[str, Any], seen: Mapping[str, Any], step: int) -> None:
    """Compare action leaves with what RLlib sent to the environment at a step."""
    for name, space in leaf_specs(contract.action_space, "action").items():
        assert np.asarray(got[name]).dtype == np.dtype(space.dtype)
        if space.kind == "box":
            np.testing.assert_allclose(got[name], seen[name][step], rtol=1e-5, atol=2e-6)
        else:
            np.testing.assert_array_equal(got[name], seen[name][step])


@pytest.mark.parametrize("name", [*RECURRENT, *STATELESS])
def test_graphs_and_runtime_act_as_rllib_did_in_its_own_rollout(
    wide_zoo: Path, export: Callable[[str], ExportResult], name: str
) -> None:
    result = export(name)
    contract, seen = result.contract, dict(np.load(wide_zoo / f"{name}.npz"))
    assert len(seen["restart"]) >= 90 and seen["restart"].sum() >= 3  # several episodes
    inputs, outputs = ([tensor.name for tensor in side] for side in (contract.inputs, contract.outputs))
    assert bool(contract.state) == (name in RECURRENT)
    state = [StateLeaf(one.name, one.initial_value(1)[0]) for one in contract.state]
    script = run_torchscript(result.path / "policy.ts", inputs, outputs)
    loops = [GraphLoop(run, state) for run in (run_onnx(result.path / "policy.onnx"), script)]
    policy = Policy.load(result.path)
    for step, restart in enumerate(seen["restart"]):
        feed = {one.name: seen[one.name][step : step + 1].astype(one.dtype) for one in contract.inputs
                if one.name in seen}  # fmt: skip
        for loop in loops:
            found = loop.step(feed, np.array([restart]))
            assert_sent(contract, {key: value[0] for key, value in found.items()}, seen, step)
        if restart:
            policy.reset()
        action = policy.act(observation(contract, seen, step), reward=seen["reward"][step])
        assert_sent(contract, named_leaves(action, "action"), seen, step)


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("wrongly_scaled", ParityError, r"a batch of 257 likely observations: output 'action"),
        ("branching", UnsupportedError, r"reads numbers of the observation in Python at .*zoo_rules\.py:\d+"),
    ],
)
def test_what_does_not_match_leaves_nothing(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str], name: str, error: type[RlservoError], words: str
) -> None:
    with pytest.raises(error, match=words):
        export_checkpoint(wide_zoo / name, tmp_path / "out", app_dir=app, notify=notices.append)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["polar", "bearing_module"])
def test_distance_and_bearing_hold_for_extreme_observations(
    load: Callable[[str], RestoredPolicy], export: Callable[[str], ExportResult], name: str
) -> None:
    numbers = np.float32([0.0, -0.0, 1.0, -1.0, 0.5, -7.0, 1e-42, -1e-38, 1e5, -1e5, 1e15, 1e30, -1e30])
    obs = np.array([(x, y, z) for x in numbers for y in numbers for z in (0.3, -0.0, -2.0)], np.float32)
    expected, result = first_step(load(name).start_loop(), {"obs": obs.copy()}), export(name)
    script = run_torchscript(result.path / "policy.ts", ["obs"], [one.name for one in result.contract.outputs])
    for run in (run_onnx(result.path / "policy.onnx"), script):
        for output, values in run({"obs": obs}).items():
            if values.dtype == np.float32:
                scale = np.maximum(1.0, np.abs(expected[output]).max(axis=tuple(range(1, values.ndim)), keepdims=True))
                np.testing.assert_allclose(values / scale, expected[output] / scale, rtol=1e-5, atol=2e-6)


def test_an_operator_without_an_onnx_form_is_one_sentence_on_the_command_line(
    wide_zoo: Path, app: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch, "hypot", torch.nextafter)
    done = rlservo_here("export", wide_zoo / "polar", "--out", tmp_path / "out", "--app-dir", app)
    assert done.returncode == 1
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("rlservo: ")]
    source = re.escape(str(app / "zoo_spaces.py"))
    assert re.fullmatch(
        rf"rlservo: the operator torch\.nextafter in Polar\.torch_forward \({source}:\d+\) has no ONNX "
        r"form that onnxruntime runs: compose it of [\w ,.]+",
        sentence,
    )
    written = done.stdout + done.stderr + "".join(capfd.readouterr())  # of libraries, too
    assert not any(words in written for words in ("\x1b", "Traceback", "Next steps", "step 3/3"))
    assert "the elements stay unnamed, which changes nothing else" in written
    assert not (tmp_path / "out").exists()


def test_an_operator_inside_a_module_is_named_with_its_place(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "hypot", torch.nextafter)
    with pytest.raises(UnsupportedError, match=r"torch\.nextafter in BearingModule\._hidden \(.*zoo_spaces\.py:\d+\)"):
        export_checkpoint(wide_zoo / "bearing_module", tmp_path / "out", app_dir=app, notify=notices.append)
    assert not (tmp_path / "out").exists()


def test_a_users_own_distribution_is_in_the_graph_and_cannot_explore(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    result = export_checkpoint(wide_zoo / "user_distribution", tmp_path, app_dir=app, notify=notices.append)
    assert result.contract.distribution is None
    assert "BetaDistribution is not one of RLlib's: the export cannot explore" in " ".join(notices)
    with pytest.raises(RequestError, match="explor"):
        Policy.load(result.path).act(np.zeros(3, np.float32), explore=True)


def test_inputs_and_outputs_are_named_by_the_path_in_the_space(export: Callable[[str], ExportResult]) -> None:
    result = export("obs_nested")
    expected = {
        "obs.arm.flags": ("int8", (-1, 4)),
        "obs.arm.mode": ("int64", (-1,)),
        "obs.grid.0": ("int64", (-1, 2)),
        "obs.grid.1": ("int32", (-1, 2, 2)),
        "obs.zeta": ("float32", (-1, 2)),
    }
    assert {one.name: (one.dtype, one.shape) for one in result.contract.inputs} == expected
    model = onnx.load(str(result.path / "policy.onnx"))
    assert [one.name for one in model.graph.input] == list(expected)
    assert result.contract.baked_in[0].values["order"] == list(expected)
    contract = load_bundle(result.path).contract  # nested spaces survive the JSON
    assert contract == result.contract and contract.observation_space.kind == "dict"


def test_a_recurrent_contract_says_what_is_remembered(export: Callable[[str], ExportResult]) -> None:
    contract = export("lstm_previous").contract
    assert [(one.name, one.shape, one.kind) for one in contract.state] == [
        ("previous_actions", (8,), "previous_actions"),
        ("previous_rewards", (2,), "previous_rewards"),
        ("c", (1, 8), "recurrent"),
        ("h", (1, 8), "recurrent"),
    ]
    assert [one.name for one in contract.inputs][:2] == ["obs", "reward"]
    assert [step.step for step in contract.baked_in] == ["previous", "flatten", "network", "mode"]


def test_a_state_that_begins_with_other_numbers_than_zero_is_kept(export: Callable[[str], ExportResult]) -> None:
    (memory,) = export("user_gru").contract.state
    np.testing.assert_allclose(memory.initial_value(2), np.tile(np.linspace(-0.5, 0.5, 6), (2, 1)), rtol=1e-6)


# The mistakes exporters make, made on purpose.


@pytest.fixture
def load(wide_zoo: Path, app: Path, notices: list[str]) -> Callable[[str], RestoredPolicy]:
    def load(name: str) -> RestoredPolicy:
        with user_code(app):
            return restore(locate_checkpoint(wide_zoo / name), app, notices.append)

    return load


def prove_as(checkpoint: RestoredPolicy, recipe: Recipe, tmp_path: Path) -> Callable[[Mapping[str, str]], None]:
    """Prove a graph built from `recipe` against RLlib's own pipeline.

    Returns a function that does so again with the graph's states exchanged.
    """
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))
    graph = PolicyGraph(recipe, checkpoint.network)
    pair = next(one.batch for one in references if len(one.batch) == 2)
    example = GraphLoop(lambda inputs: inputs, recipe.state).complete(pair.inputs, np.ones(2, np.bool_))
    write_onnx(graph, example, tmp_path / "policy.onnx")
    run = run_onnx(tmp_path / "policy.onnx")

    def swapped(swap: Mapping[str, str]) -> None:
        prove(recipe, references, {"onnx": lambda inputs: run({swap.get(name, name): v for name, v in inputs.items()})})

    swapped({})
    return swapped


def changed(recipe: Recipe, **changes: Any) -> Recipe:
    return dataclasses.replace(recipe, **changes)


@pytest.mark.parametrize("name", ["lstm_box", "act_nested"])
def test_a_swapped_state_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path, name: str) -> None:
    checkpoint = load(name)
    prove_again = prove_as(checkpoint, checkpoint.recipe, tmp_path)
    with pytest.raises(ParityError, match="of the sequences"):
        prove_again({"state_in.c": "state_in.h", "state_in.h": "state_in.c"})


def test_a_state_that_is_not_reset_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("user_gru")
    (memory,) = checkpoint.recipe.network_state
    zero = dataclasses.replace(memory, initial=np.zeros_like(memory.initial))
    with pytest.raises(ParityError, match="step 0 of the sequences"):
        prove_as(checkpoint, changed(checkpoint.recipe, network_state=(zero,)), tmp_path)


def test_leaves_flattened_in_another_order_are_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("obs_multi_discrete")
    (flatten,) = checkpoint.recipe.steps
    assert isinstance(flatten, Flatten)
    turned = type(flatten.space)(flatten.space.nvec[[1, 0, 2]])
    with pytest.raises(ParityError):
        prove_as(checkpoint, changed(checkpoint.recipe, steps=(Flatten(turned),)), tmp_path)


def test_a_forgotten_action_is_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("previous")
    previous = checkpoint.recipe.steps[0]
    assert isinstance(previous, Previous)
    other = (dataclasses.replace(previous, keys=(previous.keys[0], previous.keys[2], previous.keys[1])),)
    with pytest.raises((ParityError, UnsupportedError)):
        prove_as(checkpoint, changed(checkpoint.recipe, steps=(*other, *checkpoint.recipe.steps[1:])), tmp_path)


def test_frames_in_the_wrong_order_are_caught(load: Callable[[str], RestoredPolicy], tmp_path: Path) -> None:
    checkpoint = load("stacked")
    assert isinstance(checkpoint.recipe.steps[0], FrameStack)
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))
    pair = next(one.batch for one in references if len(one.batch) == 2)
    example = GraphLoop(lambda inputs: inputs, checkpoint.recipe.state).complete(pair.inputs, np.ones(2, np.bool_))
    write_onnx(PolicyGraph(checkpoint.recipe, checkpoint.network), example, tmp_path / "policy.onnx")
    run = run_onnx(tmp_path / "policy.onnx")
    with pytest.raises(ParityError, match="of the sequences"):
        prove(
            checkpoint.recipe,
            references,
            {"onnx": lambda inputs: run({**inputs, "state_in.frames": inputs["state_in.frames"][..., ::-1].copy()})},
        )


def as_exported(outputs: Mapping[str, Any]) -> dict[str, Any]:
    """RLlib's own outputs with discrete actions as the export gives them: int64, where RLlib sends int32."""
    integers = {name: values.astype(np.int64) for name, values in outputs.items() if values.dtype.kind == "i"}
    return {**outputs, **integers}


@pytest.mark.parametrize("leaf", ["wheel", "gear"])
def test_one_wrong_part_of_a_nested_action_is_caught(
    load: Callable[[str], RestoredPolicy], tmp_path: Path, leaf: str
) -> None:
    checkpoint = load("act_dict")
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))

    def answers(change: Callable[[Any], Any]) -> None:
        remaining = iter(references)
        name = f"action.{leaf}"

        def run(_: Any) -> dict[str, Any]:
            outputs = next(remaining).outputs
            return {**as_exported(outputs), name: change(as_exported(outputs)[name])}

        prove(checkpoint.recipe, references, {"onnx": run})

    answers(lambda action: action.copy())
    wrong = {"wheel": lambda action: action + np.float32(0.01), "gear": lambda action: (action + 1) % 3}
    with pytest.raises(ParityError, match=f"output 'action.{leaf}'"):
        answers(wrong[leaf])


def test_a_masked_score_does_not_widen_the_tolerance_of_the_others(
    load: Callable[[str], RestoredPolicy], tmp_path: Path
) -> None:
    checkpoint = load("masked")
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=3))
    scores = [one.outputs["action_dist_inputs"] for one in references]
    assert any((values < -1e30).any() for values in scores)  # -3.4e38 stands for 'not allowed'
    remaining = iter(references)

    def run(_: Any) -> dict[str, Any]:
        outputs = next(remaining).outputs
        values = outputs["action_dist_inputs"]
        return {
            **as_exported(outputs),
            "action_dist_inputs": np.where(values > -1e30, values + np.float32(1e-3), values),
        }

    with pytest.raises(ParityError, match="action_dist_inputs"):
        prove(checkpoint.recipe, references, {"onnx": run})


# The runtime.


def test_a_recurrent_policy_keeps_its_state_and_reset_drops_it(
    wide_zoo: Path, export: Callable[[str], ExportResult]
) -> None:
    policy = Policy.load(export("lstm_box").path)
    obs = np.load(wide_zoo / "lstm_box.npz")["obs"][:6]
    first = [policy.act(one) for one in obs]
    assert not np.allclose(policy.act(obs[0]), first[0], atol=1e-7)  # it remembers
    policy.reset()
    again = [policy.act(one) for one in obs]
    np.testing.assert_array_equal(first, again)
    state = None
    for one, expected in zip(obs, first, strict=True):
        step = policy.step(one, state=state)
        np.testing.assert_array_equal(step.action, expected)
        state = step.own_state
    assert state is not None and {name: value.shape for name, value in state.items()} == {"c": (1, 8), "h": (1, 8)}


def test_a_batch_is_so_many_episodes_side_by_side(wide_zoo: Path, export: Callable[[str], ExportResult]) -> None:
    policy = Policy.load(export("lstm_box").path)
    obs = np.load(wide_zoo / "lstm_box.npz")["obs"][:8].reshape(4, 2, 3)
    together = [policy.act(step) for step in obs]
    with pytest.raises(RequestError, match=r"remembers 2 episodes and got 1 observation: call reset"):
        policy.act(obs[0, 0])
    for row in range(2):
        policy.reset()
        alone = [policy.act(step[row]) for step in obs]
        np.testing.assert_allclose([step[row] for step in together], alone, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"h": np.zeros((1, 8))}, "missing c"),
        ({"h": np.zeros((1, 8)), "c": np.zeros((1, 8)), "x": 0}, "unknown x"),
        ({"h": np.zeros((8,)), "c": np.zeros((1, 8))}, r"state 'h' of shape \(1, 8\), got \(8,\)"),
        ({"h": np.full((1, 8), np.nan), "c": np.zeros((1, 8))}, "not finite"),
        ({"h": "x", "c": np.zeros((1, 8))}, "cannot be read"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_by_name(
    export: Callable[[str], ExportResult], state: Any, words: str
) -> None:
    policy = Policy.load(export("lstm_box").path)
    with pytest.raises(RequestError, match=words):
        policy.step(np.zeros(3, np.float32), state=state)


def test_a_policy_that_sees_rewards_asks_for_them(export: Callable[[str], ExportResult]) -> None:
    policy = Policy.load(export("previous").path)
    policy.act(2)  # an episode's first step has no reward
    with pytest.raises(RequestError, match=r"pass act\(obs, reward"):
        policy.act(2)
    policy.act(2, reward=0.5)
    with pytest.raises(RequestError, match="1 finite reward"):
        policy.act(2, reward=float("nan"))


def test_an_exploring_policy_remembers_the_action_it_took(export: Callable[[str], ExportResult]) -> None:
    policy = Policy.load(export("previous").path)
    greedy = int(policy.step(2).action)
    for seed in range(50):
        step = policy.step(2, explore=True, seed=seed)
        action, state = step.action, step.own_state
        np.testing.assert_array_equal(state["previous_actions"], np.eye(8, dtype=np.float32)[4 + int(action)])
        if int(action) != greedy:
            return
    pytest.fail("50 samples of a nearly uniform policy were all its mode")


def test_a_nested_policy_explores_every_part_in_its_space(export: Callable[[str], ExportResult]) -> None:
    policy = Policy.load(export("act_dict").path)
    obs = np.zeros((4000, 3), np.float32)
    action = policy.act(obs, explore=True, seed=1)
    assert set(action) == {"wheel", "gear", "free"}
    logits_and_more = run_onnx(policy.path / "policy.onnx")({"obs": obs[:1]})["action_dist_inputs"][0]
    free, gear, wheel = np.split(logits_and_more, [2, 5])  # in the order of the sorted keys
    probabilities = np.exp(gear) / np.exp(gear).sum()
    np.testing.assert_allclose(np.bincount(action["gear"], minlength=3) / 4000, probabilities, atol=0.04)
    np.testing.assert_allclose(action["free"].mean(), free[0], atol=5 * np.exp(free[1]) / np.sqrt(4000))  # unbounded
    assert (action["wheel"] >= -2).all() and (action["wheel"] <= 6).all()
    middle = 2.0 + 4.0 * np.clip(wheel[:2], -1, 1)  # unsquashed from [-1, 1] to [-2, 6]
    np.testing.assert_allclose(np.median(action["wheel"], axis=0), middle, atol=4 * 5 * 1.25 / np.sqrt(4000))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda obs: obs.pop("zeta"), "cannot read obs: missing zeta"),
        (lambda obs: obs.update(other=1), "unknown other"),
        (lambda obs: obs["arm"].update(mode=3), "obs.arm.mode: element 0 is 3, outside the observation space's 0..2"),
        (lambda obs: obs["arm"].update(flags=[0, 2, 0, 0]), "obs.arm.flags: element 1 is 2, outside"),
        (lambda obs: obs.update(grid=(obs["grid"][0],)), "obs.grid: expected a list of 2 parts, got 1 of them"),
        (lambda obs: obs.update(zeta=[0.0, float("nan")]), "obs.zeta: element 1 is nan"),
        (lambda obs: obs.update(zeta=np.zeros((3, 2))), "different batch sizes"),
        (lambda obs: obs.update(arm=[1]), "obs.arm: expected a map with the keys flags, mode, got a list"),
    ],
)
def test_a_wrong_part_of_a_nested_observation_is_named_by_its_path(
    wide_zoo: Path, export: Callable[[str], ExportResult], change: Callable[[Any], object], words: str
) -> None:
    policy = Policy.load(export("obs_nested").path)
    obs = observation(policy.contract, dict(np.load(wide_zoo / "obs_nested.npz")), 0)
    policy.act(obs)
    change(obs)
    with pytest.raises(ObservationError, match=words):
        policy.act(obs)


def test_a_nested_batch_may_be_leaves_with_an_axis_or_a_list_of_maps(
    wide_zoo: Path, export: Callable[[str], ExportResult]
) -> None:
    policy = Policy.load(export("obs_nested").path)
    seen = dict(np.load(wide_zoo / "obs_nested.npz"))
    batch = policy.act(observation(policy.contract, seen, slice(0, 5)))
    listed = policy.act([observation(policy.contract, seen, row) for row in range(5)])
    np.testing.assert_array_equal(batch, listed)
    assert batch.shape == (5, 2)
