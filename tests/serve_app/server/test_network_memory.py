"""Networks within a bound of memory: what was dropped is opened again for a request, and every action is the same."""

from __future__ import annotations

import asyncio
import random
import shutil
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.export.contract.errors import SessionError, UnavailableError
from rlservo.serve_app.episodes.request import Episode, Request
from rlservo.serve_app.runtime import network_memory
from rlservo.serve_app.runtime.network_memory import DroppableNetwork
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.sampled_metrics import exposition
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.policy_store import Decision

NAMES = tuple("abcdef")
LIMITED, BATCHED = "a", "b"  # in sessions, with a limit on the action's step; computed together
OPTIONS = {
    LIMITED: PolicyOptions(max_action_step=0.05, out_of_bounds="accept"),
    BATCHED: PolicyOptions(micro_batch=8, out_of_bounds="accept"),
    "*": PolicyOptions(out_of_bounds="accept"),
}
OBS = np.random.default_rng(3).standard_normal((400, 27)).astype(np.float32)
FITTING = 2  # networks at once


@pytest.fixture(scope="module")
def folder(box_policy: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("many")
    for seed, name in enumerate(NAMES):
        box_policy(root, name=name, seed=seed)
    box_policy(root, name="f", version="2", seed=77)
    return root


@pytest.fixture
def core(folder: Path) -> Iterator[Core]:
    yield core_of(folder)


def core_of(folder: Path, config: Any = None, *, max_queue_ms: float = 60_000) -> Core:
    size = (folder / "a" / "1" / "policy.onnx").stat().st_size
    chosen = ServerSettings(
        network_bytes=int((FITTING + 0.5) * size), policy_options=OPTIONS, max_queue_ms=max_queue_ms
    )
    store = load_served([folder], ServedConfig.parse(config or {}), chosen)
    return Core(lambda: store, chosen)


def request(name: str, obs: Any, **more: Any) -> Request:
    return Request("json", name, None, time.perf_counter(), obs=obs, **more)


def network_of(core: Core, name: str) -> DroppableNetwork:
    network = core.store().get(name).droppable
    assert network is not None
    return network


def drop(core: Core, name: str) -> None:
    """Use others until this one is dropped."""
    for other in NAMES:
        if other != name:
            network_of(core, other).restore()
    assert not network_of(core, name).is_in_memory


def in_memory(core: Core) -> int:
    return sum(bool(policy.droppable and policy.droppable.is_in_memory) for _, _, policy in core.policies())


def test_every_action_is_the_policys_own_while_networks_come_and_go(core: Core, folder: Path) -> None:
    draw = random.Random(5)
    reference = {
        name: Policy.load(folder / name / ("2" if name == "f" else "1"), options=OPTIONS.get(name, OPTIONS["*"]))
        for name in NAMES
    }
    assert in_memory(core) <= FITTING  # also right after the start

    async def stateless(name: str) -> None:
        for number in draw.sample(range(len(OBS)), 12):
            decision = await core.decide(request(name, OBS[number]))
            np.testing.assert_allclose(decision.action, reference[name].act(OBS[number]), rtol=1e-5, atol=1e-6)

    async def session(number: int) -> None:
        with Policy.load(folder / LIMITED / "1", options=OPTIONS[LIMITED]) as alone:
            for step, row in enumerate(draw.sample(range(len(OBS)), 12)):
                episode = Episode(session_id=number, reset=step == 0)
                decision = await core.decide(request(LIMITED, OBS[row], episode=episode))
                np.testing.assert_array_equal(decision.action, alone.act(OBS[row]))
                assert decision.episode is not None and decision.episode.step == step + 1
                await asyncio.sleep(0)

    async def run() -> None:
        await asyncio.gather(
            *(stateless(name) for name in NAMES if name != LIMITED for _ in range(3)), *(map(session, range(4)))
        )

    asyncio.run(run())
    restores = sum(network_of(core, name).restores for name in NAMES)
    assert restores >= len(NAMES) - FITTING and in_memory(core) <= FITTING
    text = asyncio.run(exposition(core)).decode()
    assert f'rlservo_networks_in_memory{{replica=""}} {in_memory(core)}.0' in text
    shown = [float(line.split()[-1]) for line in text.splitlines() if line.startswith("rlservo_network_restores_total")]
    assert len(shown) == len(NAMES) + 1 and sum(shown) >= restores


def test_the_one_used_longest_ago_goes_and_its_memory_with_it_but_not_from_under_a_run(core: Core) -> None:
    first, second, third = (network_of(core, name) for name in "cde")
    first.restore()
    second.restore()
    first.run(["action"], {"obs": OBS[:1]})
    session = weakref.ref(second.restore())
    first.run(["action"], {"obs": OBS[:1]})
    third.restore()
    assert (first.is_in_memory, second.is_in_memory, third.is_in_memory) == (True, False, True)
    assert session() is None  # without a collection of garbage
    running = first.restore()
    for name in "bde":
        network_of(core, name).restore()
    assert not first.is_in_memory
    assert np.isfinite(running.run(["action"], {"obs": OBS[:1]})[0]).all()


def test_without_the_bound_a_policy_has_onnxruntimes_own_run(folder: Path) -> None:
    store = load_served([folder / "a", folder / "b"], ServedConfig(), ServerSettings())
    policy = store.get("a")
    assert policy.droppable is None and type(policy._run.__self__).__name__ == "InferenceSession"  # type: ignore[attr-defined]
    assert "rlservo_network" not in asyncio.run(exposition(Core(lambda: store, ServerSettings()))).decode()


def test_a_network_that_cannot_be_opened_again_is_a_sentence_and_others_go_on(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path(shutil.copytree(folder, tmp_path / "copy"))
    core = core_of(root)
    graph = root / "c" / "1" / "policy.onnx"
    content = graph.read_bytes()
    for damage in (graph.unlink, lambda: graph.write_bytes(content[:-1] + b"x")):
        drop(core, "c")
        damage()
        with pytest.raises(UnavailableError, match=r"^policy 'c' version 1 is not in memory \(network_bytes\), and"):
            asyncio.run(core.decide(request("c", OBS[0])))
        assert asyncio.run(core.decide(request("d", OBS[0]))).name == "d"
        before = {name for name in NAMES if network_of(core, name).is_in_memory}
        with pytest.raises(UnavailableError), monkeypatch.context() as patch:
            patch.setattr(network_memory, "RETRY_S", 60.0)
            patch.setattr(network_memory, "open_graph", None)  # not read again so soon
            asyncio.run(core.decide(request("c", OBS[0])))
        assert before == {name for name in NAMES if network_of(core, name).is_in_memory}
        monkeypatch.setattr(network_memory, "RETRY_S", 0.0)
        graph.write_bytes(content)
        assert asyncio.run(core.decide(request("c", OBS[0]))).name == "c"


def test_files_that_hang_hold_up_only_those_who_wait_for_them(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, reached, calls = threading.Event(), threading.Event(), []
    own = network_memory.open_graph

    def hang(*given: Any, **options: Any) -> Any:
        calls.append(given)
        reached.set()
        assert go_on.wait(60)
        return own(*given, **options)

    core = core_of(folder, max_queue_ms=300)
    drop(core, "c")
    network_of(core, "d").restore()
    monkeypatch.setattr(network_memory, "open_graph", hang)

    async def run() -> Decision:
        waiting = [asyncio.create_task(core.decide(request("c", OBS[0]))) for _ in range(20)]
        while not reached.is_set():
            await asyncio.sleep(0.01)
        assert (await core.decide(request("d", OBS[0]))).name == "d"  # the loop turns
        results = await asyncio.gather(*waiting, return_exceptions=True)
        assert {str(result) for result in results} == {
            "policy 'c' version 1 was not in memory (network_bytes), and is being opened again: try again shortly"
        }
        go_on.set()
        deadline = time.monotonic() + 60
        while True:  # it goes on being opened, once for all
            try:
                return await core.decide(request("c", OBS[0]))
            except UnavailableError:
                assert time.monotonic() < deadline

    assert asyncio.run(run()).name == "c" and len(calls) == 1


@pytest.mark.parametrize("again", ["step", "reset"])
def test_of_requests_of_a_session_that_wait_for_a_network_one_moves_its_memory(
    again: str, core: Core, folder: Path
) -> None:
    """A client gives up while its step waits, and asks again: with a number the same answer, without one a refusal."""

    async def ask(row: int, **more: Any) -> Any:
        step = request(LIMITED, OBS[row], episode=Episode(session_id="arm", reset=more.pop("reset", False)), **more)
        return await core.decide(step)

    async def run() -> None:
        await ask(0, reset=True)
        drop(core, LIMITED)
        told = await asyncio.gather(ask(1, seq=1), ask(1, seq=1))
        np.testing.assert_array_equal(told[0].action, told[1].action)
        drop(core, LIMITED)
        if again == "step":
            first, second = await asyncio.gather(ask(2), ask(2), return_exceptions=True)
        else:
            first, second = await asyncio.gather(ask(3, reset=True), ask(3), return_exceptions=True)
        assert isinstance(second, SessionError) and "another one of its session was answered" in second.message
        answer = await ask(4)
        with Policy.load(folder / LIMITED / "1", options=OPTIONS[LIMITED]) as alone:
            for row in (0, 1, 2) if again == "step" else (3,):
                expected = alone.act(OBS[row])
            np.testing.assert_array_equal(first.action, expected)
            np.testing.assert_array_equal(answer.action, alone.act(OBS[4]))

    asyncio.run(run())


def test_a_shadow_that_was_dropped_computes_along(folder: Path) -> None:
    config = {"policies": {"f": {"versions": ["1", "2"], "aliases": {"production": "1"}, "shadow": "2"}}}
    core = core_of(folder, {**config, "unlisted": "load"})
    for name in "bcde":
        network_of(core, name).restore()

    async def run() -> None:
        for row in range(3):
            await core.decide(request("f", OBS[row]))

    asyncio.run(run())
    deadline = time.monotonic() + 60
    while core.shadows.describe("f", "1", "2")["compared"] < 3:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert core.shadows.describe("f", "1", "2")["failed"] == 0
