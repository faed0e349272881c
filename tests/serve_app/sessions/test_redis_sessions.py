"""Sessions by id in a real Redis: two servers, one memory, and faults of the store."""

from __future__ import annotations

import contextlib
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from bundles import write_leaky_policy
from rlservo.bundle.nested import action_leaves
from rlservo.client.policy_client import PolicyClient
from rlservo.errors import UsageError
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from storages import RedisServer, closing_sessions
from stores import control_of, load_store, store_of

SEEN = [np.random.default_rng(seed).uniform(-1, 1, 3).astype(np.float32) for seed in range(12)]


class Servers:
    """Two servers that share a Redis; requests go to one and the other."""

    def __init__(self, *ports: int) -> None:
        self._clients = [httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=20) for port in ports]
        self._asked = 0

    def post(self, path: str, body: Any) -> tuple[int, Any]:
        self._asked += 1
        reply = self._clients[self._asked % len(self._clients)].post(path, json=body)
        return reply.status_code, reply.json()

    def act(self, obs: Any, session_id: str = "s", policy: str = "lstm_box", **more: Any) -> tuple[int, Any]:
        body = {"obs": np.asarray(obs).tolist(), "session_id": session_id, **more}
        return self.post(f"/v1/policies/{policy}/act", body)

    def infer(self, obs: Any, sequence_id: int | str, **parameters: Any) -> tuple[int, Any]:
        rows = np.atleast_2d(obs)
        tensor = {"name": "obs", "shape": list(rows.shape), "datatype": "FP32", "data": rows.tolist()}
        body = {"inputs": [tensor], "parameters": {"sequence_id": sequence_id, **parameters}}
        return self.post("/v2/models/lstm_box/infer", body)

    def metric(self, name: str) -> float:
        texts = [client.get("/metrics").text for client in self._clients]
        return sum(
            float(line.rpartition(" ")[2]) for text in texts for line in text.splitlines() if line.startswith(name)
        )

    def close(self) -> None:
        for client in self._clients:
            client.close()


@pytest.fixture(scope="module")
def store(recurrent: Path, ur5: Path) -> PolicyStore:
    return load_store(recurrent, ur5)


@contextlib.contextmanager
def serving(redis: RedisServer, *providers: Callable[[], PolicyStore], **settings: Any) -> Iterator[Servers]:
    """Serve what each provider gives, by a server of its own."""
    chosen = ServerSettings(session_store=redis.url, **settings)
    with contextlib.ExitStack() as stack:
        apps = [create_app(control_of(provider), chosen, is_alone=False) for provider in providers]
        servers = Servers(*(stack.enter_context(over_uvicorn(closing_sessions(app))) for app in apps))
        stack.callback(servers.close)
        yield servers


@pytest.fixture
def servers(store: PolicyStore, redis_server: RedisServer) -> Iterator[Servers]:
    with serving(redis_server, lambda: store, lambda: store) as servers:
        yield servers


def same(got: Any, expected: Any) -> None:
    """Assert that an action in JSON is this one, bit for bit."""
    np.testing.assert_array_equal(np.asarray(got, np.asarray(expected).dtype), expected)


@pytest.mark.parametrize("rows", [None, 3])
def test_an_episode_whose_steps_reach_two_servers_has_the_policys_own_actions(
    servers: Servers, recurrent: Path, rows: int | None
) -> None:
    with Policy.load(recurrent / "lstm_box") as policy:
        for episode in range(2):
            policy.reset()
            for step, obs in enumerate(SEEN):
                given = obs if rows is None else np.stack([obs] * rows)
                status, reply = servers.act(given, reset=step == 0, end=step == 11)
                assert (status, reply["session_step"]) == (200, step + 1), (episode, reply)
                same(reply["action"], policy.act(given))
    status, reply = servers.act(SEEN[0])
    assert (status, reply["code"]) == (410, "session-lost") and "begin an episode" in reply["error"]


def test_sequences_of_the_open_inference_protocol_reach_two_servers(servers: Servers, recurrent: Path) -> None:
    with Policy.load(recurrent / "lstm_box") as policy:
        for step, obs in enumerate(SEEN):
            action = policy.act(obs)
            for sequence in (7, "7"):
                status, reply = servers.infer(obs, sequence, sequence_start=step == 0, sequence_end=step == 11)
                assert (status, reply["parameters"]["sequence_id"]) == (200, sequence)
                servers.act(obs, "other", reset=step == 0)  # so that each server gets both
                (output,) = reply["outputs"]
                same(output["data"], action)
    assert servers.infer(SEEN[0], 7)[0] == 410


def test_nested_actions_rewards_and_a_limit_on_the_step_are_kept(
    redis_server: RedisServer, recurrent: Path, tmp_path: Path
) -> None:
    options = {"leaky": PolicyOptions(max_action_step=0.1)}
    store = load_store(recurrent, write_leaky_policy(tmp_path), options=options)
    nested = {
        "zeta": [0.5, -1.0], "arm": {"mode": 1, "flags": [1, 0, 1, 0]}, "grid": [[1, 0], [[3, 4], [0, 9]]],
    }  # fmt: skip
    with serving(redis_server, lambda: store, lambda: store) as servers:
        for name in ("act_nested", "lstm_previous", "leaky"):
            policy = store.get(name).clone()
            for step in range(6):
                obs: Any = nested if name == "act_nested" else (SEEN[0] * (-1) ** step).tolist()
                more = {"reward": 0.5 * step} if name == "lstm_previous" else {}
                fields = {"obs": obs, "session_id": "s", "reset": step == 0, **more}
                for _ in range(2):  # the second is an answer from Redis
                    status, reply = servers.post(f"/v1/policies/{name}/act", {**fields, "seq": step})
                    assert (status, reply["session_step"]) == (200, step + 1), reply
                    if step == 0:
                        break
                given = obs if name != "act_nested" else {**nested, "grid": tuple(nested["grid"])}
                action = policy.act(given, **more)
                space = policy.contract.action_space
                for path, leaf in action_leaves(space, reply["action"]).items():
                    same(leaf, action_leaves(space, action)[path])
            assert (name == "leaky") == ("warnings" in reply)


def test_a_request_sent_again_to_another_server_gets_the_same_action_and_moves_nothing(servers: Servers) -> None:
    servers.act(SEEN[0], reset=True, seq=1)
    _, first = servers.act(SEEN[1], seq=2, explore=True)  # a random action: computed again it would be another
    for _ in range(3):
        assert servers.act(SEEN[1], seq=2, explore=True) == (200, first)
    status, reply = servers.act(SEEN[2], seq=2)
    assert (status, reply["code"]) == (409, "session-conflict") and "for another observation" in reply["error"]
    assert servers.act(SEEN[2], seq=1)[0] == 409
    _, last = servers.act(SEEN[3], seq=3, end=True)
    assert last["session_step"] == 3
    assert servers.act(SEEN[3], seq=3, end=True) == (200, last)
    assert servers.act(SEEN[4], seq=4)[0] == 410


def test_steps_of_one_session_that_come_at_once_are_computed_one_after_the_other(
    store: PolicyStore, redis_server: RedisServer, recurrent: Path
) -> None:
    with (
        serving(redis_server, lambda: store, lambda: store, max_queue_ms=60_000) as servers,
        ThreadPoolExecutor(16) as pool,
    ):
        servers.act(SEEN[0], reset=True)
        replies = [reply for _, reply in pool.map(lambda _: servers.act(SEEN[0]), range(32))]
    assert sorted(reply["session_step"] for reply in replies) == list(range(2, 34))
    with Policy.load(recurrent / "lstm_box") as policy:
        expected = [policy.act(SEEN[0]) for _ in range(33)]
    for reply in replies:
        same(reply["action"], expected[reply["session_step"] - 1])


def test_a_redis_that_comes_back_with_an_old_copy_gives_no_old_memory(
    servers: Servers, redis_server: RedisServer, recurrent: Path
) -> None:
    servers.act(SEEN[0], reset=True)
    servers.act(SEEN[0], "saved last", reset=True)
    redis_server.command("SAVE")
    for session_id in ("s", "began after"):
        servers.act(SEEN[1], session_id, reset=session_id != "s")
    redis_server.kill()
    redis_server.start()
    assert redis_server.command("DBSIZE") == b"2\n"
    for session_id in ("s", "saved last", "began after"):
        for _ in range(2):
            assert servers.act(SEEN[2], session_id)[0] == 410
    with Policy.load(recurrent / "lstm_box") as policy:
        for step, obs in enumerate(SEEN):
            same(servers.act(obs, reset=step == 0)[1]["action"], policy.act(obs))


@pytest.mark.parametrize("how", ["killed", "stopped"])
def test_without_redis_sessions_are_503_and_work_again_when_it_is_back(
    servers: Servers, redis_server: RedisServer, recurrent: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    servers.act(SEEN[0], reset=True)
    redis_server.kill() if how == "killed" else redis_server.signal(signal.SIGSTOP)
    for reset in (False, True):
        asked = time.monotonic()
        status, reply = servers.act(SEEN[1], reset=reset)
        assert (status, reply["code"]) == (503, "unavailable") and "carry the 'state' in each request" in reply["error"]
        assert time.monotonic() - asked < 5
    with Policy.load(recurrent / "lstm_box") as policy:
        carried = servers.post("/v1/policies/lstm_box/act", {"obs": SEEN[0].tolist(), "state": {}})
        same(carried[1]["action"], policy.act(SEEN[0]))
        assert servers.act(np.zeros(27), policy="ur5")[0] == 200  # which remembers nothing
        redis_server.start() if how == "killed" else redis_server.signal(signal.SIGCONT)
        status, reply = servers.act(SEEN[1])
        if how == "killed":
            assert status == 410
        else:
            same(reply["action"], policy.act(SEEN[1]))
    assert servers.act(SEEN[0], reset=True)[0] == 200
    assert servers.metric("rlservo_session_store_failures_total") == 2
    said = [record.message for record in caplog.records if "Redis" in record.message]
    assert sum("cannot be used" in line for line in said) == sum("again" in line for line in said) == 2  # each server


def test_a_proxy_without_a_redis_behind_it_is_503(store: PolicyStore) -> None:
    def reset_connections() -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                connection = listener.accept()[0]
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(9) as pool:
        pool.submit(reset_connections)
        settings = ServerSettings(session_store=f"redis://127.0.0.1:{listener.getsockname()[1]}/0")
        try:
            with over_uvicorn(closing_sessions(create_app(control_of(store), settings, is_alone=False))) as port:

                def ask(_: int) -> tuple[int, str]:
                    with contextlib.closing(Servers(port)) as server:
                        status, reply = server.act(SEEN[0], reset=True)
                        return status, reply["code"]

                assert set(pool.map(ask, range(32))) == {(503, "unavailable")}
        finally:
            listener.shutdown(socket.SHUT_RDWR)


def test_a_full_redis_refuses_a_step_and_leaves_the_memory_where_it_was(
    servers: Servers, redis_server: RedisServer, recurrent: Path
) -> None:
    with Policy.load(recurrent / "lstm_box") as policy:
        same(servers.act(SEEN[0], reset=True)[1]["action"], policy.act(SEEN[0]))
        redis_server.command("CONFIG", "SET", "maxmemory", "1")
        assert servers.act(SEEN[1])[0] == 503
        redis_server.command("CONFIG", "SET", "maxmemory", "0")
        same(servers.act(SEEN[1])[1]["action"], policy.act(SEEN[1]))


def test_a_server_that_stood_still_between_reading_and_writing_writes_nothing_over_a_newer_memory(
    store: PolicyStore, redis_server: RedisServer, recurrent: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, go_on = threading.Event(), threading.Event()
    its_store = load_store(recurrent)
    its_policy = its_store.get("lstm_box")
    compute = its_policy.step

    def stand_still(*arguments: Any, **more: Any) -> Any:
        held.set()
        assert go_on.wait(20)
        return compute(*arguments, **more)

    with (
        serving(redis_server, lambda: its_store) as one,
        serving(redis_server, lambda: store) as other,
        Policy.load(recurrent / "lstm_box") as policy,
        ThreadPoolExecutor(1) as pool,
    ):
        same(one.act(SEEN[0], reset=True)[1]["action"], policy.act(SEEN[0]))
        monkeypatch.setattr(its_policy, "step", stand_still)
        late = pool.submit(one.act, SEEN[1], seq=1)
        assert held.wait(20)
        same(other.act(SEEN[1], seq=1)[1]["action"], policy.act(SEEN[1]))  # given up and sent again
        same(other.act(SEEN[2], seq=2)[1]["action"], policy.act(SEEN[2]))
        go_on.set()
        status, reply = late.result(20)
        assert (status, reply["code"]) == (409, "session-conflict")
        same(other.act(SEEN[3], seq=3)[1]["action"], policy.act(SEEN[3]))


def test_a_session_without_a_step_is_forgotten_by_redis(store: PolicyStore, redis_server: RedisServer) -> None:
    with serving(redis_server, lambda: store, session_idle_s=0.5) as servers:
        assert servers.act(SEEN[0], reset=True)[0] == 200
        for _ in range(4):
            time.sleep(0.2)
            assert servers.act(SEEN[0])[0] == 200
        time.sleep(0.6)
        assert servers.act(SEEN[0])[0] == 410
        assert redis_server.command("DBSIZE") == b"0\n"


def test_a_session_stays_with_its_version_on_every_server(redis_server: RedisServer, tmp_path: Path) -> None:
    folders = [write_leaky_policy(tmp_path, version=version, seed=seed) for seed, version in enumerate("12")]
    both = [store_of(*map(Policy.load, folders)) for _ in range(2)]  # as two processes load them
    only_new = store_of(Policy.load(folders[1]))
    now: list[PolicyStore] = [store_of(Policy.load(folders[0]))] * 2
    with serving(redis_server, lambda: now[0], lambda: now[1]) as servers:
        assert servers.act(SEEN[0], policy="leaky", reset=True)[1]["version"] == "1"
        now[:] = both
        for _ in range(2):
            assert servers.act(SEEN[0], policy="leaky")[1]["version"] == "1"
            assert servers.act(SEEN[0], "new", policy="leaky", reset=True)[1]["version"] == "2"
        now[:] = [only_new] * 2
        assert servers.act(SEEN[0], policy="leaky")[0] == 410
        assert servers.act(SEEN[0], policy="leaky", reset=True)[1]["version"] == "2"


def test_our_client_keeps_a_session_over_two_servers(
    store: PolicyStore, redis_server: RedisServer, recurrent: Path
) -> None:
    settings = ServerSettings(session_store=redis_server.url)
    with (
        over_uvicorn(closing_sessions(create_app(control_of(store), settings, is_alone=False))) as port,
        over_uvicorn(closing_sessions(create_app(control_of(store), settings, is_alone=False))) as other,
        PolicyClient(f"http://127.0.0.1:{port}", "lstm_box", server_state=True) as client,
        PolicyClient(f"http://127.0.0.1:{other}", "ur5", server_state=True) as stateless,
        Policy.load(recurrent / "lstm_box") as policy,
    ):
        for _ in range(2):
            policy.reset()
            client.reset()
            for obs in SEEN:
                np.testing.assert_array_equal(client.act(obs), policy.act(obs))
                stateless.act(np.zeros(27))


def test_several_processes_without_a_store_refuse_sessions_and_name_the_ways_out(store: PolicyStore) -> None:
    with over_uvicorn(create_app(control_of(store), ServerSettings(), is_alone=False)) as port:
        servers = Servers(port)
        for status, reply in (servers.act(SEEN[0], reset=True), servers.infer(SEEN[0], 7, sequence_start=True)):
            assert (status, reply.get("code", "bad-request")) == (400, "bad-request")
            for way in ("'state'", "WebSocket", "one worker", "--session-store redis://"):
                assert way in reply["error"]
        assert servers.act(np.zeros(27), policy="ur5", reset=True)[0] == 200
        servers.close()


@pytest.mark.parametrize("url", ["localhost:6379", "redis://:secret@127.0.0.1:port/0", "http://127.0.0.1"])
def test_an_unusable_store_is_one_sentence_without_the_password(store: PolicyStore, url: str) -> None:
    with pytest.raises(UsageError, match="redis://") as caught:
        RequestHandler(control_of(store), ServerSettings.from_environment({"session_store": url}, environment={}))
    assert "secret" not in caught.value.message
