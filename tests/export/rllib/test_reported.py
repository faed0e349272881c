"""Checkpoints of the kinds that users reported, against what RLlib did in its own rollout."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from command_line import rlservo_here
from rlservo.bundle.bundle import read_contract
from rlservo.bundle.spaces import DictSpec
from rlservo.errors import CheckpointError, ObservationError, UnsupportedError
from rlservo.export.checkpoints.unpickle import unpickle
from rlservo.export.export_checkpoint import ExportResult, export_all_modules, export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.export.recipe.recipe import Recipe, StateLeaf
from rlservo.export.recipe.samples import draw_batches
from rlservo.export.rllib.new_stack import policy as new_stack
from rlservo.export.verify_bundle import verify_bundle
from rlservo.policy.policy import Policy

pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")


@pytest.fixture
def export(reported_zoo: Path, app: Path, tmp_path: Path, notices: list[str]) -> Callable[..., ExportResult]:
    def export(name: str, **options: Any) -> ExportResult:
        out = tmp_path / "out"
        return export_checkpoint(reported_zoo / name, out, app_dir=app, notify=notices.append, **options)

    return export


def observation(seen: Mapping[str, Any], step: int) -> Any:
    """Return what the environment gave: nested by the columns' names, a Tuple as a list."""
    if "obs" in seen:
        return seen["obs"][step]
    nested: dict[str, Any] = {}
    for name in (name for name in seen if name.startswith("obs.")):
        *folders, leaf = name.split(".")[1:]
        part = nested
        for folder in folders:
            part = part.setdefault(folder, {})
        part[leaf] = seen[name][step]
    return {key: list(part.values()) if key == "pair" else part for key, part in nested.items()}


def assert_acts_as_recorded(result: ExportResult, file: Path) -> None:
    seen, policy = dict(np.load(file)), Policy.load(result.path)
    for step, restart in enumerate(seen["restart"]):
        if restart:
            policy.reset()
        np.testing.assert_allclose(policy.act(observation(seen, step)), seen["action"][step], rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize(
    "name",
    [
        "asymmetric", "critic_in_training", "partly_read", "removed_key", "infinite_buffers", "image_lstm", "unusual",
        "uint32", "previous_actions",
    ],
)  # fmt: skip
def test_the_export_acts_as_rllib_did(reported_zoo: Path, export: Callable[..., ExportResult], name: str) -> None:
    assert_acts_as_recorded(export(name, value=name != "asymmetric"), reported_zoo / f"{name}.npz")


@pytest.mark.parametrize(("name", "kind"), [
    ("trains_otherwise", "TrainsOtherwise"), ("takes_its_argument", "TakesItsArgument"),
])  # fmt: skip
def test_a_module_that_acts_otherwise_in_rllibs_actors_is_refused(
    reported_zoo: Path, app: Path, tmp_path: Path, export: Callable[..., ExportResult], name: str, kind: str
) -> None:
    with pytest.raises(UnsupportedError, match=f"{kind} acts differently when it is built for inference only, from"):
        export(name)
    prune_checkpoint(reported_zoo / name, tmp_path / "pruned", app_dir=app, notify=lambda _: None)
    with pytest.raises(UnsupportedError, match=f"{kind} acts differently"):
        export_checkpoint(tmp_path / "pruned", tmp_path / "out", name="arm", app_dir=app, notify=lambda _: None)


def test_the_contract_says_that_the_actors_module_could_not_be_built(
    export: Callable[..., ExportResult], monkeypatch: pytest.MonkeyPatch, notices: list[str]
) -> None:
    def fail(*_: Any) -> Any:
        raise ValueError("no such file")

    monkeypatch.setattr(new_stack, "build_actor", fail)
    reference = export("critic_in_training").contract.parity.reference
    assert "the whole RLModule (it could not be built for inference only, as RLlib's actors" in reference
    assert "as RLlib's actors build it (no such file)" in " ".join(notices)


def test_a_network_that_reads_parts_in_their_order_is_given_rllibs(
    reported_zoo: Path, export: Callable[..., ExportResult]
) -> None:
    assert_acts_as_recorded(export("in_order"), reported_zoo / "in_order.npz")
    assert_acts_as_recorded(export("out_of_order_flat"), reported_zoo / "out_of_order_flat_robot.npz")


def test_a_network_that_reads_parts_in_the_environments_order_is_refused(
    export: Callable[..., ExportResult],
) -> None:
    with pytest.raises(UnsupportedError, match=r"changes from .* when its keys come in the opposite order"):
        export("out_of_order")


def test_a_connector_that_reads_other_agents_is_refused_for_those_it_changes(
    reported_zoo: Path, export: Callable[..., ExportResult]
) -> None:
    with pytest.raises(UnsupportedError, match=r"acts differently for agent left when other agents act too: a served"):
        export("sees_the_base_team", module_id="arms")
    result = export("sees_the_base_team", module_id="wheels")
    assert_acts_as_recorded(result, reported_zoo / "sees_the_base_team_base.npz")


@pytest.mark.parametrize("name", ["asymmetric", "removed_key"])
def test_a_part_that_nothing_reads_is_not_asked_for_and_may_be_given(
    reported_zoo: Path, export: Callable[..., ExportResult], app: Path, name: str
) -> None:
    result = export(name, value=name != "asymmetric")
    space = result.contract.observation_space
    assert [tensor.name for tensor in result.contract.inputs] == ["obs.actor"]
    assert isinstance(space, DictSpec) and (list(space.spaces), space.ignored) == (["actor"], ("critic",))
    assert "obs.critic" in next(step for step in result.contract.baked_in if step.step == "ignored").detail
    policy, actor = Policy.load(result.path), np.array([0.1, -0.2, 0.3], np.float32)
    alone = policy.act({"actor": actor})
    np.testing.assert_array_equal(policy.act({"actor": actor, "critic": np.zeros(2, np.float32)}), alone)
    with pytest.raises(ObservationError, match="unknown critics"):
        policy.act({"actor": actor, "critics": 0.0})
    verified = verify_bundle(result.path, reported_zoo / name, app_dir=app, notify=lambda _: None)
    assert verified.same_checkpoint


def test_a_tuple_keeps_a_part_that_nothing_reads(export: Callable[..., ExportResult]) -> None:
    contract = export("partly_read").contract
    assert [tensor.name for tensor in contract.inputs] == ["obs.arm.angles", "obs.pair.0", "obs.pair.1"]


def test_a_part_that_only_the_value_head_reads_can_be_left_out_with_it(
    reported_zoo: Path, app: Path, tmp_path: Path
) -> None:
    for option, asked in (("--value", ["obs.actor", "obs.critic"]), ("--no-value", ["obs.actor"])):
        done = rlservo_here(
            "export", reported_zoo / "asymmetric", "--out", tmp_path / option, "--name", "arm", "--app-dir", app, option
        )
        assert done.returncode == 0, done.stderr
        assert [tensor.name for tensor in read_contract(tmp_path / option / "arm" / "1").inputs] == asked
        assert ("only the value head reads it" in " ".join(done.stderr.split())) == (option == "--value")


def test_the_memory_of_a_policy_of_images_is_proven_in_fewer_steps() -> None:
    action, state = Box(-1.0, 1.0, (2,), np.float32), (StateLeaf("h", np.zeros(8, np.float32)),)
    small, large = (
        Recipe(Box(0.0, 1.0, shape, np.float32), action, (), "mean", "none", "diag_gaussian", state)
        for shape in ((3,), (96, 96, 3))
    )
    few, many = draw_batches(large, seed=0), draw_batches(small, seed=0)
    assert len(few) < 40 < len(many)
    for batches in (few, many):
        for size in (1, 2, 257):
            restarts = [batch.restart for batch in batches if len(batch) == size]
            assert all(restart is not None for restart in restarts)
            assert np.all(restarts[0]) and not np.all(restarts[1])  # some go on with their state
    assert {batch.kind for batch in few} == {batch.kind for batch in many} == {"likely", "wide", "extreme"}
    assert sum(len(batch) for batch in many) > 1400
    pairs = np.stack([batch.restart for batch in many if batch.restart is not None and len(batch) == 2])
    last = np.flatnonzero(pairs[:, 0])[-1]
    assert len(pairs) - last > 90 and pairs[last + 1 :, 1].any()  # one row remembers, the other begins again beside it


def test_connectors_that_an_environment_elsewhere_has_are_built_from_the_configuration(
    reported_zoo: Path, tmp_path: Path, notices: list[str]
) -> None:
    code = reported_zoo.parent  # no code of the user's own is needed
    result = export_checkpoint(
        reported_zoo / "external", tmp_path / "out", name="x", app_dir=code, notify=notices.append
    )
    assert "are built from its configuration" in " ".join(notices)
    assert [step.step for step in result.contract.baked_in] == ["network", "mode", "unsquash"]


def test_a_module_that_was_added_in_training_has_its_originals_spaces(
    reported_zoo: Path, export: Callable[..., ExportResult]
) -> None:
    for module, agent in (("main", "left"), ("main_v1", "right")):
        result = export("self_play", module_id=module)
        assert agent in result.contract.provenance.agents
        assert_acts_as_recorded(result, reported_zoo / f"self_play_{agent}.npz")


def test_all_modules_leave_a_script_out_and_say_so(
    reported_zoo: Path, app: Path, tmp_path: Path, notices: list[str], export: Callable[..., ExportResult]
) -> None:
    results = export_all_modules(
        reported_zoo / "self_play", tmp_path / "all", name="duel", app_dir=app, notify=notices.append
    )
    assert [result.contract.name for result in results] == ["duel-main", "duel-main_v1"]
    assert any("module 'script' is left out: module RandomRLModule is not" in notice for notice in notices)
    with pytest.raises(UnsupportedError, match="RandomRLModule is not a torch RLModule"):
        export("self_play", module_id="script")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("main_connector", r"TenTimes \(__main__\) .* holds the class as the script had it, so restore and save it"),
        ("huge_action", r"unsquashing to the bounds of Box\(-3\.4.* overflows, .*: give the environment real bounds"),
    ],
)
def test_a_refusal_says_what_to_do(export: Callable[..., ExportResult], name: str, words: str) -> None:
    with pytest.raises(UnsupportedError, match=words):
        export(name)


def test_a_buffer_that_is_no_number_shows_that_training_diverged(
    reported_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    damaged = Path(shutil.copytree(reported_zoo / "infinite_buffers", tmp_path / "damaged"))
    file = damaged / "learner_group/learner/rl_module/default_policy/module_state.pkl"
    state = unpickle(file)
    state["low"][0] = np.nan
    file.write_bytes(pickle.dumps(state))
    with pytest.raises(CheckpointError, match="'low' are not all finite: training diverged"):
        export_checkpoint(damaged, tmp_path / "out", app_dir=app, notify=notices.append)
