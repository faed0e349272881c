"""Policies of checkpoints with several agents, against what each agent saw and did in RLlib's own rollout."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.errors import CheckpointError, UnsupportedError, UsageError
from rlservo.export.checkpoints.location import MODULES, locate_checkpoint
from rlservo.export.export_checkpoint import ExportResult, export_all_modules, export_checkpoint
from rlservo.export.prune_checkpoint import prune_checkpoint
from rlservo.policy.policy import Policy

MODULE_OF = {"left": "arms", "right": "arms", "base": "wheels"}


def assert_acts_as_recorded(result: ExportResult, file: Path) -> None:
    seen = np.load(file)
    assert seen["restart"].sum() >= 3
    policy = Policy.load(result.path)
    for obs, action, restart in zip(seen["obs"], seen["action"], seen["restart"], strict=True):
        if restart:
            policy.reset()
        np.testing.assert_allclose(policy.act(obs), action, rtol=1e-5, atol=2e-6)


def test_every_module_is_exported_and_an_agent_with_a_filter_of_its_own_gets_a_bundle(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    results = export_all_modules(wide_zoo / "team", tmp_path, name="crew", app_dir=app, notify=notices.append)
    assert [str(result.path.relative_to(tmp_path)) for result in results] == [
        "crew-arms-left/1", "crew-arms-right/1", "crew-wheels/1",
    ]  # fmt: skip
    for agent, result in zip(("left", "right", "base"), results, strict=True):
        origin = result.contract.provenance
        assert (origin.module_id, origin.agents) == (MODULE_OF[agent], (agent,))
        assert result.contract.baked_in[0].step == "mean_std_filter"
        assert_acts_as_recorded(result, wide_zoo / f"team_{agent}.npz")
    assert [state.name for state in results[2].contract.state] == ["c", "h"]


def test_agents_that_are_treated_alike_share_a_bundle(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    result = export_checkpoint(wide_zoo / "plain_team", tmp_path, module_id="arms", app_dir=app, notify=notices.append)
    assert result.path == tmp_path / "team-arms" / "1"
    assert result.contract.provenance.agents == ("left", "right")
    for agent in ("left", "right"):
        assert_acts_as_recorded(result, wide_zoo / f"plain_team_{agent}.npz")


def test_an_agent_is_named_where_its_module_filters_others_differently(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    given: dict[str, Any] = {"module_id": "arms", "app_dir": app, "notify": notices.append}
    with pytest.raises(CheckpointError, match=r"serves the agents left, right, whose .* differ: name .* --agent-id"):
        export_checkpoint(wide_zoo / "team", tmp_path / "out", **given)
    with pytest.raises(CheckpointError, match="serves no agent 'base': it serves left, right"):
        export_checkpoint(wide_zoo / "team", tmp_path / "out", agent_id="base", **given)
    assert not (tmp_path / "out").exists()
    result = export_checkpoint(wide_zoo / "team", tmp_path, agent_id="right", **given)
    assert_acts_as_recorded(result, wide_zoo / "team_right.npz")


def test_one_of_several_modules_has_to_be_named(wide_zoo: Path, zoo: Path, app: Path, notices: list[str]) -> None:
    with pytest.raises(
        CheckpointError, match=r"holds 2 modules \(arms, wheels\): name .* --module-id, .*--all-modules"
    ):
        locate_checkpoint(wide_zoo / "team")
    assert locate_checkpoint(wide_zoo / "team" / MODULES / "arms").module_id == "arms"
    with pytest.raises(CheckpointError, match="trained with one agent: leave --agent-id out"):
        export_checkpoint(zoo / "cart_pole", "unused", agent_id="left", app_dir=app, notify=notices.append)


def test_modules_that_may_decide_together_are_refused_by_name(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    with pytest.raises(UnsupportedError, match="parts of a Committee, whose forward pass may mix them"):
        export_all_modules(wide_zoo / "committee", tmp_path / "out", app_dir=app, notify=notices.append)
    assert not (tmp_path / "out").exists()


def test_all_modules_are_written_or_none(wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]) -> None:
    damaged = Path(shutil.copytree(wide_zoo / "plain_team", tmp_path / "damaged"))
    weights = damaged / MODULES / "wheels" / "module_state.pkl"  # the last to be exported
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(CheckpointError, match="truncated or damaged"):
        export_all_modules(damaged, tmp_path / "out", app_dir=app, notify=notices.append)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out" / "team-wheels" / "7").mkdir(parents=True)
    with pytest.raises(UsageError, match="already exists"):
        export_all_modules(wide_zoo / "plain_team", tmp_path / "out", version="7", app_dir=app, notify=notices.append)
    assert [str(path.relative_to(tmp_path / "out")) for path in sorted((tmp_path / "out").rglob("*"))] == [
        "team-wheels", "team-wheels/7",
    ]  # fmt: skip


def test_a_pruned_module_of_several_exports_to_the_same_policy(
    wide_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    given: dict[str, Any] = {"app_dir": app, "notify": notices.append}
    prune_checkpoint(wide_zoo / "plain_team", tmp_path / "small", module_id="arms", **given)
    assert not (tmp_path / "small" / MODULES / "wheels").exists()
    whole = export_checkpoint(wide_zoo / "plain_team", tmp_path / "whole", module_id="arms", **given).contract
    pruned = export_checkpoint(tmp_path / "small", tmp_path / "pruned", **given).contract
    now = {"exported_at": whole.provenance.exported_at}
    assert pruned.model_copy(update={"provenance": pruned.provenance.model_copy(update=now)}) == whole


def test_every_policy_of_the_old_stack_is_exported(
    old_zoo: Path, app: Path, tmp_path: Path, notices: list[str]
) -> None:
    results = export_all_modules(old_zoo / "several", tmp_path, app_dir=app, notify=notices.append)
    assert [result.contract.name for result in results] == ["old-pair-arm", "old-pair-cart"]
    for result, agent in zip(results, ("arm", "cart"), strict=True):
        assert_acts_as_recorded(result, old_zoo / f"several_{agent}.npz")
