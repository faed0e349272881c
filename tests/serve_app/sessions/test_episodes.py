"""Recurrent state over every protocol: real LSTM policies behind real sockets, against the same ones in process."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from bundles import write_box_policy, write_leaky_policy
from rlservo.bundle.nested import action_leaves
from rlservo.bundle.spaces import leaf_specs
from rlservo.client.stream_client import StreamClient
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import exchange, over_uvicorn
from stores import control_of, load_store, store_of
from streams import Stream

STEPS = 12
Ask = Callable[..., tuple[int, Any]]


@pytest.fixture(scope="module")
def store(recurrent: Path, ur5: Path) -> PolicyStore:
    return load_store(recurrent, ur5)


@pytest.fixture(scope="module")
def port(store: PolicyStore) -> Iterator[int]:
    with over_uvicorn(create_app(control_of(store), ServerSettings(session_idle_s=2.0))) as port:
        yield port


def asking(port: int) -> Ask:
    """Return a function that posts JSON and gives (status, reply)."""

    def call(path: str, body: Any) -> tuple[int, Any]:
        reply = exchange(port, "POST", path, body)
        return reply.status, reply.document

    return call


@pytest.fixture(scope="module")
def ask(port: int) -> Ask:
    return asking(port)


def plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, tuple) else np.asarray(value).tolist()


def observations(name: str, count: int = STEPS, rows: int | None = None, seed: int = 0) -> list[Any]:
    """Return `count` observations (batches of `rows`) of one of the policies."""
    rng = np.random.default_rng(seed)
    lead = () if rows is None else (rows,)
    if name != "act_nested":
        return [rng.uniform(-1, 1, (*lead, 3)).astype(np.float32) for _ in range(count)]
    return [
        {
            "zeta": rng.uniform(-2, 2, (*lead, 2)).astype(np.float32),
            "arm": {"mode": rng.integers(0, 3, lead), "flags": rng.integers(0, 2, (*lead, 4)).astype(np.int8)},
            "grid": (rng.integers(0, 2, (*lead, 2)), rng.integers(0, 10, (*lead, 2, 2)).astype(np.int32)),
        }
        for _ in range(count)
    ]


def in_process(recurrent: Path, name: str, seen: list[Any]) -> list[Any]:
    """Return the actions of an episode in process."""
    with Policy.load(recurrent / name) as policy:
        rewarded = any(tensor.name == "reward" for tensor in policy.contract.inputs)
        return [policy.act(obs, reward=reward_of(i, obs) if rewarded else None) for i, obs in enumerate(seen)]


def reward_of(step: int, obs: Any) -> Any:
    return 0.25 * step if np.ndim(obs) == 1 else [0.25 * step + 0.1 * row for row in range(len(obs))]


def same(store: PolicyStore, name: str, got: Any, expected: Any) -> None:
    space = store.get(name).contract.action_space
    ours, theirs = action_leaves(space, got), action_leaves(space, expected)
    assert ours.keys() == theirs.keys() == leaf_specs(space, "action").keys()
    for path, leaf in theirs.items():
        np.testing.assert_allclose(ours[path], leaf, rtol=1e-5, atol=1e-6, err_msg=path)


NAMES = pytest.mark.parametrize("name", ["lstm_box", "lstm_previous", "act_nested"])


# The client carries the memory.


@NAMES
@pytest.mark.parametrize("rows", [None, 3])
def test_a_state_that_travels_in_json_gives_the_policys_own_episode(
    ask: Ask, store: PolicyStore, recurrent: Path, name: str, rows: int | None
) -> None:
    seen = observations(name, rows=rows)
    state: Any = {}
    for step, (obs, action) in enumerate(zip(seen, in_process(recurrent, name, seen), strict=True)):
        reward = {"reward": reward_of(step, obs)} if name == "lstm_previous" else {}
        status, reply = ask(f"/v1/policies/{name}/act", {"obs": plain(obs), "state": state, **reward})
        assert status == 200, reply
        same(store, name, reply["action"], action)
        state = reply["state"]
        assert set(state) == {"@policy", *(spec.name for spec in store.get(name).contract.state)}


@NAMES
def test_a_recurrent_policy_is_never_begun_anew_by_accident(ask: Ask, name: str) -> None:
    (obs,) = observations(name, 1)
    status, reply = ask(f"/v1/policies/{name}/act", {"obs": plain(obs)})
    assert (status, reply["code"]) == (400, "bad-request")
    assert "remembers its episode: send 'state' ({} begins one" in reply["error"]
    status, reply = ask(f"/v1/policies/{name}/act", {"obs": plain(obs), "state": None})
    assert status == 400  # what a generated client sends for an unset field
    (batch,) = observations(name, 1, rows=1)
    status, reply = ask(f"/v2/models/{name}/infer", {"inputs": tensors(batch, name)})
    assert status == 400 and "remembers its episode" in reply["error"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"state": {"h": [[0.0] * 8]}}, "missing c"),
        ({"state": {"h": [[0.0] * 8], "c": [[0.0] * 7]}}, "state 'c' of shape (1, 8), got (1, 7)"),
        ({"state": {"h": [["x"] * 8], "c": [[0.0] * 8]}}, "state 'h' of policy 'lstm_box' cannot be read"),
        ({"state": {"h": [[1e39] * 8], "c": [[0.0] * 8]}}, "not finite"),
        ({"state": {"h": 1, "c": 1, "z": 1}}, "unknown z"),
        ({"state": 7}, "'state' must be an object"),
        ({"state": {}, "session_id": "a"}, "has both 'state' and 'session_id'"),
        ({"state": {}, "end": True}, "'end' needs a session"),
        ({"session_id": ""}, "'session_id' must have at least 1 character"),
        ({"session_id": "a", "reset": 1}, "'reset' must be true or false"),
        ({"state": {}, "last_action": [0.0]}, "of last_action of shape (2,), got (1,)"),
        ({"state": {}, "last_action": [0.0, 7.0]}, "action is not in the action space"),
        ({"state": {}, "last_action": {"a": 1}}, "last_action of policy 'lstm_box' cannot be read"),
    ],
)
def test_what_does_not_fit_an_episode_is_refused_by_name(ask: Ask, change: dict[str, Any], sentence: str) -> None:
    status, reply = ask("/v1/policies/lstm_box/act", {"obs": [0.1, 0.2, 0.3], **change})
    assert status == 400 and sentence in reply["error"], reply


def test_a_reward_that_is_missing_is_asked_for(ask: Ask) -> None:
    _, reply = ask("/v1/policies/lstm_previous/act", {"obs": [0.1, 0.2, 0.3], "state": {}})
    status, reply = ask("/v1/policies/lstm_previous/act", {"obs": [0.1, 0.2, 0.3], "state": reply["state"]})
    assert status == 400 and "trained to see the reward" in reply["error"]


# The server keeps the memory.


@NAMES
def test_a_session_gives_the_policys_own_episode_and_sessions_do_not_mix(
    ask: Ask, store: PolicyStore, recurrent: Path, name: str
) -> None:
    runs = {
        key: observations(name, seed=number, rows=rows) for number, (key, rows) in enumerate([("a", None), ("b", 2)])
    }
    expected = {key: in_process(recurrent, name, seen) for key, seen in runs.items()}
    for step in range(STEPS):
        for key, seen in runs.items():
            reward = {"reward": reward_of(step, seen[step])} if name == "lstm_previous" else {}
            request = {"obs": plain(seen[step]), "session_id": key, "reset": step == 0, "end": step == STEPS - 1}
            status, reply = ask(f"/v1/policies/{name}/act", {**request, **reward})
            assert status == 200, reply
            same(store, name, reply["action"], expected[key][step])
            assert (reply["session_id"], reply["session_step"], "state" in reply) == (key, step + 1, False)
    status, reply = ask(f"/v1/policies/{name}/act", {"obs": plain(runs["a"][0]), "session_id": "a"})
    assert (status, reply["code"]) == (410, "session-lost")


def session(ask: Ask, obs: Any, **more: Any) -> tuple[int, Any]:
    return ask("/v1/policies/lstm_box/act", {"obs": plain(obs), "session_id": "s", **more})


def test_an_idle_session_is_evicted_and_its_client_learns_of_it(ask: Ask) -> None:
    first, second = observations("lstm_box", 2)
    begun = session(ask, first, reset=True)[1]["action"]
    assert session(ask, second)[0] == 200
    time.sleep(2.2)
    status, reply = session(ask, second)
    assert (status, reply["code"]) == (410, "session-lost") and "was idle for 2 s" in reply["error"]
    assert session(ask, second)[0] == 410  # and it does not come back by asking again
    assert session(ask, first, reset=True)[1]["action"] == begun


def test_sessions_are_bounded_in_number(store: PolicyStore) -> None:
    (obs,) = observations("lstm_box", 1)
    body = {"obs": plain(obs), "reset": True}
    with over_uvicorn(create_app(control_of(store), ServerSettings(max_sessions=8))) as port:
        ask = asking(port)
        statuses = [ask("/v1/policies/lstm_box/act", {**body, "session_id": f"many-{n}"})[0] for n in range(9)]
        assert statuses == [200] * 8 + [503]
        assert ask("/v1/policies/lstm_box/act", {**body, "session_id": "many-0"})[0] == 200  # it has its place already
        for n in range(9):
            ask("/v1/policies/lstm_box/act", {"obs": plain(obs), "session_id": f"many-{n}", "end": True})
        assert ask("/v1/policies/lstm_box/act", {**body, "session_id": "many-8", "end": True})[0] == 200


def test_a_request_sent_twice_moves_the_memory_once_and_an_older_one_is_refused(ask: Ask, recurrent: Path) -> None:
    seen = observations("lstm_box", 4)
    expected = in_process(recurrent, "lstm_box", seen)
    for step, obs in enumerate(seen):
        for _ in range(2):  # the reply got lost, say, and the client asks again
            status, reply = session(ask, obs, reset=step == 0, seq=step)
            assert (status, reply["seq"]) == (200, step)
            np.testing.assert_allclose(reply["action"], expected[step], rtol=1e-5, atol=1e-6)
    status, reply = session(ask, seen[0], seq=1)
    assert (status, reply["code"]) == (409, "session-conflict") and "request 1 came after request 3" in reply["error"]


def test_a_refused_request_leaves_the_memory_where_it_was(ask: Ask, recurrent: Path) -> None:
    seen = observations("lstm_box", 3)
    expected = in_process(recurrent, "lstm_box", seen)
    for step, obs in enumerate(seen):
        reply = session(ask, obs, reset=step == 0)[1]
        np.testing.assert_allclose(reply["action"], expected[step], rtol=1e-5, atol=1e-6)
        assert session(ask, obs[:2])[0] == 422
        assert session(ask, obs, deadline_ms=0)[0] == 408
        assert session(ask, [obs, obs])[0] == 400  # it remembers one episode, not two
        assert session(ask, obs, explore=True, seed=-1)[0] == 400


def test_a_session_stays_with_its_version_until_that_is_gone(tmp_path: Path) -> None:
    one, two = (
        Policy.load(write_leaky_policy(tmp_path, version=version, seed=seed)) for seed, version in enumerate("12")
    )
    stores = [store_of(one), store_of(one, two), store_of(two)]
    now = 0
    obs = [0.5, -0.25, 1.0]
    with over_uvicorn(create_app(control_of(lambda: stores[now]), ServerSettings())) as port:
        ask = asking(port)

        def step(**more: Any) -> tuple[int, Any]:
            return ask("/v1/policies/leaky/act", {"obs": obs, "session_id": "s", **more})

        assert step(reset=True)[1]["version"] == "1"
        now = 1
        assert step()[1]["version"] == "1"  # the newest is 2 by now
        assert ask("/v1/policies/leaky/act", {"obs": obs, "state": {}})[1]["version"] == "2"
        status, reply = ask("/v1/policies/leaky/versions/2/act", {"obs": obs, "session_id": "s"})
        assert (status, reply["code"]) == (409, "session-conflict")
        now = 2
        status, reply = step()
        assert (status, reply["code"]) == (410, "session-lost") and "no longer loaded" in reply["error"]
        assert step(reset=True)[1]["version"] == "2"


def test_an_open_stream_without_a_memory_follows_the_default(tmp_path: Path) -> None:
    one, two = (
        Policy.load(write_box_policy(tmp_path, version=version, seed=seed)) for seed, version in enumerate("12")
    )
    stores = [store_of(one), store_of(one, two)]
    now = 0
    obs = np.linspace(-1, 1, 27)
    with (
        over_uvicorn(create_app(control_of(lambda: stores[now]), ServerSettings())) as port,
        StreamClient(f"http://127.0.0.1:{port}", "ur5", deadline_ms=5000) as client,
    ):
        assert client.act(obs) == pytest.approx(one.act(obs))
        now = 1
        for _ in range(3):
            assert client.act(obs) == pytest.approx(two.act(obs))


def test_a_stream_begins_its_next_episode_with_the_bundle_that_is_there_now(
    store: PolicyStore, recurrent: Path
) -> None:
    again = Policy.load(recurrent / "lstm_box")
    stores = [store, store_of(again)]
    now = 0
    obs = observations("lstm_box", 1)[0]
    with (
        over_uvicorn(create_app(control_of(lambda: stores[now]), ServerSettings())) as port,
        Stream(port, "/v1/policies/lstm_box/stream?errors=keep") as stream,
    ):
        assert stream.ask(obs=obs)["session_step"] == 1
        now = 1  # the same version, loaded again
        assert stream.ask(obs=obs)["code"] == "session-lost"
        assert stream.ask(obs=obs, reset=True)["session_step"] == 1
        assert stream.ask(obs=obs)["session_step"] == 2


def test_no_odd_request_gets_a_5xx(ask: Ask) -> None:
    rng = random.Random(0)

    def odd(depth: int = 0) -> Any:
        if depth < 3 and rng.random() < 0.4:
            if rng.random() < 0.5:
                return [odd(depth + 1) for _ in range(rng.choice([0, 1, 3, 8]))]
            return {rng.choice(["h", "c", "a", "b", "zeta", "arm"]): odd(depth + 1) for _ in range(rng.randrange(4))}
        return rng.choice([0, -1, 10**30, 0.5, 1e308, 1e39, "", "nan", True, None, [0.1, 0.2, 0.3]])

    fields = ("state", "session_id", "reset", "end", "reward", "last_action", "seq", "timestamp", "explore", "seed")
    usual = {"state": {}, "session_id": "odd", "reset": True, "reward": 0.5, "last_action": [0.1, 0.1], "seq": 1}
    seen: dict[int, int] = {}
    for _ in range(700):
        name = rng.choice(["lstm_box", "lstm_previous", "act_nested"])
        obs = plain(observations(name, 1)[0]) if rng.random() < 0.8 else odd()
        chosen = [field for field in fields if rng.random() < 0.3]
        more = {field: usual[field] if field in usual and rng.random() < 0.7 else odd() for field in chosen}
        status, reply = ask(f"/v1/policies/{name}/act", {"obs": obs, **more})
        seen[status] = seen.get(status, 0) + 1
        assert status < 500, (more, reply)
    assert seen[200] > 20 and seen[400] > 100, seen


# Open Inference Protocol.


def tensors(obs: Any, name: str, **states: Any) -> list[dict[str, Any]]:
    """Return the protocol's inputs for a batch."""
    types = {"float32": "FP32", "int64": "INT64", "int8": "INT8", "int32": "INT32"}
    leaves = {"obs": obs} if name != "act_nested" else {
        "obs.zeta": obs["zeta"], "obs.arm.mode": obs["arm"]["mode"], "obs.arm.flags": obs["arm"]["flags"],
        "obs.grid.0": obs["grid"][0], "obs.grid.1": obs["grid"][1],
    }  # fmt: skip
    return [
        {"name": path, "shape": list(np.shape(leaf)), "datatype": types[leaf.dtype.name], "data": leaf.tolist()}
        for path, leaf in ((path, np.asarray(leaf)) for path, leaf in {**leaves, **states}.items())
    ]


def outputs(reply: Any) -> dict[str, Any]:
    return {one["name"]: np.array(one["data"]).reshape(one["shape"]) for one in reply["outputs"]}


@NAMES
def test_states_are_tensors_of_the_open_inference_protocol(
    ask: Ask, store: PolicyStore, recurrent: Path, name: str
) -> None:
    contract = store.get(name).contract
    seen = observations(name, rows=2)
    state = {f"state_in.{spec.name}": spec.initial_value(2) for spec in contract.state}
    for step, (obs, action) in enumerate(zip(seen, in_process(recurrent, name, seen), strict=True)):
        more = {"reward": np.float32(reward_of(step, obs) if step else [0, 0])} if name == "lstm_previous" else {}
        status, reply = ask(f"/v2/models/{name}/infer", {"inputs": tensors(obs, name, **state, **more)})
        assert status == 200, reply
        got = outputs(reply)
        for path, leaf in action_leaves(contract.action_space, action).items():
            np.testing.assert_allclose(got[path], leaf, rtol=1e-5, atol=1e-6)
        state = {f"state_in.{spec.name}": got[f"state_out.{spec.name}"].astype(spec.dtype) for spec in contract.state}


@NAMES
@pytest.mark.parametrize("sequence", [7, "seven"])
def test_sequences_of_the_open_inference_protocol_are_sessions(
    ask: Ask, store: PolicyStore, recurrent: Path, name: str, sequence: Any
) -> None:
    seen = observations(name, rows=2)
    space = store.get(name).contract.action_space
    for step, (obs, action) in enumerate(zip(seen, in_process(recurrent, name, seen), strict=True)):
        more = {"reward": np.float32(reward_of(step, obs))} if name == "lstm_previous" else {}
        flags = {"sequence_start": step == 0, "sequence_end": step == STEPS - 1}
        request = {"inputs": tensors(obs, name, **more), "parameters": {"sequence_id": sequence, **flags}}
        status, reply = ask(f"/v2/models/{name}/infer", request)
        assert status == 200, reply
        assert (reply["parameters"]["sequence_id"], reply["parameters"]["session_step"]) == (sequence, step + 1)
        got = outputs(reply)
        assert set(got) == set(leaf_specs(space, "action"))
        for path, leaf in action_leaves(space, action).items():
            np.testing.assert_allclose(got[path], leaf, rtol=1e-5, atol=1e-6)
    status, reply = ask(f"/v2/models/{name}/infer", request)
    assert (status, reply["code"]) == (410, "session-lost")


def test_the_models_metadata_lists_states_and_leaves(port: int) -> None:
    model = exchange(port, "GET", "/v2/models/act_nested").document
    assert {"name": "obs.arm.mode", "datatype": "INT64", "shape": [-1]} in model["inputs"]
    assert {"name": "state_in.h", "datatype": "FP32", "shape": [-1, 1, 8]} in model["inputs"]
    assert [one["name"] for one in model["outputs"]] == [
        "action.a.0", "action.a.1", "action.b", "state_out.c", "state_out.h"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "status", "sentence"),
    [
        ({"inputs": ["obs.zeta"]}, 422, "needs the input 'obs.arm.flags', which is missing"),
        (
            {"outputs": [{"name": "action"}]},
            400,
            "the output 'action' does not exist: expected 'action.a.0'",
        ),
        ({"outputs": [{"name": "state_out.h"}], "parameters": {"sequence_id": 1}}, 400, "is kept with the sequence"),
        ({"parameters": {"sequence_id": 1.5}}, 400, "'sequence_id' must be an integer"),
        ({"parameters": {"sequence_start": 1}}, 400, "'sequence_start' must be true or false"),
        ({"rows": 3}, 422, "have different batch sizes: obs.arm.flags 2, obs.arm.mode 3"),
    ],
)
def test_a_wrong_nested_request_is_told_what_is_wrong(
    ask: Ask, change: dict[str, Any], status: int, sentence: str
) -> None:
    inputs = tensors(observations("act_nested", 1, rows=2)[0], "act_nested")
    if "inputs" in change:
        inputs = [one for one in inputs if one["name"] in change["inputs"]]
    if "rows" in change:
        inputs[1].update(shape=[3], data=[0, 0, 0])
    more = {key: value for key, value in change.items() if key in ("outputs", "parameters")}
    got, reply = ask("/v2/models/act_nested/infer", {"inputs": inputs, **more})
    assert got == status and sentence in reply["error"], reply


# WebSocket.


@NAMES
def test_a_stream_remembers_its_episode_until_reset(port: int, store: PolicyStore, recurrent: Path, name: str) -> None:
    seen = observations(name)
    expected = in_process(recurrent, name, seen)
    with Stream(port, f"/v1/policies/{name}/stream") as one, Stream(port, f"/v1/policies/{name}/stream") as other:
        for episode in range(2):
            for step, (obs, action) in enumerate(zip(seen, expected, strict=True)):
                reward = {"reward": reward_of(step, obs)} if name == "lstm_previous" else {}
                reset = {"reset": True} if episode and not step else {}
                reply = one.ask(obs=obs, **reward, **reset)
                assert reply["session_step"] == step + 1
                same(store, name, first_of(reply["actions"]), action)
                other.ask(obs=seen[-1], **reward)  # which does not disturb


def first_of(chunk: Any) -> Any:
    """Return the one action of a chunk, leaf by leaf."""
    if isinstance(chunk, dict):
        return {key: first_of(part) for key, part in chunk.items()}
    return [first_of(part) for part in chunk] if isinstance(chunk, list) else chunk[0]


def test_a_flag_in_an_openpi_clients_observation_map_resets(port: int, store: PolicyStore, recurrent: Path) -> None:
    seen = observations("act_nested", 2)
    expected = in_process(recurrent, "act_nested", seen)
    with Stream(port, "/v1/policies/act_nested/stream") as stream:
        for _ in range(2):
            same(store, "act_nested", first_of(stream.ask(**seen[0], reset=True)["actions"]), expected[0])
            same(store, "act_nested", first_of(stream.ask(**seen[1])["actions"]), expected[1])


def test_a_stream_may_carry_its_state_itself(port: int, store: PolicyStore, recurrent: Path) -> None:
    seen = observations("lstm_box", rows=2)
    state: Any = {}
    for obs, action in zip(seen, in_process(recurrent, "lstm_box", seen), strict=True):
        with Stream(port, "/v1/policies/lstm_box/stream") as stream:  # another connection for every step
            reply = stream.ask(obs=obs, state=state)
            np.testing.assert_allclose(reply["actions"][:, 0], action, rtol=1e-5, atol=1e-6)
            state = reply["state"]


def test_a_stream_that_keeps_errors_goes_on_after_one(port: int, recurrent: Path) -> None:
    seen = observations("lstm_box", 3)
    expected = in_process(recurrent, "lstm_box", seen)
    with Stream(port, "/v1/policies/lstm_box/stream?errors=keep") as stream:
        for step, obs in enumerate(seen):
            wrong = stream.ask(obs=obs[:2], seq=100 + step)
            assert (wrong["code"], wrong["seq"]) == ("bad-observation", 100 + step)
            late = stream.ask(obs=obs, seq=200 + step, deadline_ms=0)
            assert (late["code"], late["seq"]) == ("deadline-passed", 200 + step)
            reply = stream.ask(obs=obs, seq=step)
            assert reply["seq"] == step
            np.testing.assert_allclose(reply["actions"][0], expected[step], rtol=1e-5, atol=1e-6)
    with Stream(port, "/v1/policies/lstm_box/stream") as stream:
        stream.ask(obs=seen[0][:2])
        with pytest.raises(ConnectionClosed):
            stream.ask(obs=seen[0])


def test_timestamps_are_echoed_over_every_protocol(port: int, ask: Ask) -> None:
    obs = np.zeros(27, np.float32)
    before = time.time()
    _, plainly = ask("/v1/policies/ur5/act", {"obs": obs.tolist(), "timestamp": 12.5, "seq": 1})
    inputs = [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": obs.tolist()}]
    _, inferred = ask("/v2/models/ur5/infer", {"inputs": inputs, "parameters": {"timestamp": 12.5, "seq": 1}})
    with Stream(port, "/v1/policies/ur5/stream") as stream:
        streamed = stream.ask(obs=obs, timestamp=12.5, seq=1)
    for reply in (plainly, inferred["parameters"], streamed):
        assert (reply["timestamp"], reply["seq"]) == (12.5, 1)
        assert before - 1 <= reply["received_at"] <= reply["sent_at"] <= time.time() + 1
    assert "sent_at" not in ask("/v1/policies/ur5/act", {"obs": obs.tolist()})[1]
