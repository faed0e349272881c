"""Several processes that follow one plan in a repository, with real bundles."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_box_policy, write_discrete_policy
from rlservo.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.engines.server_process import repeat
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.versions.deployment_plan import Plan
from rlservo.serve_app.versions.plan_commands import Load, Rollback, SetAlias, SetCanary, SetShadow, Unload
from rlservo.serve_app.versions.plan_files import FOLDER, PlanFiles
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.version_loader import VersionLoader
from waiting import until

OBS = np.zeros(27, np.float32) + 0.1


class Fleet:
    """Processes that share a plan. Each has folders of its own, as on several nodes."""

    def __init__(self, plans: Path, *folders: Path) -> None:
        self.plans = plans
        self.controls = [self.start(folder, f"r{n}") for n, folder in enumerate(folders)]

    def start(self, folder: Path, name: str) -> PlanFollower:
        return PlanFollower(VersionLoader(Repository([folder])), self.files)

    @property
    def files(self) -> PlanFiles:
        return PlanFiles([], root=str(self.plans))

    async def deploy(self, document: Any) -> None:
        for control in self.controls:
            await control.configure(document)

    async def follow(self) -> None:
        for control in self.controls:
            await control.follow()

    def look_together(self) -> None:
        """Let the next command of each process look at the plan before any of them writes."""
        have_looked = threading.Barrier(len(self.controls), timeout=20)

        def look(files: PlanFiles) -> Plan | None:
            del files.newest  # the next looks are its own
            plan = files.newest()
            have_looked.wait()
            return plan

        for control in self.controls:
            control.files.newest = partial(look, control.files)  # type: ignore[method-assign]

    def defaults(self) -> list[str]:
        return [control.store.default("ur5") if control.store else "" for control in self.controls]

    def numbers(self) -> set[int]:
        return {control.plan.generation for control in self.controls if control.plan}


def config(*versions: str, production: str, **more: Any) -> dict[str, Any]:
    return {
        "policies": {"ur5": {"versions": list(versions), "aliases": {"production": production}, **more}},
        "unlisted": "ignore",
    }


def aliasing(version: str, alias: str = "production") -> SetAlias:
    return SetAlias(alias=alias, version=version)


@pytest.fixture
def folder(policies: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(policies, tmp_path / "node", ignore=shutil.ignore_patterns(FOLDER)))


def break_weights(folder: Path, version: str) -> None:
    (folder / "ur5" / version / "policy.onnx").write_bytes(b"nothing")


def test_a_change_is_served_by_who_took_it_when_it_answers_and_by_the_others_within_a_second(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder, folder, folder)
        await fleet.deploy(config("1", production="1"))
        first, second, third = fleet.controls
        polls = [
            asyncio.create_task(repeat(control.files.poll_s, control.follow, "the plan cannot be followed"))
            for control in (second, third)
        ]
        held = second.store
        await first.give(Load(version="2"), "ur5")
        plan = await first.give(aliasing("2"), "ur5")
        assert fleet.defaults()[0] == "2" and first.plan == plan and plan.generation == 3
        began = asyncio.get_running_loop().time()
        await until(lambda: fleet.defaults() == ["2", "2", "2"])
        assert asyncio.get_running_loop().time() - began < 1.5  # on a busy machine
        assert held is not None and held.default("ur5") == "1"  # a request that began with the old store ends with it
        held.get("ur5").act(OBS)
        assert fleet.numbers() == {3}
        for poll in polls:
            poll.cancel()

    asyncio.run(run())
    files = sorted((folder / FOLDER).iterdir())
    assert [file.name for file in files] == ["000000001.json", "000000002.json", "000000003.json"]
    assert [json.loads(file.read_text())["changed_by"] for file in files] == [
        "configuration",
        "load ur5 2",
        "alias ur5 production=2",
    ]


def test_of_two_operators_at_once_one_wins_and_the_other_is_told(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder, folder, folder)
        await fleet.deploy(config("1", "2", "10", production="1"))
        fleet.look_together()
        versions = ("2", "10", "10")  # two of the three want the same
        outcomes = await asyncio.gather(
            *(
                control.give(aliasing(version), "ur5")
                for control, version in zip(fleet.controls, versions, strict=True)
            ),
            return_exceptions=True,
        )
        await fleet.follow()
        (won,) = set(fleet.defaults())
        for version, outcome in zip(versions, outcomes, strict=True):
            if version == won:
                assert isinstance(outcome, Plan)
            else:
                assert isinstance(outcome, ConflictError)
                assert f"another command came first (plan 2: alias ur5 production={won})" in outcome.message
        assert fleet.numbers() == {2}

    asyncio.run(run())


def test_two_operators_that_roll_back_at_once_go_back_once(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder, folder)
        await fleet.deploy(config("1", "2", "10", production="1"))
        for version in ("2", "10"):
            await fleet.controls[0].give(aliasing(version), "ur5")
        await fleet.follow()
        fleet.look_together()
        await asyncio.gather(*(control.give(Rollback(), "ur5") for control in fleet.controls))
        await fleet.follow()
        assert fleet.defaults() == ["2", "2"] and fleet.numbers() == {4}

    asyncio.run(run())


def test_changes_of_different_things_at_once_are_all_made(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder, folder)
        await fleet.deploy({})
        first, second = fleet.controls
        await asyncio.gather(
            first.give(aliasing("1", "candidate"), "ur5"),
            second.give(aliasing("2", "old"), "ur5"),
            first.give(SetShadow(version="2"), "ur5"),
            second.give(aliasing("1", "candidate"), "gridworld"),
        )
        await fleet.follow()
        assert fleet.numbers() == {5}
        for control in fleet.controls:
            assert control.plan is not None
            ur5, gridworld = control.plan.policies["ur5"], control.plan.policies["gridworld"]
            assert (ur5.aliases["candidate"], ur5.aliases["old"], ur5.shadow) == ("1", "2", "2")
            assert gridworld.aliases["candidate"] == "1"

    asyncio.run(run())


def test_a_command_that_another_overtakes_while_it_looks_is_carried_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy({})
        (control,) = fleet.controls
        looked, go_on, newest = threading.Event(), threading.Event(), control.files.newest

        def slow() -> Plan | None:
            plan = newest()
            if not looked.is_set():
                looked.set()
                assert go_on.wait(20)
            return plan

        monkeypatch.setattr(control.files, "newest", slow)
        overtaken = asyncio.create_task(control.give(aliasing("1", "candidate"), "ur5"))
        await until(looked.is_set)
        await control.give(SetShadow(version="2"), "ur5")
        go_on.set()
        ur5 = (await overtaken).policies["ur5"]
        assert (ur5.aliases["candidate"], ur5.shadow) == ("1", "2")

    asyncio.run(run())


def test_a_version_that_fails_is_refused_before_anything_is_written(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("1", production="1"))
        (control,) = fleet.controls
        break_weights(folder, "2")
        with pytest.raises(RefusedError, match=r"nothing has changed: .*policy.onnx is not the file") as caught:
            await control.give(Load(version="2"), "ur5")
        assert caught.value.details["versions"][0]["version"] == "2"
        assert fleet.numbers() == {1} and len(list((folder / FOLDER).iterdir())) == 1
        assert control.states()["ur5"]["1"].state == "ready" and control.states()["ur5"]["1"].loaded_at is not None
        with pytest.raises(ConflictError):
            await control.give(Unload(version="1"), "ur5")
        await control.give(aliasing("1"), "ur5")  # as it is: nothing to write
        assert fleet.numbers() == {1} and len(list((folder / FOLDER).iterdir())) == 1

    asyncio.run(run())


def test_golden_vectors_that_are_not_reproduced_refuse_a_version(folder: Path, tmp_path: Path) -> None:
    other = write_box_policy(tmp_path / "other", version="11", seed=5)
    target = Path(shutil.copytree(folder / "ur5" / "10", folder / "ur5" / "11"))
    shutil.copy(other / "contract.json", target)
    for name in ("policy.onnx", "SHA256SUMS"):
        shutil.copy(other / name, target)
    sums = (target / "SHA256SUMS").read_text().splitlines()
    golden = next(line for line in (folder / "ur5" / "10" / "SHA256SUMS").read_text().splitlines() if "golden" in line)
    (target / "SHA256SUMS").write_text("\n".join([golden if "golden" in line else line for line in sums]) + "\n")

    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("10", production="10"))
        with pytest.raises(RefusedError, match="golden"):
            await fleet.controls[0].give(Load(version="11"), "ur5")

    asyncio.run(run())


def test_a_configuration_begins_a_plan_and_commands_rule_after(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder, folder)
        break_weights(folder, "2")
        for wrong, kind in (
            (config("1", "2", production="1"), RlservoError),
            ({"policies": 7}, UsageError),
            (config("1", "99", production="1"), RlservoError),
        ):
            with pytest.raises(kind):
                await fleet.deploy(wrong)
            assert not (tmp_path / FOLDER).exists()
        await fleet.deploy(config("1", "10", production="1"))
        assert "differs from the configuration" not in caplog.text
        await fleet.controls[0].give(aliasing("10"), "ur5")
        whole_new_cluster = [fleet.start(folder, f"new{n}") for n in range(2)]
        for control in whole_new_cluster:
            await control.configure(config("1", "10", production="1"))
            assert control.store is not None and control.store.default("ur5") == "10"
        assert caplog.text.count("plan 2 in") == 2 and "differs from the configuration and is used" in caplog.text

    asyncio.run(run())


def test_a_version_exported_since_is_not_in_use_by_itself_and_a_start_says_so(folder: Path) -> None:
    async def run() -> None:
        await Fleet(folder, folder).deploy({})
        write_box_policy(folder, version="11", seed=11)
        fleet = Fleet(folder, folder)
        await fleet.deploy({})
        said = await fleet.controls[0].look()
        assert said == {"ur5 version 11 is not served: the plan is older (rlservo policy load ur5 11)"}
        assert fleet.defaults() == ["10"] and fleet.controls[0].not_loaded() == {"ur5": ["11"]}

    asyncio.run(run())


def test_a_process_that_cannot_follow_keeps_what_it_had_and_tells_why(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = Path(shutil.copytree(folder, tmp_path / "elsewhere"))
    shutil.rmtree(elsewhere / "ur5" / "2")

    async def run() -> None:
        fleet = Fleet(tmp_path, folder, elsewhere)
        await fleet.deploy(config("1", production="1"))
        await fleet.controls[0].give(Load(version="2"), "ur5")
        await fleet.controls[0].give(aliasing("2"), "ur5")
        await fleet.follow()
        assert fleet.defaults() == ["2", "1"] and fleet.numbers() == {3}
        behind = fleet.controls[1]
        assert "has no version 2 of policy 'ur5': it has 1, 10" in behind.behind[0]
        assert behind.states()["ur5"]["2"].state == "failed"
        await behind.follow()  # it is not tried again at every look
        shutil.copytree(folder / "ur5" / "2", elsewhere / "ur5" / "2")
        await behind.follow()
        assert fleet.defaults() == ["2", "1"]
        monkeypatch.setattr("rlservo.serve_app.versions.plan_follower.RETRY_PERIOD_S", 0.0)
        await behind.follow()
        assert fleet.defaults() == ["2", "2"] and behind.behind == ()

    asyncio.run(run())


def test_the_same_version_is_the_same_bundle_in_every_process(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        document = config("1", "2", production="1")
        await fleet.deploy(document)
        store = fleet.controls[0].store
        assert store is not None
        action = store.get("ur5", "2").act(OBS)
        shutil.rmtree(folder / "ur5" / "2")
        shutil.move(write_box_policy(tmp_path / "again", version="2", seed=9), folder / "ur5" / "2")
        restarted = fleet.start(folder, "restarted")  # its default is there; the exchanged version is not served
        await restarted.configure(document)
        assert restarted.store is not None and restarted.store.versions("ur5") == ("1",)
        assert "is not the bundle that was accepted" in restarted.states()["ur5"]["2"].reason
        await fleet.controls[0].give(Load(version="2"), "ur5")  # now it is
        reloaded = fleet.controls[0].store
        assert reloaded is not None and not np.allclose(reloaded.get("ur5", "2").act(OBS), action)

    asyncio.run(run())


def test_a_process_whose_default_is_gone_does_not_start(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("1", "2", production="2"))
        break_weights(folder, "2")
        with pytest.raises(
            BundleError, match=r"cannot be served as version 2, its default in plan 1 of .*/node/\.plan"
        ):
            await fleet.start(folder, "restarted").configure({})

    asyncio.run(run())


def test_canary_and_shadow_have_to_read_and_give_the_same(folder: Path) -> None:
    write_discrete_policy(folder, name="ur5", version="12")

    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("1", "12", production="1"))
        control = fleet.controls[0]
        with pytest.raises(RefusedError, match=r"version 12 cannot be the canary of version 1"):
            await control.give(SetCanary(version="12", share=0.5), "ur5")
        with pytest.raises(RefusedError, match=r"version 12 cannot be the shadow of version 1"):
            await control.give(SetShadow(version="12"), "ur5")
        assert fleet.numbers() == {1}

    asyncio.run(run())


def test_requests_are_answered_while_a_version_loads_and_its_state_says_so(folder: Path, tmp_path: Path) -> None:
    began, go_on = threading.Event(), threading.Event()

    def slowly(bundle: Path) -> Policy:
        if bundle.name == "2":
            began.set()
            assert go_on.wait(20)
        return Policy.load(bundle)

    async def run() -> None:
        control = PlanFollower(VersionLoader(Repository([folder]), slowly), PlanFiles([folder]))
        await control.configure(config("1", production="1"))
        change = asyncio.create_task(control.give(Load(version="2"), "ur5"))
        while not began.is_set():
            await asyncio.sleep(0.01)
        assert control.states()["ur5"]["2"].state == "loading"
        assert control.store is not None and control.store.default("ur5") == "1"
        go_on.set()
        await change
        assert control.states()["ur5"]["2"].state == "ready" and control.store.versions("ur5") == ("1", "2")

    asyncio.run(run())


def test_a_version_that_takes_too_long_is_there_when_it_is_asked_for_again(folder: Path) -> None:
    go_on = threading.Event()
    loads: list[Path] = []

    def slowly(bundle: Path) -> Policy:
        loads.append(bundle)
        assert bundle.name != "2" or go_on.wait(20)
        return Policy.load(bundle)

    async def run() -> None:
        loader = VersionLoader(Repository([folder]), slowly, timeout_s=0.5)
        control = PlanFollower(loader, PlanFiles([folder]))
        await control.configure(config("1", production="1"))
        with pytest.raises(UnavailableError, match=r"loading policy 'ur5' version 2 took longer than 0.5 s"):
            await control.give(Load(version="2"), "ur5")
        go_on.set()
        await until(lambda: not loader.loading)
        await control.give(Load(version="2"), "ur5")
        assert [path.name for path in loads] == ["1", "2"]

    asyncio.run(run())


def test_names_and_versions_do_not_leave_the_repository(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "ur5" / "1", tmp_path / "secret" / "1")
    repository = Repository([folder])
    for name, version in (("../secret", "1"), ("ur5", "../../secret/1"), ("..", None), ("", None), ("ur5/1", None)):
        with pytest.raises(Exception, match="the repository has no"):
            repository.look().find(name, version)


def test_nothing_changes_before_the_policies_are_loaded(folder: Path) -> None:
    async def run() -> None:
        with pytest.raises(UnavailableError, match="still being loaded"):
            await Fleet(folder, folder).controls[0].give(aliasing("1"), "ur5")

    asyncio.run(run())


def test_a_command_without_a_server_begins_the_plan_that_servers_then_serve(folder: Path) -> None:
    async def run() -> None:
        def writer() -> PlanFollower:
            return PlanFollower(VersionLoader(Repository([folder])), PlanFiles([folder]))

        plan = await writer().write(aliasing("1"), "ur5")
        assert plan.generation == 1 and plan.policies["ur5"].history == {"production": ("10",)}
        fleet = Fleet(folder, folder)
        await fleet.deploy({})
        assert fleet.defaults() == ["1"]
        break_weights(folder, "2")
        with pytest.raises(RefusedError, match=r"policy\.onnx is not the file"):
            await writer().write(aliasing("2"), "ur5")
        await fleet.follow()
        assert fleet.numbers() == {1}

    asyncio.run(run())


def test_a_plan_that_is_no_plan_stops_nobody_and_a_lost_one_is_not_begun_again(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder)
        await fleet.deploy(config("1", production="1"))
        (control,) = fleet.controls
        poll = asyncio.create_task(repeat(control.files.poll_s, control.follow, "the plan cannot be followed"))
        following = tmp_path / FOLDER / "000000002.json"
        following.write_text('{"generation": 2, "policies": {}, "by": "a later rlservo"}')
        await until(lambda: "000000002.json is not a plan that this rlservo can read" in caplog.text)
        await asyncio.sleep(1.2)
        assert caplog.text.count("is not a plan") == 1 and fleet.defaults() == ["1"]
        following.unlink()
        shutil.move(tmp_path / FOLDER, tmp_path / "away")
        with pytest.raises(UnavailableError, match="has lost plan 1, which is served here"):
            await control.give(aliasing("1", "candidate"), "ur5")
        shutil.move(tmp_path / "away", tmp_path / FOLDER)
        await control.give(aliasing("1", "candidate"), "ur5")
        poll.cancel()

    asyncio.run(run())


def test_a_process_in_place_of_another_begins_no_plan_for_a_lost_one(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        plans, server, next_server = (tmp_path / name for name in ("plans", "server", "next server"))
        for each in (plans, server, next_server):
            each.mkdir()
        fleet = Fleet(plans, folder)
        (first,) = fleet.controls
        await first.configure(config("1", production="1"), server)
        shutil.move(plans / FOLDER, tmp_path / "away")
        replacement = fleet.start(folder, "replacement")
        for control, given in ((replacement, server), (first, None)):  # the second: `serve deploy` with another one
            with pytest.raises(UnavailableError, match="has lost the plan that this server follows: restore it"):
                await control.configure(config("1", "2", production="2"), given)
        assert not (plans / FOLDER).exists()
        shutil.move(tmp_path / "away", plans / FOLDER)
        await replacement.configure({}, server)
        assert replacement.store is not None and replacement.store.default("ur5") == "1"
        shutil.rmtree(plans / FOLDER)
        await fleet.start(folder, "of the next server").configure(config("2", production="2"), next_server)

    asyncio.run(run())


STRANGE = {
    "000000002.json": "000000002.json holds plan 1, so it is a copy",
    "000000007.json": "000000007.json does not follow plan 1",
    "999999999.json": "999999999.json does not follow plan 1",
    "0000000002.json": "0000000002.json is not the file of a plan",
    "٠٠٠٠٠٠٠٠٢.json": "٠٠٠٠٠٠٠٠٢.json is not the file of a plan",
    "000000001 (copy).json": "000000001 \\(copy\\).json is not the file of a plan",
}


@pytest.mark.parametrize("name", STRANGE)
def test_a_file_among_the_plans_that_is_not_ours_is_named_and_nothing_is_lost(
    folder: Path, tmp_path: Path, name: str
) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder)
        await fleet.deploy(config("1", "2", production="1"))
        (control,) = fleet.controls
        first, strange = tmp_path / FOLDER / "000000001.json", tmp_path / FOLDER / name
        number = name.removesuffix(".json") if name[:9] in ("000000007", "999999999") else "1"
        strange.write_text(first.read_text().replace('"generation": 1', f'"generation": {int(number)}'))
        sentence = f"{STRANGE[name]}.*: move it away"
        for action in (control.give(aliasing("2"), "ur5"), fleet.start(folder, "late").configure({})):
            with pytest.raises(UnavailableError, match=sentence):
                await action
        assert fleet.defaults() == ["1"] and {file.name for file in first.parent.iterdir()} == {first.name, name}
        strange.unlink()
        (first.parent / "000000001.json~").write_text("an editor's")
        await control.give(aliasing("2"), "ur5")
        assert fleet.defaults() == ["2"] and fleet.numbers() == {2}

    asyncio.run(run())


def test_a_copied_plan_is_reported_by_those_who_follow_and_not_served(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder)
        await fleet.deploy(config("1", "2", production="1"))
        shutil.copy(tmp_path / FOLDER / "000000001.json", tmp_path / FOLDER / "000000002.json")
        with pytest.raises(UnavailableError, match=r"000000002\.json holds plan 1, so it is a copy: move it away"):
            await fleet.follow()
        assert fleet.numbers() == {1}

    asyncio.run(run())


def test_older_plans_may_be_deleted(folder: Path, tmp_path: Path) -> None:
    async def run() -> None:
        fleet = Fleet(tmp_path, folder)
        await fleet.deploy(config("1", "2", production="1"))
        (control,) = fleet.controls
        for version in ("2", "1", "2"):
            await control.give(aliasing(version), "ur5")
        for number in (1, 2, 3):
            (tmp_path / FOLDER / f"{number:09d}.json").unlink()
        await control.give(aliasing("1"), "ur5")
        assert fleet.numbers() == {5}

    asyncio.run(run())


def test_the_plan_stands_in_the_first_place_that_can_be_written_or_in_the_users_state(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    bundle = folder / "ur5" / "1"
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    assert PlanFiles([bundle, "https://host/policies", other, folder]).place == f"{other}/{FOLDER}"
    assert PlanFiles([bundle, "s3://bucket/policies", other]).place == "s3://bucket/policies/.plan"
    assert PlanFiles([folder], root=str(other)).place == f"{other}/{FOLDER}"
    kept = PlanFiles([bundle, "https://host/policies"]).place
    assert kept.startswith(f"{tmp_path}/state/rlservo/plans/") and kept != PlanFiles([bundle]).place
    (tmp_path / "notes.csv").touch()  # given by mistake: its own sentence is the look's
    assert PlanFiles([tmp_path / "notes.csv"]).place.startswith(f"{tmp_path}/state/")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    assert PlanFiles([folder]).place.startswith(f"{tmp_path}/state/")
    (folder / FOLDER).mkdir()  # the operator's, who may write there
    assert PlanFiles([folder]).place == f"{folder}/{FOLDER}"
