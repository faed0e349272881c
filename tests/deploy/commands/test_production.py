"""A policy folder with a plan, in process: what every command that takes a bundle folder takes of it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_box_policy
from command_line import rlservo_here
from rlservo.bundle.bundle import load_bundle
from rlservo.deploy.cockpit.policies import BundledPolicies, ServerLink
from rlservo.deploy.cockpit.run import first_choice
from rlservo.deploy.commands.rollout import acting_policy
from rlservo.errors import BundleError
from rlservo.policy.policy import Policy
from rlservo.recording.recorder import Recorder
from rlservo.recording.start import record_policy
from servers import served_in_thread

OBS = np.full(27, 0.5, np.float32)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """ur5 in 1, 2 and 10; the plan that `rlservo policy` wrote has 1 in production, after a rollback from 10."""
    root = tmp_path / "policies"
    for seed, version in enumerate(("1", "2", "10")):
        write_box_policy(root, version=version, seed=seed)
    for words in (("alias", "ur5", "production=1"), ("alias", "ur5", "production=10"), ("rollback", "ur5")):
        done = rlservo_here("policy", *words, "--repository", root)
        assert done.returncode == 0, done.stderr
    assert (root / ".plan").is_dir()
    return root


def served(version: str) -> dict[str, Any]:
    return {"policies": {"ur5": {"versions": ["1", "2", "10"], "aliases": {"production": version}}}}


@pytest.mark.parametrize("inside", ["", "ur5"])
def test_a_policy_folder_gives_its_production_version(repository: Path, inside: str) -> None:
    place = repository / inside
    by_hand = {version: Policy.load(repository / "ur5" / version).act(OBS) for version in ("1", "10")}
    for version, expected in ((None, "1"), ("newest", "10"), ("10", "10"), ("2", "2")):
        with Policy.load(place, version=version) as policy:
            assert policy.contract.version == expected
            assert expected == "2" or np.array_equal(policy.act(OBS), by_hand[expected])
    assert load_bundle(place).contract.version == "1"
    assert load_bundle(repository / "ur5" / "10").contract.version == "10"  # its own folder says it
    with pytest.raises(BundleError, match=r"has no version 3: expected newest or one of 1, 2, 10"):
        Policy.load(place, version="3")
    with pytest.raises(BundleError, match=r"is version 10, not 1"):
        Policy.load(repository / "ur5" / "10", version="1")


def test_a_link_to_a_policy_folder_gives_the_version_of_the_plan_beside_the_folder(
    repository: Path, tmp_path: Path
) -> None:
    link = tmp_path / "current"
    link.symlink_to(repository / "ur5")
    assert Policy.load(link).contract.version == "1"


def test_without_a_plan_it_is_the_newest(repository: Path) -> None:
    shutil.rmtree(repository / ".plan")
    assert Policy.load(repository / "ur5").contract.version == "10"


def test_a_plan_of_the_policys_own_folder_counts_and_one_that_contradicts_it_is_refused(
    repository: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shutil.move(repository / ".plan", repository / "ur5" / ".plan")  # as `rlservo serve policies/ur5` writes it
    assert Policy.load(repository / "ur5").contract.version == "1"
    assert rlservo_here("policy", "alias", "ur5", "production=2", "--repository", repository).returncode == 0
    with pytest.raises(BundleError, match=r"the production version of 'ur5' is 1 by .*/ur5/\.plan/.* and 2 by "):
        Policy.load(repository / "ur5")
    assert Policy.load(repository / "ur5", version="newest").contract.version == "10"
    elsewhere = tmp_path / "plans"
    shutil.copytree(repository / "ur5" / ".plan", elsewhere / ".plan")
    monkeypatch.setenv("RLSERVO_PLAN", str(elsewhere))
    assert Policy.load(repository / "ur5").contract.version == "1"


def test_plan_that_cannot_be_read_or_names_no_bundle_is_refused(repository: Path) -> None:
    newest = max((repository / ".plan").iterdir())
    shutil.rmtree(repository / "ur5" / "1")
    with pytest.raises(BundleError, match=rf"{newest} has version 1 of 'ur5' in production, which does not exist"):
        Policy.load(repository / "ur5")
    newest.write_text("{")
    with pytest.raises(BundleError, match=rf"{newest} is not a plan that can be read"):
        Policy.load(repository / "ur5")


def test_what_a_server_rolled_back_does_not_live_on_in_process(tmp_path: Path) -> None:
    root = tmp_path / "served"
    write_box_policy(root, version="1")
    with served_in_thread([root], settings={"plan": None}):
        pass  # its first start writes the plan
    write_box_policy(root, version="2", seed=1)
    assert Policy.load(root / "ur5").contract.version == "1"


def test_every_command_takes_the_production_version_and_says_so(repository: Path, tmp_path: Path) -> None:
    folder = repository / "ur5"
    shown = rlservo_here("inspect", folder, "--json")
    assert json.loads(shown.stdout)["version"] == "1"
    assert "version 1 is taken, which is in production; the newest is 10 (--version newest)" in shown.stderr
    assert json.loads(rlservo_here("inspect", folder, "--json", "--version", "newest").stdout)["version"] == "10"
    assert "is taken" not in rlservo_here("inspect", folder, "--version", "newest").stderr

    with Policy.load(folder / "1") as policy, Recorder(tmp_path / "run.mcap") as recorder:
        recorded = record_policy(policy, recorder, wait=True)
        for _ in range(5):
            recorded.act(OBS)
        recorded.end()
    replayed = json.loads(rlservo_here("replay", tmp_path / "run.mcap", "--bundle", folder, "--json").stdout)
    assert (replayed["compared"], replayed["changed"]) == (5, 0)
    newest = rlservo_here("replay", tmp_path / "run.mcap", "--bundle", folder, "--version", "newest", "--json")
    assert json.loads(newest.stdout)["changed"] == 5

    chosen: tuple[tuple[tuple[str, ...], str], ...] = (((), "1"), (("--version", "newest"), "10"))
    for words, version in chosen:
        done = rlservo_here("compile", folder, "--out", tmp_path / f"build{version}", *words, "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads((tmp_path / f"build{version}" / "contract.json").read_text())["version"] == version

    with acting_policy(None, None, folder, None, "http", None, False, None) as policy:  # of rollout and ros2
        assert policy.contract.version == "1"
    with acting_policy(None, None, folder, "newest", "http", None, False, None) as policy:
        assert policy.contract.version == "10"

    done = rlservo_here("publish", folder, tmp_path / "published", "--json")
    assert json.loads(done.stdout)["version"] == "1", done.stderr


def test_the_cockpit_begins_with_the_production_version(repository: Path) -> None:
    for place in (repository, repository / "ur5"):
        source = BundledPolicies(place)
        assert source.versions() == {"ur5": ["production", "10", "2", "1"]}
        choice = first_choice(source, None, None)
        with source.open(choice, None) as policy:  # type: ignore[arg-type]
            assert policy.contract.version == "1"
        newest = first_choice(source, None, "10")
        with source.open(newest, None) as policy:  # type: ignore[arg-type]
            assert policy.contract.version == "10"
    shutil.rmtree(repository / ".plan")
    assert BundledPolicies(repository).versions() == {"ur5": ["10", "2", "1"]}


def test_a_plan_in_the_users_state_counts_and_one_in_object_storage_is_named(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`rlservo serve` of folders that it cannot write, or that are not its first place."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    shutil.rmtree(repository / ".plan")
    first, folder = tmp_path / "first", repository / "ur5"
    write_box_policy(first, name="other")
    with served_in_thread([first, repository], settings={"plan": None}, served=served("2")):
        pass
    assert not (repository / ".plan").exists() and (first / ".plan").is_dir()
    for place in (repository, folder):
        assert Policy.load(place).contract.version == "2"
    assert BundledPolicies(repository).versions() == {"ur5": ["production", "10", "2", "1"]}
    assert len(list(tmp_path.glob("state/rlservo/plans/*.place"))) == 1
    shutil.rmtree(first)
    assert Policy.load(folder).contract.version == "10"  # nothing serves it any longer

    with monkeypatch.context() as only_readable:
        only_readable.setattr(os, "access", lambda *_: False)  # root may write everywhere
        with served_in_thread([folder], settings={"plan": None}, served=served("1")):
            pass
    assert not (folder / ".plan").exists()
    shown = rlservo_here("inspect", folder, "--json")
    assert json.loads(shown.stdout)["version"] == "1", shown.stderr

    for own in tmp_path.glob("state/rlservo/plans/*.place"):
        own.write_text("s3://bucket/policies")
    monkeypatch.setenv("RLSERVO_PLAN", "s3://bucket/plans")
    for place in ("s3://bucket/plans", "s3://bucket/policies"):
        with pytest.raises(BundleError, match=rf"the plan of 'ur5' is in {place}, which is not read in process"):
            Policy.load(folder)
        assert Policy.load(folder, version="newest").contract.version == "10"
        source = BundledPolicies(repository)
        assert first_choice(source, None, "2").version == "2"
        with pytest.raises(BundleError, match=rf"is in {place}"):
            source.open(first_choice(source, None, None), ServerLink())
        monkeypatch.delenv("RLSERVO_PLAN", raising=False)


@pytest.mark.parametrize(
    ("name", "fault"),
    [("9.json", "is not the file of a plan"), ("000000009.json", "does not follow plan 3"),
     ("999999999.json", "does not follow plan 3"), ("000000004.json", "holds plan 3, so it is a copy")],
)  # fmt: skip
def test_what_no_server_serves_is_no_plan_in_process(repository: Path, name: str, fault: str) -> None:
    shutil.copy(repository / ".plan" / "000000003.json", repository / ".plan" / name)
    with pytest.raises(BundleError, match=f"/.plan/{name} {fault}: move it away, no server serves it"):
        Policy.load(repository / "ur5")
