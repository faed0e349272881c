"""Micro-batching: what is there at the same time is computed in one run, and everybody gets their own action."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import onnx
import pytest
import websockets.asyncio.client
from numpy.typing import NDArray

from rlservo.export.contract.bundle import load_bundle, write_contract, write_golden
from rlservo.export.contract.errors import ActionError, BundleError, DeadlineError, UsageError
from rlservo.export.contract.spaces import BoxSpec
from rlservo.serve_app.episodes.request import Request
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.oip_grpc import OipGrpcCodec
from rlservo.serve_app.protocols.oip_messages import messages
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.micro_batching import Batcher, Tensors
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore, load_policy
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack
from stores import load_store, store_of

pytestmark = pytest.mark.filterwarnings("ignore:The `websockets` implementation:DeprecationWarning")

OBS = np.random.default_rng(3).standard_normal((256, 27)).astype(np.float32)
TOGETHER = {"*": PolicyOptions(micro_batch=16)}


def feed(number: float) -> Tensors:
    return {"obs": np.full((1, 2), number, np.float32)}


def doubled(tensors: Tensors) -> Tensors:
    return {"action": tensors["obs"] * 2}


def test_what_comes_in_one_turn_is_one_run_and_no_more_than_allowed() -> None:
    sizes: list[int] = []

    def run(tensors: Tensors) -> Tensors:
        sizes.append(len(tensors["obs"]))
        return doubled(tensors)

    async def main() -> None:
        batcher = Batcher(run, 4)
        # The first turn with several, and one that follows a turn with one, are computed as they come.
        for number, expected in ((1, [1]), (2, [1, 1]), (4, [4]), (6, [4, 2]), (1, [1]), (3, [1, 1, 1]), (6, [4, 2])):
            sizes.clear()
            computed = await asyncio.gather(*(batcher.compute(feed(i)) for i in range(number)))
            assert sizes == expected
            for i, one in enumerate(computed):
                np.testing.assert_array_equal(one.outputs["action"], np.full((1, 2), 2 * i, np.float32))
        assert (batcher.runs, batcher.observations) == (12, 23)

    asyncio.run(main())


def test_who_has_gone_is_left_out_and_a_failed_run_fails_for_all_in_it() -> None:
    sizes: list[int] = []

    def run(tensors: Tensors) -> Tensors:
        sizes.append(len(tensors["obs"]))
        if np.isnan(tensors["obs"]).any():
            raise ActionError("no")
        return doubled(tensors)

    async def main() -> None:
        batcher = Batcher(run, 8)
        await asyncio.gather(*(batcher.compute(feed(i)) for i in range(2)))
        sizes.clear()
        tasks = [asyncio.ensure_future(batcher.compute(feed(i))) for i in range(3)]
        asyncio.get_running_loop().call_soon(tasks[1].cancel)  # after all have joined, before they are computed
        done = await asyncio.gather(*tasks, return_exceptions=True)
        assert sizes == [2]
        assert isinstance(done[1], asyncio.CancelledError)
        done = await asyncio.gather(*(batcher.compute(feed(x)) for x in (1, np.nan)), return_exceptions=True)
        assert [type(one) for one in done] == [ActionError, ActionError]
        assert float((await batcher.compute(feed(3))).outputs["action"][0, 0]) == 6.0

    asyncio.run(main())


@pytest.fixture(scope="module")
def store(policies: Path, box_policy: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> PolicyStore:
    unsafe = tmp_path_factory.mktemp("unsafe")
    box_policy(unsafe, name="unsafe", action_scale=2.0)  # its actions can leave the space
    return load_store(policies, unsafe, options=TOGETHER)


@pytest.fixture(scope="module")
def port(store: PolicyStore, served: Callable[[Any], AbstractContextManager[int]]) -> Iterator[int]:
    with served(create_app(lambda: store, ServerSettings())) as number:
        yield number


@pytest.fixture(scope="module")
def bounded(box_policy: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy whose observations have bounds."""
    folder = box_policy(tmp_path_factory.mktemp("bounded"), name="bounded", named=False)
    contract = load_bundle(folder).contract
    space = BoxSpec(shape=(27,), dtype="float32", low=-8.0, high=8.0)
    write_contract(folder, contract.model_copy(update={"observation_space": space}))
    return folder


@contextlib.contextmanager
def watched(store: PolicyStore, policy: Policy) -> Iterator[list[int]]:
    """Give the sizes of the policy's runs."""
    batcher = store.batcher_of(policy)
    assert batcher is not None
    run, sizes = batcher._run, []

    def counting(tensors: Tensors) -> Tensors:
        sizes.append(len(next(iter(tensors.values()))))
        return run(tensors)

    batcher._run = counting
    try:
        yield sizes
    finally:
        batcher._run = run


def in_a_crowd(store: PolicyStore) -> None:
    """As if several had come in the turn before."""
    for name in store.names:
        batcher = store.batcher_of(store.get(name))
        assert batcher is not None
        batcher._several = True


def ask_all(port: int, path: str, documents: list[Any]) -> list[httpx.Response]:
    """Send all at once, each on a connection of its own, while a large batch keeps the server busy."""

    async def main() -> list[httpx.Response]:
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", timeout=30) as client:
            await asyncio.gather(*(client.get("/healthz") for _ in range(len(documents) + 1)))  # opens the connections
            busy = client.post("/v1/policies/ur5/act", json={"obs": np.tile(OBS, (15, 1)).tolist()})
            _, *answers = await asyncio.gather(busy, *(client.post(path, json=document) for document in documents))
            return answers

    return asyncio.run(main())


def counted(port: int) -> tuple[float, ...]:
    """Return (runs, observations) of all versions of the policy, from the metrics."""
    told = httpx.get(f"http://127.0.0.1:{port}/metrics").text
    return tuple(
        sum(map(float, re.findall(rf'^rlservo_micro_batch_{what}_total{{.*policy="ur5".*}} (.*)$', told, re.MULTILINE)))
        for what in ("runs", "observations")
    )


def test_json_requests_are_computed_together_and_get_their_own_actions(
    port: int, store: PolicyStore, ur5: Path
) -> None:
    before = counted(port)
    with Policy.load(ur5) as alone, watched(store, store.get("ur5")) as sizes:
        for _ in range(20):  # on a busy computer they may come one after the other
            in_a_crowd(store)
            answers = ask_all(port, "/v1/policies/ur5/act", [{"obs": row.tolist()} for row in OBS[:40]])
            for row, reply in zip(OBS, answers, strict=False):
                assert reply.status_code == 200
                np.testing.assert_allclose(reply.json()["action"], alone.act(row), rtol=1e-5, atol=1e-6)
            together = [size for size in sizes if size <= 16]
            if max(together) > 1:
                break
        assert max(together) > 1
        assert 256 * 15 in sizes  # a batch that came as one is computed as one
    assert counted(port)[0] - before[0] == len(together)
    assert counted(port)[1] - before[1] == sum(together)


def test_a_bad_observation_and_a_bad_action_are_their_own_requests_faults(port: int, store: PolicyStore) -> None:
    documents: list[Any] = [{"obs": (row * 0.02).tolist()} for row in OBS[:12]]
    documents[3] = {"obs": [0.0] * 26}
    documents[7] = {"obs": (OBS[7] * 1e4).tolist()}  # far outside: the action leaves its space
    with watched(store, store.get("unsafe")) as sizes:
        for _ in range(20):
            sizes.clear()
            in_a_crowd(store)
            answers = ask_all(port, "/v1/policies/unsafe/act", documents)
            statuses = [reply.status_code for reply in answers]
            assert statuses == [422 if i == 3 else 500 if i == 7 else 200 for i in range(12)]
            assert answers[7].json()["code"] == "unsafe-action"
            assert sum(sizes) == 11
            if len(sizes) < 11:
                break
        assert len(sizes) < 11


def test_oip_streams_and_grpc_are_computed_together_too(port: int, store: PolicyStore, ur5: Path) -> None:
    def infer(row: NDArray[Any]) -> Any:
        return {"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": row.tolist()}]}

    async def streams() -> list[Any]:
        async with contextlib.AsyncExitStack() as stack:
            url = f"ws://127.0.0.1:{port}/v1/policies/ur5/stream"
            opened = [await stack.enter_async_context(websockets.asyncio.client.connect(url)) for _ in range(9)]
            for one in opened:
                await one.recv()
            busy = opened.pop()
            await busy.send(pack({"obs": np.tile(OBS, (15, 1))}))
            for one, row in zip(opened, OBS, strict=False):
                await one.send(pack({"obs": row}))
            return [unpack(await one.recv())["actions"] for one in opened]

    async def calls() -> list[Any]:
        handler = create_app(lambda: store, ServerSettings()).handler
        codec, answer = OipGrpcCodec(handler), handler.answer
        asked = messages.ModelInferRequest(model_name="ur5")
        asked.inputs.add(name="obs", datatype="FP32", shape=[1, 27])
        requests = []
        for row in OBS[:8]:
            del asked.raw_input_contents[:]
            asked.raw_input_contents.append(row.tobytes())
            requests.append((asked.SerializeToString(), None))
        now = time.perf_counter()
        return await asyncio.gather(*(answer(codec, Request("grpc", "", None, now), one) for one in requests))

    with Policy.load(ur5) as alone, watched(store, store.get("ur5")) as sizes:
        expected = [alone.act(row) for row in OBS[:8]]

        def check(actions: list[Any]) -> None:
            for row, action in zip(expected, actions, strict=True):
                np.testing.assert_allclose(np.ravel(action), row, rtol=1e-5, atol=1e-6)

        for _ in range(20):  # on a busy computer they may come one after the other
            sizes.clear()
            in_a_crowd(store)
            replies = ask_all(port, "/v2/models/ur5/infer", [infer(row) for row in OBS[:8]])
            check([{out["name"]: out["data"] for out in reply.json()["outputs"]}["action"] for reply in replies])
            if sum(size <= 16 for size in sizes) < 8:
                break
        assert sum(size <= 16 for size in sizes) < 8
        for _ in range(20):
            sizes.clear()
            in_a_crowd(store)
            check(asyncio.run(streams()))
            if sum(size <= 16 for size in sizes) < 8:
                break
        assert sum(size <= 16 for size in sizes) < 8
        sizes.clear()
        in_a_crowd(store)
        called = asyncio.run(calls())
        names = [output.name for output in called[0].outputs]
        check([np.frombuffer(reply.raw_output_contents[names.index("action")], np.float32) for reply in called])
        assert sizes == [8]


def test_exploring_requests_draw_for_themselves(port: int, store: PolicyStore) -> None:
    with watched(store, store.get("ur5")) as sizes:
        drawn = ask_all(port, "/v1/policies/ur5/act", [{"obs": OBS[0].tolist(), "explore": True, "seed": 5}] * 4)
        assert len({json.dumps(reply.json()["action"]) for reply in drawn}) == 1
        assert sizes == [256 * 15]


def test_a_warning_is_in_the_reply_to_what_it_is_about(bounded: Path) -> None:
    store = load_store(bounded, options=TOGETHER)

    async def main() -> list[Decision]:
        in_a_crowd(store)
        rows = OBS[:4].copy()
        rows[1, 5], rows[3, 6] = 9.0, -10.0
        return await asyncio.gather(*(store.act_together("bounded", None, row) for row in rows))

    decisions = asyncio.run(main())
    assert [len(decision.notices) for decision in decisions] == [0, 1, 0, 1]
    assert "element 5 outside" in decisions[1].notices[0] and "element 6 outside" in decisions[3].notices[0]


def test_a_deadline_that_passes_while_others_are_read_is_told_and_not_computed(store: PolicyStore) -> None:
    handler = create_app(lambda: store, ServerSettings()).handler

    async def slow() -> None:
        time.sleep(0.05)  # another request of the same turn

    async def main() -> list[Any]:
        now = time.perf_counter()
        hurried = Request("json", "ur5", None, now, obs=OBS[0], deadline_ms=30.0)
        patient = Request("json", "ur5", None, now, obs=OBS[1], deadline_ms=30_000.0)
        decide = handler.decide
        return await asyncio.gather(decide(hurried), decide(patient), slow(), return_exceptions=True)

    with watched(store, store.get("ur5")) as sizes:
        in_a_crowd(store)
        late, done, _ = asyncio.run(main())
    assert isinstance(late, DeadlineError) and "nothing computed" in late.message
    assert done.action.shape == (6,) and sizes == [1]


def test_a_closed_policy_computes_what_was_waiting_and_nothing_else(policies: Path) -> None:
    store = load_store(policies, options=TOGETHER)

    async def main() -> list[Any]:
        async def close() -> None:
            store.close()

        in_a_crowd(store)
        asked = store.act_together("ur5", None, OBS[0])
        return await asyncio.gather(asked, close(), store.act_together("ur5", None, OBS[1]), return_exceptions=True)

    done, _, refused = asyncio.run(main())
    assert done.action.shape == (6,)
    assert isinstance(refused, UsageError)


def test_a_graph_that_takes_one_observation_at_a_time_is_refused(bounded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bounded" / "1"
    shutil.copytree(bounded, folder)
    model = onnx.load(folder / "policy.onnx")
    for tensor in (*model.graph.input, *model.graph.output):
        tensor.type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(model, folder / "policy.onnx")
    inputs, outputs = load_bundle(bounded).golden()
    write_golden(folder, {k: v[:1] for k, v in inputs.items()}, {k: v[:1] for k, v in outputs.items()})
    write_contract(folder, load_bundle(bounded).contract)  # the hashes, anew
    assert Policy.load(folder).act(OBS[0]).shape == (6,)
    with pytest.raises(BundleError, match=r"computes three observations together differently .*leave micro_batch"):
        load_policy(folder, options=TOGETHER)


def test_policies_with_a_memory_or_a_limit_are_computed_one_by_one(recurrent: Path, policies: Path) -> None:
    store = load_store(recurrent, options=TOGETHER)
    assert not store.batches
    limited = PolicyOptions(micro_batch=16, max_action_step=0.1)
    assert not load_store(policies, options={"ur5": limited}).batches


def test_the_next_store_goes_on_with_the_batchers_of_the_policies_it_keeps(policies: Path) -> None:
    first = load_store(policies, options=TOGETHER)
    kept = first.get("ur5")
    batcher = first.batcher_of(kept)
    assert batcher is not None
    assert asyncio.run(batcher.compute({"obs": OBS[:1]})).outputs["action"].shape == (1, 6)
    after = store_of(kept, replaces=first).batcher_of(kept)
    assert after is batcher and after.observations == 1  # the counts are Prometheus counters: they do not start again
    other = kept.clone()
    assert store_of(other, replaces=first).batcher_of(other) is not batcher


def test_the_in_process_runtime_imports_no_event_loop() -> None:
    script = (
        "import sys, rlservo.serve_app.runtime.policy; print(*{'asyncio', 'ray', 'fastapi', 'torch'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=True)
    assert not done.stdout.split()
