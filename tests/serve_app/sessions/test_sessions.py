"""Sessions in a server: their number, lifetime and keys, and their state after a refusal."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from bundles import write_leaky_policy
from rlservo.client.policy_client import PolicyClient
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.memory_sessions import MemorySessions
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from stores import control_of, load_store
from streams import Stream
from waiting import wait_for

OBS = [0.5, -0.25, 1.0]
MOST = 8
STREAM = "/v1/policies/leaky/stream?errors=keep"


class Server:
    def __init__(self, port: int, app: Any, client: httpx.Client) -> None:
        self.port = port
        self.sessions: MemorySessions = app.handler.episodes.sessions
        self._client = client

    def act(self, session_id: str, *, rows: int | None = None, policy: str = "leaky", **more: Any) -> tuple[int, Any]:
        obs = [0.1] * 27 if policy == "ur5" else OBS
        body = {"obs": obs if rows is None else [obs] * rows, "session_id": session_id, **more}
        reply = self._client.post(f"/v1/policies/{policy}/act", json=body)
        return reply.status_code, reply.json()

    def infer(self, sequence_id: int | str, **more: Any) -> tuple[int, Any]:
        tensor = {"name": "obs", "shape": [1, 3], "datatype": "FP32", "data": OBS}
        body = {"inputs": [tensor], "parameters": {"sequence_id": sequence_id, **more}}
        reply = self._client.post("/v2/models/leaky/infer", json=body)
        return reply.status_code, reply.json()

    def metrics(self) -> dict[tuple[str, ...], float]:
        text = self._client.get("/metrics").text
        return {
            (sample.name, *(value for key, value in sorted(sample.labels.items()) if key != "replica")): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
            if "session" in sample.name or "episodes" in sample.name
        }


@pytest.fixture(scope="module")
def store(ur5: Path, tmp_path_factory: pytest.TempPathFactory) -> PolicyStore:
    return load_store(write_leaky_policy(tmp_path_factory.mktemp("leaky")), ur5)


@contextlib.contextmanager
def serving(store: PolicyStore, *, idle_s: float) -> Iterator[Server]:
    app = create_app(control_of(store), ServerSettings(max_sessions=MOST, session_idle_s=idle_s), replica="r")
    with over_uvicorn(app) as port, httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
        yield Server(port, app, client)


@pytest.fixture
def server(store: PolicyStore) -> Iterator[Server]:
    with serving(store, idle_s=60) as server:
        yield server


def test_a_batch_takes_the_places_of_its_episodes(server: Server) -> None:
    assert server.act("wide", rows=6, reset=True)[0] == 200
    status, reply = server.act("too-wide", rows=3, reset=True)
    assert (status, reply["code"]) == (503, "unavailable")
    assert "remembers 6 of at most 8 episodes and has no room for 3 more" in reply["error"]
    assert server.act("too-wide", rows=2, reset=True)[0] == 200
    assert server.act("one", reset=True)[0] == 503
    assert server.act("one", reset=True, end=True)[0] == 200  # it is not kept
    assert server.act("wide", rows=6)[0] == 200  # and existing ones continue
    assert server.act("wide", rows=3, reset=True)[0] == 200
    assert server.sessions.rows == 5


def test_a_stream_takes_places_too_and_gives_them_back(server: Server) -> None:
    with Stream(server.port, STREAM) as stream:
        assert stream.ask(obs=np.float32([OBS] * 8))["session_step"] == 1
        assert server.act("s", reset=True)[0] == 503
        assert "has no room for another episode" in stream.ask(obs=np.float32([OBS] * 9), reset=True)["error"]
        reply = stream.ask(obs=np.float32([OBS] * 8))
        assert reply["session_step"] == 2  # what was refused has not ended the episode
    wait_for(lambda: server.act("s", reset=True)[0] == 200)
    assert server.sessions.rows == 1


@pytest.mark.parametrize(("refused", "status"), [({"rows": 9}, 503), ({"obs": [0.0]}, 422), ({"deadline_ms": 0}, 408)])
def test_a_reset_that_is_refused_leaves_the_episode_as_it_was(
    server: Server, store: PolicyStore, refused: dict[str, Any], status: int
) -> None:
    here = store.get("leaky").clone()
    expected = [here.act(OBS).tolist() for _ in range(2)]
    assert server.act("s", reset=True)[1]["action"] == pytest.approx(expected[0])
    assert server.act("s", reset=True, **refused)[0] == status
    _, reply = server.act("s")
    assert (reply["action"], reply["session_step"]) == (pytest.approx(expected[1]), 2)


def test_a_stream_whose_reset_is_refused_goes_on(server: Server, store: PolicyStore) -> None:
    here = store.get("leaky").clone()
    expected = [here.act(OBS).tolist() for _ in range(2)]
    with Stream(server.port, STREAM) as stream:
        first = stream.ask(obs=np.float32(OBS))
        assert stream.ask(obs=[1.0], reset=True)["code"] == "bad-observation"
        np.testing.assert_allclose([first["actions"][0], stream.ask(obs=np.float32(OBS))["actions"][0]], expected)


def test_the_id_of_a_policy_that_remembers_nothing_is_a_label(server: Server) -> None:
    for number in range(3 * MOST):
        status, reply = server.act(f"label-{number}", policy="ur5", reset=True)
        assert status == 200 and "session_step" not in reply
    assert not server.sessions.count()
    with PolicyClient(f"http://127.0.0.1:{server.port}", "ur5", server_state=True) as client:
        for _ in range(2):
            client.act(np.zeros(27))


def test_idle_sessions_are_forgotten_without_anybody_asking(store: PolicyStore) -> None:
    with serving(store, idle_s=0.3) as server:
        assert server.act("s", reset=True)[0] == 200
        time.sleep(0.4)
        now = server.metrics()
    assert (now["rlservo_sessions", "leaky"], now["rlservo_sessions_evicted_total", "leaky"]) == (0, 1)
    assert now["rlservo_episodes_remembered",] == 0


def test_a_number_that_is_used_again_for_another_observation_is_refused(server: Server) -> None:
    first = server.act("s", reset=True, seq=1)[1]
    assert server.act("s", seq=1) == (200, first)
    status, reply = server.act("s", seq=1, obs=[0.5, -0.25, 1.5])
    assert (status, reply["code"]) == (409, "session-conflict") and "for another observation" in reply["error"]
    assert server.act("s", seq=2, obs=[0.5, -0.25, 1.5])[1]["session_step"] == 2


def test_a_number_and_a_string_that_looks_like_it_are_two_sessions(server: Server) -> None:
    assert server.infer(7, sequence_start=True)[1]["parameters"] | {"infer_ms": 0} == {
        "infer_ms": 0,
        "sequence_id": 7,
        "session_step": 1,
    }
    for other in ("7", "#7"):
        assert server.infer(other)[0] == 410
        assert server.act(other)[0] == 410
    assert server.act("#7", reset=True)[1]["session_step"] == 1
    assert server.act("7", reset=True)[1]["session_step"] == 1
    assert server.infer(7)[1]["parameters"]["session_step"] == 2
    assert server.infer("7")[1]["parameters"]["session_step"] == 2  # a string is a session's id over either protocol


def test_sessions_are_on_metrics(server: Server) -> None:
    kinds = ("", "_begun_total", "_evicted_total", "_lost_total")
    none = {(f"rlservo_sessions{kind}", "leaky"): 0 for kind in kinds}
    assert server.metrics() == {("rlservo_episodes_remembered",): 0, **none}  # what is first seen at 1 never increases
    server.act("a", reset=True)
    server.act("b", rows=3, reset=True)
    server.act("a", end=True)
    assert server.act("a")[0] == 410
    now = server.metrics()
    assert now["rlservo_sessions", "leaky"] == 1 and now["rlservo_episodes_remembered",] == 3
    assert now["rlservo_sessions_begun_total", "leaky"] == 2 and now["rlservo_sessions_lost_total", "leaky"] == 1


def test_a_policy_alone_keeps_its_identity_wherever_it_is_loaded(tmp_path: Path) -> None:
    one, same, other = (
        Policy.load(write_leaky_policy(tmp_path / str(number), seed=seed)) for number, seed in enumerate((1, 1, 2))
    )
    assert one.identity == same.identity == one.clone().identity != other.identity
    assert one.identity.startswith("leaky/1#")
