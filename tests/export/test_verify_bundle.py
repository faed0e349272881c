"""Verifying a bundle against its checkpoint again, pruning, naming elements, and the report."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from rich.console import Console

from checkpoints import training_code
from rlservo.bundle.bundle import load_bundle, read_contract, write_contract
from rlservo.bundle.spaces import BoxSpec, DictSpec, Element, leaf_specs
from rlservo.errors import BundleError, ParityError, UsageError
from rlservo.export.element_names import read_elements
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.recipe.to_contract import space_spec
from rlservo.export.reports import contract_report
from rlservo.export.verify_bundle import verify_bundle


@pytest.fixture
def toy(app: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The user's environment, registered with Gymnasium; its class names its elements."""
    monkeypatch.syspath_prepend(str(app))
    gymnasium.register("zoo/Toy-v0", entry_point="zoo_parts:Toy")
    yield "zoo/Toy-v0"
    gymnasium.registry.pop("zoo/Toy-v0")


@pytest.fixture
def spaces(app: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The wide zoo's environment, which pays for the actions it is given."""
    monkeypatch.syspath_prepend(str(app))
    gymnasium.register("zoo/Spaces-v0", entry_point="zoo_spaces:Spaces", disable_env_checker=True)
    yield "zoo/Spaces-v0"
    gymnasium.registry.pop("zoo/Spaces-v0")


def test_verify_runs_both_on_the_same_seeds_and_writes_it_into_the_bundle(
    zoo: Path, exported_copy: Callable[[Path], ExportResult], notices: list[str]
) -> None:
    exported = exported_copy(zoo / "pendulum")
    result = verify_bundle(exported.path, zoo / "pendulum", env_id="Pendulum-v1", episodes=2, notify=notices.append)
    assert result.same_checkpoint and result.parity.formats["onnx"].max_rel < 1e-5
    evaluation = load_bundle(exported.path).contract.evaluations[0]  # the hashes fit the new contract
    assert evaluation == result.evaluation
    assert (evaluation.episodes, evaluation.first_seed, evaluation.success_rate_bundle) == (2, 0, None)
    assert evaluation.return_bundle < -50  # two real episodes of 200 steps
    assert evaluation.return_bundle == pytest.approx(evaluation.return_checkpoint, rel=1e-2)


def test_verify_reports_success_where_the_environment_tells(
    zoo: Path, exported_copy: Callable[[Path], ExportResult], notices: list[str], toy: str
) -> None:
    exported = exported_copy(zoo / "mixed")
    result = verify_bundle(exported.path, zoo / "mixed", env_id=toy, episodes=3, first_seed=5, notify=notices.append)
    assert result.evaluation is not None and result.evaluation.success_rate_bundle == 1.0
    assert result.evaluation.return_bundle == pytest.approx(result.evaluation.return_checkpoint, rel=1e-5)


@pytest.mark.parametrize(("name", "action"), [("lstm_box", "box"), ("act_nested", "nested"), ("previous", "discrete")])
def test_verify_drives_recurrent_and_nested_policies(
    wide_zoo: Path,
    app: Path,
    exported_copy: Callable[[Path], ExportResult],
    notices: list[str],
    spaces: str,
    name: str,
    action: str,
) -> None:
    bundle = exported_copy(wide_zoo / name).path
    assert read_contract(bundle).provenance.env_config["action"] == action
    result = verify_bundle(bundle, wide_zoo / name, env_id=spaces, episodes=3, app_dir=app, notify=notices.append)
    evaluation = result.evaluation
    assert evaluation is not None and evaluation.episodes == 3 and evaluation.return_bundle != 0.0
    assert evaluation.return_bundle == pytest.approx(evaluation.return_checkpoint, rel=1e-4)
    assert load_bundle(bundle).contract.evaluations == (evaluation,)
    assert not [file for file in bundle.iterdir() if file.name.startswith(".")]


def test_verify_drives_where_the_actions_do_not_start_at_zero(
    zoo: Path, exported_copy: Callable[[Path], ExportResult], notices: list[str], toy: str
) -> None:
    exported = exported_copy(zoo / "started")
    result = verify_bundle(exported.path, zoo / "started", env_id=toy, episodes=2, notify=notices.append)
    assert result.evaluation is not None
    assert result.evaluation.return_bundle == pytest.approx(result.evaluation.return_checkpoint, rel=1e-5)


def test_an_interrupted_verification_writes_no_half_of_a_comparison(
    zoo: Path,
    exported_copy: Callable[[Path], ExportResult],
    notices: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    exported = exported_copy(zoo / "pendulum")
    monkeypatch.setattr(PendulumEnv, "step", interrupt)
    with pytest.raises(KeyboardInterrupt):
        verify_bundle(exported.path, zoo / "pendulum", env_id="Pendulum-v1", episodes=2, notify=notices.append)
    assert read_contract(exported.path).evaluations == ()


def test_verify_catches_another_checkpoint(
    zoo: Path, exported_copy: Callable[[Path], ExportResult], notices: list[str]
) -> None:
    exported = exported_copy(zoo / "relu")
    with pytest.raises(ParityError):
        verify_bundle(exported.path, zoo / "shared", notify=notices.append)
    assert "exported from another checkpoint" in " ".join(notices)
    with pytest.raises(UsageError, match="do not belong together"):
        verify_bundle(exported.path, zoo / "cart_pole", notify=notices.append)


def test_verify_refuses_what_is_no_bundle_and_an_environment_that_does_not_fit(
    zoo: Path, tmp_path: Path, exported_copy: Callable[[Path], ExportResult], notices: list[str]
) -> None:
    with pytest.raises(BundleError):
        verify_bundle(tmp_path, zoo / "pendulum", notify=notices.append)
    exported = exported_copy(zoo / "pendulum")
    with pytest.raises(UsageError, match=r"does not fit CartPole-v1: the observation has shape \(4,\) there"):
        verify_bundle(exported.path, zoo / "pendulum", env_id="CartPole-v1", notify=notices.append)
    with pytest.raises(UsageError, match="is not registered"):
        verify_bundle(exported.path, zoo / "pendulum", env_id="No/Such-v0", notify=notices.append)
    assert read_contract(exported.path).evaluations == ()


@pytest.mark.parametrize("name", ["pendulum", "dqn"])
def test_a_pruned_checkpoint_is_small_and_exports_to_the_same_policy(
    zoo: Path, tmp_path: Path, notices: list[str], name: str
) -> None:
    kept = prune_checkpoint(zoo / name, tmp_path / "small", notify=notices.append)
    whole = export_checkpoint(zoo / name, tmp_path / "whole", notify=notices.append)
    shutil.copytree(tmp_path / "small", tmp_path / "moved")  # it depends on no path
    pruned = export_checkpoint(tmp_path / "moved", tmp_path / "pruned", notify=notices.append)
    ours, theirs = (result.contract.model_dump(mode="json") for result in (pruned, whole))
    for one in (ours, theirs):
        one["provenance"].pop("exported_at")
    how = [one["parity"].pop("reference") for one in (ours, theirs)]  # the copy holds no configuration
    assert "as the checkpoint lists them" in how[0] and "builds them from the configuration" in how[1]
    assert ours == theirs
    size = sum((tmp_path / "small" / file).stat().st_size for file in kept)
    assert size < sum(file.stat().st_size for file in (zoo / name).rglob("*") if file.is_file()) / 2
    assert f"kept {len(kept)} files" in " ".join(notices)


def test_a_pruned_checkpoint_names_no_folder_of_the_machine_it_was_trained_on(
    zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    trained_here = str(training_code()).encode()  # RLlib pickles the training script's functions, with their file
    assert trained_here in (zoo / "pendulum" / "class_and_ctor_args.pkl").read_bytes()
    prune_checkpoint(zoo / "pendulum", tmp_path / "small", notify=notices.append)
    for file in (tmp_path / "small").rglob("*"):
        assert file.is_dir() or (trained_here not in file.read_bytes() and str(zoo).encode() not in file.read_bytes())
    facts = json.loads((tmp_path / "small" / "rlservo_facts.json").read_text())
    assert facts["algorithm"] == "PPO" and facts["env_id"] == "Pendulum-v1"
    with pytest.raises(UsageError, match="already exists"):
        prune_checkpoint(zoo / "pendulum", tmp_path / "small", notify=notices.append)


def toy_recipe(obs: int = 5, action: int = 3) -> Recipe:
    box = gymnasium.spaces.Box
    return Recipe(box(-1, 1, (obs,)), box(-1, 1, (action,)), (), "mean", "unsquash", "diag_gaussian")


def test_elements_come_from_the_environments_class(toy: str, notices: list[str]) -> None:
    names = read_elements(toy, {"spaces": "mixed"}, toy_recipe(), notices.append)
    assert [element.name for element in names.action] == ["motor_0", "motor_1", "motor_2"]
    assert {element.unit for element in names.observation} == {"m"} and names.control_rate_hz == 25.0
    assert read_elements("zoo_parts:Toy", {"spaces": "mixed"}, toy_recipe(), notices.append) == names
    assert notices == []


def test_elements_that_do_not_fit_stay_unnamed_with_a_notice(toy: str, notices: list[str]) -> None:
    names = read_elements(toy, {"spaces": "mixed"}, toy_recipe(obs=4), notices.append)
    assert names.observation == () and len(names.action) == 3
    assert "names 5 elements of 'obs', which has 4" in " ".join(notices)


class Described(gymnasium.Env[Any, Any]):
    """An environment with nested spaces, which describes them as `given` says."""

    given: ClassVar[dict[str, Any]] = {}

    @classmethod
    def describe(cls) -> dict[str, Any]:
        return cls.given


gymnasium.register("Described-v0", Described)


def nested_recipe() -> Recipe:
    box, both = gymnasium.spaces.Box, gymnasium.spaces.Dict
    inner = gymnasium.spaces.Tuple([box(-1, 1, (1,)), gymnasium.spaces.Discrete(3)])
    obs = both({"arm": box(-1, 1, (2,)), "rest": inner})
    return Recipe(obs, box(-1, 1, (1,)), (), "mean", "unsquash", "diag_gaussian")


ARM = [{"name": "shoulder", "unit": "rad"}, {"name": "elbow", "unit": "rad"}]


def test_parts_of_nested_spaces_are_named(notices: list[str]) -> None:
    rest = [[{"name": "distance", "unit": "m"}], []]
    Described.given = {"observation": {"arm": ARM, "rest": rest}, "action": [{"name": "speed"}], "control_rate_hz": 5}
    names = read_elements("Described-v0", {}, nested_recipe(), notices.append)
    assert isinstance(names.observation, dict) and notices == [] and names.control_rate_hz == 5.0
    spec = space_spec(nested_recipe().observation_space, names.observation)
    by_leaf = {name: [element.name for element in leaf.elements] for name, leaf in leaf_specs(spec, "obs").items()}
    assert by_leaf == {"obs.arm": ["shoulder", "elbow"], "obs.rest.0": ["distance"], "obs.rest.1": []}


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"arm": [*ARM, {"name": "wrist"}]}, "it names 3 elements of 'obs.arm', which has 2"),
        ({"leg": ARM}, "'obs' has no part 'leg'"),
        ({"arm": ["shoulder", "elbow"]}, "element 0 of 'obs.arm' is 'shoulder': expected {'name': ..., 'unit': ...}"),
    ],
)
def test_one_wrong_part_leaves_the_others_named(notices: list[str], wrong: Any, says: str) -> None:
    Described.given = {"observation": wrong, "action": [{"name": "speed"}], "control_rate_hz": 5}
    names = read_elements("Described-v0", {}, nested_recipe(), notices.append)
    assert names.observation == () and [each.name for each in names.action] == ["speed"]  # type: ignore[union-attr]
    assert names.control_rate_hz == 5.0
    (notice,) = notices
    assert notice.endswith(says) and "does not describe its observation, which changes nothing else" in notice


@pytest.mark.parametrize("env_id", ["No/Such-v0", "nowhere:Env", "toy"])
def test_an_environment_that_cannot_be_asked_is_a_notice(env_id: str, notices: list[str]) -> None:
    assert read_elements(env_id, {}, toy_recipe(), notices.append).observation == ()
    (notice,) = notices
    assert notice.startswith("the elements stay unnamed, which changes nothing else")
    assert f"environment {env_id} cannot name them" in notice


def test_an_environment_that_names_nothing_is_no_notice(notices: list[str]) -> None:
    assert read_elements("Pendulum-v1", {}, toy_recipe(), notices.append).observation == ()
    assert notices == []


@pytest.mark.parametrize("width", [80, 160])
def test_the_report_shows_names_bounds_baked_steps_and_proof(
    zoo: Path, exported: Callable[..., ExportResult], width: int
) -> None:
    kept = exported(zoo / "pendulum").contract
    elements = tuple(Element(name=name, unit="rad/s") for name in ("cos_angle", "sin_angle", "speed"))
    space = kept.observation_space.model_copy(update={"elements": elements})
    contract = kept.model_copy(update={"observation_space": space})
    file = io.StringIO()
    Console(width=width, file=file).print(contract_report(contract))
    shown = file.getvalue()
    samples = str(kept.parity.samples)
    for words in ("sin_angle", "rad/s", "mean_std_filter", "unsquash", "Pendulum-v1", "torchscript", samples, "PPO"):
        assert words in shown, words
    assert max(len(line) for line in shown.splitlines()) <= width
    assert "-8 " in shown and "gaussian" in shown


ROBOT_NAMES = [f"{joint}_joint_{what}" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2")
               for what in ("position", "velocity")]  # fmt: skip


@pytest.mark.parametrize("name", ["act_nested", "lstm_previous", "image", "obs_tuple"])
def test_the_report_of_any_policy_fits_a_terminal_and_breaks_no_name(
    wide_zoo: Path, exported: Callable[..., ExportResult], name: str
) -> None:
    contract = exported(wide_zoo / name).contract
    file = io.StringIO()
    Console(width=80, file=file).print(contract_report(contract))
    shown = file.getvalue()
    assert max(len(line.rstrip()) for line in shown.splitlines()) <= 80
    words = shown.split()
    for tensor in (*contract.inputs, *contract.outputs):
        assert tensor.name in words, tensor.name
    assert all(state.name in words for state in contract.state)
    assert "…" not in shown and len(shown.splitlines()) < 90


def test_long_element_names_with_units_and_a_filter_fit_eighty_columns(
    zoo: Path, exported: Callable[..., ExportResult]
) -> None:
    contract = exported(zoo / "pendulum").contract
    size = len(ROBOT_NAMES)
    space = BoxSpec(shape=(size,), dtype="float32", low=-6.283185307, high=6.283185307,
                    elements=tuple(Element(name=one, unit="rad/s") for one in ROBOT_NAMES))  # fmt: skip
    frozen = contract.baked_in[0].model_copy(update={"values": {"mean": [-123.456] * size, "std": [0.001234] * size}})
    changed = contract.model_copy(update={"observation_space": space, "baked_in": (frozen, *contract.baked_in[1:])})
    file = io.StringIO()
    Console(width=80, file=file).print(contract_report(changed))
    shown = file.getvalue()
    rows = [line.split() for line in shown.splitlines()]
    for index, one in enumerate(ROBOT_NAMES):
        assert [str(index), one, "rad/s", "-6.283", "6.283", "-123.5", "0.001234"] in rows
    assert max(len(line.rstrip()) for line in shown.splitlines()) <= 80


def test_each_part_of_a_dict_shows_the_numbers_of_its_own_filter(
    zoo: Path, exported: Callable[..., ExportResult]
) -> None:
    contract = exported(zoo / "pendulum").contract
    box = BoxSpec(shape=(1,), dtype="float32", low=-1.0, high=1.0)
    step = contract.baked_in[0]
    filters = [
        step.model_copy(update={"values": {"mean": [mean], "std": [0.5], "leaf": f"obs.{part}"}})
        for part, mean in (("arm", 0.125), ("goal", 0.875))
    ]
    space = DictSpec(spaces={"arm": box, "goal": box})
    file = io.StringIO()
    changed = contract.model_copy(update={"observation_space": space, "baked_in": tuple(filters)})
    Console(width=80, file=file).print(contract_report(changed))
    rows = [line.split() for line in file.getvalue().splitlines()]
    assert ["0", "-1", "1", "0.125", "0.5"] in rows and ["0", "-1", "1", "0.875", "0.5"] in rows


def test_verify_looks_for_bounds_that_samples_seldom_reach(tmp_path: Path, notices: list[str]) -> None:
    """A policy beyond its bound for three observations in ten thousand, and a bundle that lost the bound."""
    sb3 = pytest.importorskip("stable_baselines3")
    onnx = pytest.importorskip("onnx")
    space = gymnasium.spaces.Box(-1, 1, (1,))
    env = pytest.importorskip("stable_baselines3.common.envs").IdentityEnvBox()
    env.observation_space = env.action_space = space
    model = sb3.PPO("MlpPolicy", env, policy_kwargs={"net_arch": [2]}, device="cpu", seed=0)
    weights = model.policy.state_dict()
    width = 3e-4  # tanh(x - a) - tanh(x - b): a peak between a and b
    weights["mlp_extractor.policy_net.0.weight"][:] = 5.0 / width
    weights["mlp_extractor.policy_net.0.bias"][:] = (
        5.0 / width * weights["mlp_extractor.policy_net.0.bias"].new_tensor([-0.3 + width, -0.3 - width])
    )
    weights["action_net.weight"][:] = weights["action_net.weight"].new_tensor([[0.75, -0.75]])
    model.policy.load_state_dict(weights)
    model.save(tmp_path / "model")
    bundle = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append).path
    verify_bundle(bundle, tmp_path / "model.zip", notify=notices.append)

    graph = onnx.load(bundle / "policy.onnx")
    (clip,) = (node for node in graph.graph.node if node.op_type == "Clip")
    (upper,) = (node for node in graph.graph.node if node.output[0] == clip.input[2])
    upper.attribute[0].t.CopyFrom(onnx.numpy_helper.from_array(np.float32(2.0)))
    onnx.save(graph, bundle / "policy.onnx")
    write_contract(bundle, read_contract(bundle))
    with pytest.raises(ParityError):
        verify_bundle(bundle, tmp_path / "model.zip", notify=notices.append)
