"""Bundles that are served, and then evaluated by `rlservo verify`: the plan goes with the contract."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from command_line import rlservo_here
from rlservo.bundle.bundle import read_contract
from rlservo.policy.policy import Policy
from servers import ROOT, ask, served_in_thread
from waiting import wait_for

REACH = ("--env", "rlservo/EndEffectorPositioningURSim-v0")
EVALUATE = (*REACH, "--disturb", "latency=1", "--write", "--episodes", 1)
OBS = np.full(27, 0.1, np.float32)


@pytest.fixture
def repository(shipped: Path, tmp_path: Path) -> Path:
    """The shipped arm policy, to be written to."""
    shutil.copytree(shipped / "ur5", tmp_path / "policies" / "ur5")
    return tmp_path / "policies"


def start(place: Path, plans: Path) -> list[float]:
    """Start a server of a place whose plan is kept in `plans`; return its action, and end it."""
    with served_in_thread([place], settings={"plan": str(plans)}) as port:
        status, reply = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS.tolist()})
        assert status == 200, reply
        return list(reply["action"])


@pytest.mark.parametrize("inside", ["", "ur5", "ur5/1"])
def test_a_policy_that_was_served_starts_again_after_an_evaluation(
    repository: Path, inside: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, state = repository / inside, tmp_path / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    assert rlservo_here("policy", "alias", "ur5", "production=1", "--repository", place).returncode == 0
    (plans,) = [*repository.rglob(".plan"), *state.rglob(".plan")]
    before = start(place, plans.parent)
    (signature := repository / "ur5" / "1" / "model.sig").write_text("{}")  # of what is signed now
    evaluated = rlservo_here("verify", repository / "ur5" / "1", *EVALUATE)
    assert evaluated.returncode == 0, evaluated.stderr
    assert "evaluations and is removed" in " ".join(evaluated.stderr.split())
    assert not signature.exists()
    assert str(plans) in evaluated.stderr
    assert len(read_contract(repository / "ur5" / "1").evaluations) == 2
    assert start(place, plans.parent) == before
    again = rlservo_here("verify", repository / "ur5", *EVALUATE)  # through the plan, that now has the new hash
    assert again.returncode == 0, again.stderr
    assert start(place, plans.parent) == before
    assert len(list(plans.glob("*.json"))) == 3


def test_a_comparison_with_the_checkpoint_is_followed_too_and_a_rollback_to_the_bundle_works(repository: Path) -> None:
    for words in (
        ("export", ROOT / "examples/checkpoints/ur5_positioning", "--out", repository, "--name", "ur5"),
        ("policy", "alias", "ur5", "production=1", "--repository", repository),
        ("policy", "alias", "ur5", "production=2", "--repository", repository),
        ("policy", "unload", "ur5", "1", "--repository", repository),
        ("verify", repository / "ur5" / "1", "--checkpoint", ROOT / "examples/checkpoints/ur_positioning",
         *REACH, "--episodes", 1),
        ("policy", "rollback", "ur5", "--repository", repository),
    ):  # fmt: skip
        done = rlservo_here(*words)
        assert done.returncode == 0, done.stderr
    with Policy.load(repository / "ur5" / "1") as policy:
        assert start(repository, repository) == pytest.approx(policy.act(OBS).tolist())


def test_a_running_server_takes_the_evaluated_bundle_and_fails_no_request(repository: Path) -> None:
    with served_in_thread([repository], settings={"plan": str(repository)}) as port:
        first = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS.tolist()})[1]["action"]
        assert rlservo_here("verify", repository / "ur5" / "1", *EVALUATE).returncode == 0
        (newest,) = sorted((repository / ".plan").glob("*.json"))[1:]
        digest = json.loads(newest.read_text())["policies"]["ur5"]["versions"]["1"]

        def served() -> bool:
            status, reply = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS.tolist()})
            assert (status, reply["action"]) == (200, first)
            return bool(ask(port, "GET", "/v1/policies/ur5")[1]["evaluations"])

        wait_for(served, "the contract with its evaluations")
        with Policy.load(repository / "ur5" / "1") as policy:
            assert policy.digest == digest


def test_without_a_plan_none_is_written(repository: Path) -> None:
    assert rlservo_here("verify", repository / "ur5" / "1", *EVALUATE).returncode == 0
    assert not (repository / ".plan").exists()
