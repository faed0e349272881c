"""A user's own connectors: right in the bundle or refused, against runners that RLlib restored from the checkpoints.

RLlib's list of a connector's arguments is often wrong, and it restores by the configuration.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.errors import AgentsDifferError, CheckpointError, ParityError, UnsupportedError
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.export.rllib.new_stack import pipelines
from rlservo.export.rllib.restore import restore
from rlservo.policy.policy import Policy

pytestmark = pytest.mark.filterwarnings("ignore:.*PPOTorchRLModule.*:DeprecationWarning")
TOLERANCE: dict[str, Any] = {"rtol": 1e-5, "atol": 2e-6}


@pytest.fixture
def export(app: Path, tmp_path: Path, notices: list[str]) -> Callable[..., ExportResult]:
    def export(checkpoint: Path, **options: Any) -> ExportResult:
        return export_checkpoint(checkpoint, tmp_path / "out", app_dir=app, notify=notices.append, **options)

    return export


def assert_acts_as_restored(result: ExportResult, file: Path) -> None:
    seen, policy = np.load(file), Policy.load(result.path)
    assert seen["restart"].sum() >= 3
    for obs, action, restart in zip(seen["obs"], seen["action"], seen["restart"], strict=True):
        if restart:
            policy.reset()
        np.testing.assert_allclose(policy.act(obs), action, **TOLERANCE)


@pytest.mark.parametrize("name", ["sound", "sound_action", "closure", "applied", "of_the_spaces", "in_the_middle"])
def test_connectors_whose_arguments_rllib_recorded_rightly_are_exported(
    connector_zoo: Path, export: Callable[..., ExportResult], name: str
) -> None:
    result = export(connector_zoo / name)
    assert "as Algorithm.from_checkpoint builds them from the configuration" in result.contract.parity.reference
    assert_acts_as_restored(result, connector_zoo / f"{name}.npz")


def test_connectors_of_several_agents_are_exported(connector_zoo: Path, export: Callable[..., ExportResult]) -> None:
    for module, agents in (("arms", ("left", "right")), ("wheels", ("base",))):
        result = export(connector_zoo / "sound_team", module_id=module)
        for agent in agents:
            assert_acts_as_restored(result, connector_zoo / f"sound_team_{agent}.npz")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "inherited",
            r"env-to-module connector zoo_connectors\.Inherited has gain=3\.0 .* and gain=1\.0",
        ),
        ("inherited_action", r"module-to-env connector zoo_connectors\.InheritedAction has gain=0\.3 .* and gain=1\.0"),
        ("inherited_in_the_middle", r"zoo_connectors\.Inherited has gain=3\.0 .* and gain=1\.0"),
        ("attribute", r"zoo_connectors\.Gain has gain=3\.0 .* and gain=1\.0"),
        ("attribute_action", r"zoo_connectors\.ActionGain has gain=0\.3 .* and gain=1\.0"),
        (
            "attribute_of_rllibs",
            r"mean_std_filter\.MeanStdFilter has clip_by_value=0\.5 .* and clip_by_value=10\.0 .* two checkpoints, or",
        ),
        ("converted", r"zoo_connectors\.Converted has gain=6\.0 .* and gain=12\.0"),
        ("converted_action", r"zoo_connectors\.ConvertedAction has gain=0\.6 .* and gain=1\.2"),
        (
            "added",
            r"connectors are ray.* configuration, and zoo_connectors\.Gain, ray.* RLlib saved",
        ),
    ],
)
def test_a_list_that_is_not_the_configurations_is_refused_by_both(
    connector_zoo: Path, export: Callable[..., ExportResult], tmp_path: Path, name: str, words: str
) -> None:
    with pytest.raises(UnsupportedError, match=words):
        export(connector_zoo / name)
    assert not (tmp_path / "out").exists()


def test_it_is_refused_for_every_agent(connector_zoo: Path, export: Callable[..., ExportResult]) -> None:
    for module in ("arms", "wheels"):
        with pytest.raises(UnsupportedError, match=r"zoo_connectors\.Inherited has gain=3\.0 .* and gain=1\.0"):
            export(connector_zoo / "inherited_team", module_id=module)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "renamed",
            r"env_to_module_connector cannot be restored: .* argument 'gain'; RLlib acts by .* give the class",
        ),
        (
            "of_the_environment",
            r"would: the function reads the environment's 'envs', .* argument 'spaces'",
        ),
        ("of_the_environment_or_not", r"the function reads the environment's 'envs', .* argument 'spaces'"),
    ],
)
def test_connectors_that_cannot_be_made_are_refused_by_the_reason(
    connector_zoo: Path, export: Callable[..., ExportResult], name: str, words: str
) -> None:
    with pytest.raises(CheckpointError, match=words):
        export(connector_zoo / name)


@pytest.mark.parametrize("name", ["by_agent_team", "action_by_agent_team"])
def test_a_connector_that_knows_its_agents_is_exported_for_the_one_that_is_named(
    connector_zoo: Path, export: Callable[..., ExportResult], name: str
) -> None:
    with pytest.raises(AgentsDifferError, match=r"agents left and right, and a connector .*--agent-id"):
        export(connector_zoo / name, module_id="arms")
    result = export(connector_zoo / name, module_id="arms", agent_id="left")
    assert_acts_as_restored(result, connector_zoo / f"{name}_left.npz")
    # What the connector does for the other is not what its torch_forward does.
    with pytest.raises(ParityError, match=r"torch_forward of zoo_connectors\.\w+ must do what .* for this agent"):
        export(connector_zoo / name, module_id="arms", agent_id="right")


def test_an_env_runner_of_ones_own_is_refused(connector_zoo: Path, export: Callable[..., ExportResult]) -> None:
    with pytest.raises(UnsupportedError, match=r"its env runner is zoo_connectors\.HalvingRunner"):
        export(connector_zoo / "own_runner")


def test_callbacks_of_ones_own_are_named(
    connector_zoo: Path, export: Callable[..., ExportResult], notices: list[str]
) -> None:
    assert_acts_as_restored(export(connector_zoo / "called_back"), connector_zoo / "called_back.npz")
    assert any("what Callbacks of your own may change" in notice for notice in notices)
    notices.clear()
    export(connector_zoo / "sound")
    assert not any("of your own may change" in notice for notice in notices)


REMEMBERING = ["difference", "steps", "rewarded", "last_action", "beside", "shared", "action_steps"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((name, r"reads the episode's length at .*zoo_connectors\.py:\d+") for name in (
            "difference", "difference_team", "steps", "rewarded", "last_action", "action_steps",
            "steps_later", "steps_later_team", "action_steps_later",
        )),
        ("beside", r"connector Beside \(zoo_connectors\) reads the last step's rewards"),
        ("rewarded_later", "reads the last step's rewards"),
        ("shared", r"connector Shared \(zoo_connectors\) uses 'shared_data'"),
        ("shared_later", "uses 'shared_data'"),
        ("counting", "changes its 'count' each time it acts"),
        ("in_itself_later", "changes its 'count' each time it acts"),
        ("in_its_class_later", "changes its 'count' each time it acts"),
        ("in_a_global_later", "changes its 'zoo_connectors.CALLS.global' each time it acts"),
        ("in_a_closure_later", "changes its 'count.count' each time it acts"),
    ],
)  # fmt: skip
def test_connectors_that_remember_earlier_steps_are_refused(
    connector_zoo: Path, export: Callable[..., ExportResult], name: str, words: str
) -> None:
    with pytest.raises(UnsupportedError, match=words):
        export(connector_zoo / name, module_id="arms" if "team" in name else None)


def test_connectors_that_read_the_environments_info_are_refused(
    connector_zoo: Path, export: Callable[..., ExportResult]
) -> None:
    with pytest.raises(UnsupportedError, match="a connector reads the environment's info, which a served"):
        export(connector_zoo / "informed")


@pytest.mark.parametrize("name", ["sound", "in_the_middle", "sound_action", *REMEMBERING])
def test_the_gates_reference_acts_over_episodes_as_rllib_did(
    connector_zoo: Path, app: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for watched in ("Watched", "watch"):
        monkeypatch.setattr(pipelines, watched, lambda one: one)
    seen = np.load(connector_zoo / f"{name}.npz")
    assert seen["restart"].sum() >= 3
    with user_code(app):
        restored = restore(locate_checkpoint(connector_zoo / name), app, lambda _: None)
    for _ in range(2):  # a loop remembers nothing of the one before
        loop = restored.start_loop()
        for step, restart in enumerate(seen["restart"]):
            if name in ("shared", "action_steps") and restart and step:
                break  # RLlib runs both also on the end of an episode, of which no action is sent
            inputs = {"obs": seen["obs"][[step]], "reward": np.float32(seen["reward"][[step]])}
            found = loop.step(inputs, np.array([restart]))
            np.testing.assert_allclose(found["action"][0], seen["action"][step], rtol=1e-5, atol=5e-6)


def test_a_pruned_copy_keeps_the_configuration_that_its_own_connectors_need(
    connector_zoo: Path, app: Path, tmp_path: Path, export: Callable[..., ExportResult], notices: list[str]
) -> None:
    for name in ("inherited", "sound"):
        prune_checkpoint(connector_zoo / name, tmp_path / name, app_dir=app, notify=notices.append)
        whole, pruned = (locate_checkpoint(folder / name) for folder in (connector_zoo, tmp_path))
        assert pruned.sha256() == whole.sha256()
    with pytest.raises(UnsupportedError, match=r"gain=3\.0 .* and gain=1\.0"):
        export(tmp_path / "inherited")
    result = export(tmp_path / "sound")
    assert_acts_as_restored(result, connector_zoo / "sound.npz")
    assert not [notice for notice in notices if "NOT proven" in notice]


def test_a_copy_without_the_configuration_says_what_was_not_proven(
    connector_zoo: Path, tmp_path: Path, export: Callable[..., ExportResult], notices: list[str]
) -> None:
    copy = Path(shutil.copytree(connector_zoo / "sound", tmp_path / "copy"))
    (copy / "class_and_ctor_args.pkl").unlink()
    result = export(copy)
    assert "as the checkpoint lists them (without the algorithm's configuration" in result.contract.parity.reference
    assert any("connectors of your own and no configuration" in notice for notice in notices)
