"""Several replicas' controls over one ledger, with real bundles: who serves what, and what a broken bundle does."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.export.contract.errors import (
    BundleError,
    ConflictError,
    PartlyAppliedError,
    RefusedError,
    UnavailableError,
)
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.plan import Canary
from rlservo.serve_app.versions.replica_versions import Change, ReplicaProgress, ReplicaVersions
from rlservo.serve_app.versions.repository import Repository
from rlservo.serve_app.versions.version_loader import VersionLoader
from stores import MemoryLedger

OBS = np.zeros(27, np.float32) + 0.1


class Fleet:
    """Replicas that tell each other, as Serve's broadcast does. Each has folders of its own, as on several nodes."""

    def __init__(self, *folders: Path) -> None:
        self.shelf = MemoryLedger()
        self.current: Any = None
        self.controls = [self.start(folder, f"r{n}") for n, folder in enumerate(folders)]

    def start(self, folder: Path, name: str) -> ReplicaVersions:
        loader = VersionLoader(Repository([folder]))
        return ReplicaVersions(loader, self.shelf, replica=name, broadcast=self.tell, is_current=self.is_current)

    async def tell(self, generation: int) -> Sequence[ReplicaProgress]:
        return [await control.follow(generation) for control in self.controls]

    async def is_current(self, document: Any) -> bool:
        return bool(document == self.current)

    async def deploy(self, document: Any) -> None:
        self.current = document
        for control in self.controls:
            await control.configure(document)

    def defaults(self) -> list[str]:
        return [control.store.default("ur5") if control.store else "" for control in self.controls]


def config(*versions: str, production: str, **more: Any) -> dict[str, Any]:
    return {
        "policies": {"ur5": {"versions": list(versions), "aliases": {"production": production}, **more}},
        "unlisted": "ignore",
    }


def aliasing(version: str) -> Change:
    return lambda before: plan_changes.set_alias(before, "ur5", "production", version)


@pytest.fixture
def folder(policies: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(policies, tmp_path / "node"))


def break_weights(folder: Path, version: str) -> None:
    (folder / "ur5" / version / "policy.onnx").write_bytes(b"nothing")


def test_a_change_on_one_replica_is_served_by_all_when_it_returns(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("1", production="1"))
        first, second = fleet.controls
        held = second.store
        await first.load("ur5", "2", what="load")
        await second.change(aliasing("2"), what="alias")
        assert fleet.defaults() == ["2", "2"]
        assert held is not None and held.default("ur5") == "1"  # whoever began with the old store ends with it
        held.act("ur5", None, OBS)
        assert {control.plan.generation for control in fleet.controls if control.plan} == {3}

    asyncio.run(run())


def test_changes_at_the_same_time_all_happen_one_after_the_other(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder, folder)
        await fleet.deploy(config("1", "2", production="1"))
        changes = [
            control.change(lambda p, n=n: plan_changes.set_alias(p, "ur5", f"alias{n}", "2"), what=f"alias{n}")  # type: ignore[misc]
            for n, control in enumerate(fleet.controls * 3)
        ]
        await asyncio.gather(*changes)
        for control in fleet.controls:
            assert control.store is not None and len(control.store.plans["ur5"].aliases) == 1 + 9
        assert fleet.shelf.newest() == 10

    asyncio.run(run())


def test_a_version_that_fails_is_refused_and_every_replica_says_why(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        await fleet.deploy(config("1", production="1"))
        break_weights(folder, "2")
        with pytest.raises(RefusedError, match=r"nothing has changed: .*policy.onnx is not the file") as caught:
            await fleet.controls[0].load("ur5", "2", what="load ur5 2")
        assert caught.value.details["versions"][0]["version"] == "2"
        for control in fleet.controls:
            assert control.plan is not None and control.plan.refused is not None
            assert control.plan.refused.change == "load ur5 2"
            states = control.states()["ur5"]
            assert (states["1"].state, states["2"].state) == ("ready", "failed")
            assert "is not the file" in states["2"].reason and states["1"].loaded_at is not None
        assert fleet.defaults() == ["1", "1"]
        await fleet.controls[1].change(lambda p: plan_changes.set_shadow(p, "ur5", None), what="shadow off")
        assert (
            fleet.controls[0].plan is not None and fleet.controls[0].plan.refused is None
        )  # the last change went well

    asyncio.run(run())


def test_golden_vectors_that_are_not_reproduced_refuse_a_version(
    folder: Path, box_policy: Callable[..., Path], tmp_path: Path
) -> None:
    other = box_policy(tmp_path / "other", version="11", seed=5)
    target = Path(shutil.copytree(folder / "ur5" / "10", folder / "ur5" / "11"))
    shutil.copy(other / "contract.json", target)
    for name in ("policy.onnx", "SHA256SUMS"):
        shutil.copy(other / name, target)
    sums = (target / "SHA256SUMS").read_text().splitlines()
    golden = next(line for line in (folder / "ur5" / "10" / "SHA256SUMS").read_text().splitlines() if "golden" in line)
    (target / "SHA256SUMS").write_text("\n".join([golden if "golden" in line else line for line in sums]) + "\n")

    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("10", production="10"))
        with pytest.raises(RefusedError, match="golden"):
            await fleet.controls[0].load("ur5", "11", what="load")

    asyncio.run(run())


def test_a_wrong_configuration_is_refused_and_the_first_one_ends_the_start(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        break_weights(folder, "2")
        with pytest.raises((RefusedError, BundleError), match="is not the file"):
            await fleet.deploy(config("1", "2", production="1"))
        assert fleet.shelf.plans == {}
        await fleet.deploy(config("1", production="1"))
        for wrong in (config("1", "2", production="2"), {"policies": 7}, config("1", "99", production="1")):
            await fleet.deploy(wrong)
            assert fleet.defaults() == ["1", "1"]
            for control in fleet.controls:
                assert control.plan is not None and control.plan.refused is not None
                assert control.plan.refused.change == "configuration"
        # A replica that starts now starts with what is served, and not with the refused configuration.
        late = fleet.start(folder, "late")
        await late.configure(fleet.current)
        assert late.store is not None and late.store.versions("ur5") == ("1",)

    asyncio.run(run())


def test_a_restarted_replica_comes_up_with_what_is_served_and_a_changed_file_wins(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder, folder)
        first = config("1", "2", production="1")
        await fleet.deploy(first)
        await fleet.controls[0].change(aliasing("2"), what="alias")
        restarted = fleet.start(folder, "restarted")
        await restarted.configure(first)  # Serve starts it with its file
        assert restarted.store is not None and restarted.store.default("ur5") == "2"
        await fleet.deploy(first)  # deploying the same file again changes nothing
        assert fleet.defaults() == ["2", "2"]
        await fleet.deploy(config("10", production="10"))
        assert fleet.defaults() == ["10", "10"]
        # Serve may start a replica with the configuration before the current one.
        late = fleet.start(folder, "late")
        await late.configure(first)
        assert late.store is not None and late.store.default("ur5") == "10"
        assert fleet.defaults() == ["10", "10"]

    asyncio.run(run())


def test_a_replica_that_cannot_follow_keeps_what_it_had_and_the_command_names_it(folder: Path, tmp_path: Path) -> None:
    elsewhere = Path(shutil.copytree(folder, tmp_path / "elsewhere"))
    shutil.rmtree(elsewhere / "ur5" / "2")

    async def run() -> None:
        fleet = Fleet(folder, elsewhere)
        await fleet.deploy(config("1", production="1"))
        with pytest.raises(PartlyAppliedError, match=r"r1: the repository has no version '2'") as caught:
            await fleet.controls[0].load("ur5", "2", what="load")
        assert list(caught.value.details["replicas"]) == ["r1"]
        with pytest.raises(PartlyAppliedError, match="r1"):
            await fleet.controls[0].change(aliasing("2"), what="alias")
        assert fleet.defaults() == ["2", "1"]
        assert fleet.controls[1].progress().behind and fleet.controls[1].states()["ur5"]["2"].state == "failed"
        shutil.copytree(folder / "ur5" / "2", elsewhere / "ur5" / "2")
        assert (await fleet.controls[1].follow()).behind == ()
        assert fleet.defaults() == ["2", "2"]

    asyncio.run(run())


def test_the_same_version_is_the_same_bundle_on_every_replica(
    folder: Path, box_policy: Callable[..., Path], tmp_path: Path
) -> None:
    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("1", "2", production="1"))
        store = fleet.controls[0].store
        assert store is not None
        action = store.act("ur5", "2", OBS).action
        shutil.rmtree(folder / "ur5" / "2")
        shutil.move(box_policy(tmp_path / "again", version="2", seed=9), folder / "ur5" / "2")
        restarted = fleet.start(folder, "restarted")  # its default is there; the exchanged version is not served
        await restarted.configure(fleet.current)
        assert restarted.store is not None and restarted.store.versions("ur5") == ("1",)
        assert "is not the bundle that was accepted" in restarted.states()["ur5"]["2"].reason
        await fleet.controls[0].load("ur5", "2", what="load")  # now it is
        reloaded = fleet.controls[0].store
        assert reloaded is not None and not np.allclose(reloaded.act("ur5", "2", OBS).action, action)

    asyncio.run(run())


def test_a_restarted_replica_whose_default_is_gone_does_not_come_up(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("1", "2", production="2"))
        break_weights(folder, "2")
        with pytest.raises(BundleError, match="cannot be served as version 2, its default"):
            await fleet.start(folder, "restarted").configure(fleet.current)

    asyncio.run(run())


def test_canary_and_shadow_have_to_read_and_give_the_same(
    folder: Path, discrete_policy: Callable[..., Path], rewrite_contract: Callable[..., None]
) -> None:
    discrete_policy(folder, name="ur5", version="12")

    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("1", "12", production="1"))
        control = fleet.controls[0]
        with pytest.raises(RefusedError, match=r"version 12 cannot be the canary of version 1"):
            await control.change(
                lambda p: plan_changes.set_canary(p, "ur5", Canary(version="12", share=0.5)), what="canary"
            )
        with pytest.raises(RefusedError, match=r"version 12 cannot be the shadow of version 1"):
            await control.change(lambda p: plan_changes.set_shadow(p, "ur5", "12"), what="shadow")

    asyncio.run(run())


def test_requests_are_answered_while_a_version_loads_and_its_state_says_so(folder: Path) -> None:
    began, go_on = threading.Event(), threading.Event()

    def slowly(bundle: Path) -> Policy:
        if bundle.name == "2":
            began.set()
            assert go_on.wait(20)
        return Policy.load(bundle)

    async def run() -> None:
        control = ReplicaVersions(VersionLoader(Repository([folder]), slowly), MemoryLedger(), replica="slow")
        await control.configure(config("1", production="1"))
        change = asyncio.create_task(control.load("ur5", "2", what="load"))
        while not began.is_set():
            await asyncio.sleep(0.01)
        assert control.states()["ur5"]["2"].state == "loading"
        assert control.store is not None and control.store.act("ur5", None, OBS).version == "1"
        go_on.set()
        await change
        assert control.states()["ur5"]["2"].state == "ready" and control.store.versions("ur5") == ("1", "2")

    asyncio.run(run())


def test_a_replica_that_nobody_told_sees_the_ledger_by_itself(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rlservo.serve_app.versions.replica_versions.LEDGER_POLL_S", 0.02)

    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("1", "2", production="1"))
        deaf = fleet.start(folder, "deaf")
        await deaf.configure(fleet.current)
        watching = asyncio.create_task(deaf.poll_ledger())
        await fleet.controls[0].change(aliasing("2"), what="alias")
        for _ in range(200):
            if deaf.store is not None and deaf.store.default("ur5") == "2":
                break
            await asyncio.sleep(0.02)
        watching.cancel()
        assert deaf.store is not None and deaf.store.default("ur5") == "2"

    asyncio.run(run())


def test_names_and_versions_do_not_leave_the_repository(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "ur5" / "1", tmp_path / "secret" / "1")
    repository = Repository([folder])
    for name, version in (("../secret", "1"), ("ur5", "../../secret/1"), ("..", None), ("", None), ("ur5/1", None)):
        with pytest.raises(Exception, match="the repository has no"):
            repository.find_digest(name, version)


def test_nothing_changes_before_the_policies_are_loaded(folder: Path) -> None:
    async def run() -> None:
        with pytest.raises(UnavailableError, match="still being loaded"):
            await Fleet(folder).controls[0].change(aliasing("1"), what="alias")

    asyncio.run(run())


def test_a_change_that_contradicts_writes_nothing(folder: Path) -> None:
    async def run() -> None:
        fleet = Fleet(folder)
        await fleet.deploy(config("1", production="1"))
        with pytest.raises(ConflictError):
            await fleet.controls[0].change(lambda p: plan_changes.unload(p, "ur5", "1"), what="unload")
        assert fleet.shelf.newest() == 1

    asyncio.run(run())
