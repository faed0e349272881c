"""A server's recordings, over every protocol: actions replay bit for bit, episodes begin and end where they did."""

from __future__ import annotations

import contextlib
import http.client
import json
import stat
import threading
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.bundle.spaces import DiscreteSpec
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import UsageError
from rlservo.policy.options import PolicyOptions
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.replay.replay import replay
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server import request_recorder
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.request_recorder import RequestRecorder
from rlservo.serve_app.server.settings import ServerSettings
from servers import exchange, over_uvicorn
from stores import control_of, load_store


@dataclass
class Server:
    port: int
    folder: Path
    recorder: RequestRecorder
    handler: RequestHandler

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def post(self, path: str, body: Any, **headers: str) -> tuple[int, Any]:
        reply = exchange(self.port, "POST", path, body, **headers)
        return reply.status, reply.document

    def act(self, policy: str, body: Any, **headers: str) -> tuple[int, Any]:
        return self.post(f"/v1/policies/{policy}/act", body, **headers)

    def recorded(self) -> list[RecordedEpisode]:
        """End the recording and return its episodes."""
        self.recorder.close()
        return list(episodes(Recording(self.folder)))

    def metrics(self) -> dict[str, float]:
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=10) as reply:
            lines = [line.rpartition(" ") for line in reply.read().decode().splitlines() if line[0] != "#"]
        return {name.partition("{")[0]: float(value) for name, _, value in lines if name.startswith("rlservo_record")}


@pytest.fixture
def start(recurrent: Path, ur5: Path, tmp_path: Path) -> Iterator[Callable[..., Server]]:
    """A function that serves three recurrent policies and ur5, recording."""
    with contextlib.ExitStack() as stack:

        def serve(options: dict[str, PolicyOptions] | None = None, **settings: Any) -> Server:
            store = load_store(recurrent, ur5, options=options)
            app = create_app(control_of(store), ServerSettings(record=str(tmp_path / "recorded"), **settings))
            server = Server(
                stack.enter_context(over_uvicorn(app)), tmp_path / "recorded", app.handler.recorder, app.handler
            )
            stack.callback(server.recorder.close)
            return server

        yield serve


def arms(count: int, seed: int = 0) -> list[list[float]]:
    return np.random.default_rng(seed).standard_normal((count, 3)).astype(np.float32).tolist()


def observations(policy: Any, count: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(policy.contract.observation_space.size).astype(np.float32) for _ in range(count)]


def test_mixed_traffic_replays_bit_for_bit(start: Callable[..., Server], recurrent: Path, ur5: Path) -> None:
    server = start()

    def carry() -> None:  # the client carries the state
        with PolicyClient(server.url, "lstm_box") as policy:
            for _ in range(2):
                policy.reset()
                for obs in observations(policy, 6, 1):
                    policy.act(obs)

    def keep() -> None:  # the server keeps it, in a session
        with PolicyClient(server.url, "lstm_box", server_state=True) as policy:
            for _ in range(2):
                policy.reset()
                for obs in observations(policy, 5, 2):
                    policy.act(obs, explore=True)

    def stream() -> None:
        with StreamClient(server.url, "lstm_box", server_state=True) as policy:
            for _ in range(3):
                policy.reset()
                for obs in observations(policy, 4, 3):
                    policy.act(obs)

    def stateless() -> None:
        with StreamClient(server.url, "ur5") as policy:
            for _ in range(2):
                policy.reset()
                for obs in observations(policy, 7, 4):
                    policy.act(obs)
        with PolicyClient(server.url, "ur5") as client:
            client.act(np.stack(observations(client, 3, 5)))

    def oip() -> None:
        size = 27
        for step in range(3):
            body = {
                "inputs": [{"name": "obs", "shape": [1, size], "datatype": "FP32", "data": [0.1 * step] * size}],
                "parameters": {"sequence_id": 7, "sequence_start": step == 0, "sequence_end": step == 2},
            }
            assert server.post("/v2/models/ur5/infer", body)[0] == 200

    threads = [threading.Thread(target=task) for task in (carry, keep, stream, stateless, oip)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = server.recorded()
    whole = [(one.policy.contract.name, len(one), one.begins, one.gap) for one in found if one.id]
    assert sorted(whole, key=str) == sorted(
        [("lstm_box", 6, True, None)] * 2
        + [("lstm_box", 5, True, None)] * 2
        + [("lstm_box", 4, True, None)] * 3
        + [("ur5", 7, True, None)] * 2
        + [("ur5", 3, True, None)]
        + [("ur5", 1, True, None)] * 3,  # the rows of the batch
        key=str,
    )
    assert all(one.id for one in found)
    explored = [one for one in found if one.explored.any()]
    assert len(explored) == 2 and all(np.isfinite(one.logp).all() for one in explored)
    for bundle, compared in ((recurrent / "lstm_box" / "1", 34), (ur5, 20)):
        report = replay(Recording(server.folder), bundle)
        assert (report.compared, report.identical, report.changed) == (compared, compared, 0)
        assert report.same_graph is True
    metrics = server.metrics()
    assert metrics["rlservo_recording"] == 1 and metrics["rlservo_records_dropped_total"] == 0
    assert metrics["rlservo_records_written_total"] == 54


def test_the_client_tells_what_came_of_it(start: Callable[..., Server]) -> None:
    server, seen = start(), np.zeros(27).tolist()
    headers = {"x-session-id": "cell-7"}
    action = server.act("ur5", {"obs": seen}, **headers)[1]["action"]
    commanded = [0.1] * len(action)
    assert server.act("ur5", {"obs": seen, "reward": 0.5, "last_action": commanded}, **headers)[0] == 200
    last = {"obs": (np.ones(27) / 2).tolist(), "reward": 2, "final_status": "success"}
    assert server.act("ur5", last, **headers)[0] == 200
    server.act("ur5", {"obs": seen}, **headers)
    cut = {"obs": seen, "reward": -1, "final_status": "time", "truncated": True}
    assert server.act("ur5", cut, **headers)[0] == 200
    success, cut_off = server.recorded()
    assert (success.id, len(success), success.final_status, success.terminated) == ("cell-7", 2, "success", True)
    assert success.reward.tolist() == [0.5, 2.0]
    assert success.final_obs is not None and (success.final_obs["obs"] == 0.5).all()
    assert success.fell_back.tolist() == [True, False]
    assert np.allclose(success.executed["action"][0], 0.1)
    assert (len(cut_off), cut_off.truncated, cut_off.terminated) == (1, True, False)


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ({"final_status": ""}, "'final_status' must have at least 1 character"),
        ({"truncated": 1}, "'truncated' must be true or false"),
    ],
)
def test_bad_outcomes_are_refused(start: Callable[..., Server], field: dict[str, Any], sentence: str) -> None:
    server = start()
    status, reply = server.act("ur5", {"obs": [0] * 27, **field})
    assert status == 400 and reply["error"].startswith(sentence)


def test_a_request_sent_again_is_one_decision(start: Callable[..., Server]) -> None:
    server = start()
    first = {"obs": [0.5, 0.25, 0.125], "session_id": "a", "reset": True, "seq": 1}
    again = {"obs": [0.5, 0.25, 0.25], "session_id": "a", "seq": 2}
    replies = [server.act("lstm_box", body) for body in (first, again, again)]
    assert replies[1][1]["action"] == replies[2][1]["action"]
    (episode,) = server.recorded()
    assert episode.id == "a" and episode.field("seq") == [1, 2]


def test_what_got_no_action_stands_in_its_episode(start: Callable[..., Server]) -> None:
    server, headers = start(), {"x-session-id": "cell-7"}
    obs = [0.0] * 27
    assert server.act("ur5", {"obs": obs}, **headers)[0] == 200
    assert server.act("ur5", {"obs": obs, "deadline_ms": 0}, **headers)[0] == 408
    assert server.act("ur5", {"obs": obs[:3]}, **headers)[0] == 422  # none of the policy's observations
    assert server.act("ur5", {"obs": obs}, **headers)[0] == 200
    (episode,) = server.recorded()
    assert episode.acted.tolist() == [True, False, True] and episode.gap is None
    assert episode.errors[1] == "deadline-passed"


def test_an_observation_that_nothing_has_looked_at_may_be_anything(start: Callable[..., Server]) -> None:
    server = start()
    for obs in ([10**400] * 27, "x", {"a": {"b": 1}}, [[[0]]], [[0.0] * 27] * 1000):
        assert server.act("ur5", {"obs": obs, "deadline_ms": 0})[0] == 408, str(obs)[:40]
    assert server.act("ur5", {"obs": [0] * 27})[0] == 200
    (entry,) = server.recorded()
    assert entry.acted.all()


def test_an_episode_is_counted_anew_when_too_many_others_came_after_it(
    start: Callable[..., Server], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(request_recorder, "MOST_EPISODES", 2)
    server = start()
    for name in ("a", "b", "a", "c", "a", "b"):  # the one that was silent longest is b
        assert server.act("ur5", {"obs": [0.0] * 27}, **{"x-session-id": name})[0] == 200
    assert sorted((one.id, one.steps.tolist()) for one in server.recorded()) == [
        ("a", [0, 1, 2]), ("b", [0]), ("b", [0]), ("c", [0]),
    ]  # fmt: skip


def test_a_session_that_goes_on_begins_no_episode(start: Callable[..., Server], recurrent: Path) -> None:
    server = start()
    a, b = ({"obs": [0.5, 0.25, 0.125], "session_id": name} for name in "ab")
    begin: dict[str, Any] = {"reset": True}
    late: dict[str, Any] = {"deadline_ms": 0}
    end: dict[str, Any] = {"final_status": "success"}
    bodies = [a | begin, a, a | late, a | end | late, a | end, a, b | begin, b, a, b | {"end": True}]
    statuses = [server.act("lstm_box", body)[0] for body in bodies]
    assert statuses == [200, 200, 408, 408] + [200] * 6
    found = {(one.id, tuple(one.steps.tolist()), one.begins, one.final_status) for one in server.recorded()}
    assert found == {
        ("a", (0, 1, 2), True, "success"),
        ("a", (3, 4), False, None),  # with the memory of before
        ("b", (0, 1, 2), True, None),
    }
    report = replay(Recording(server.folder), recurrent / "lstm_box" / "1")
    assert (report.identical, report.changed) == (5, 0)


def test_limits_that_count_from_what_the_client_tells_replay(start: Callable[..., Server], ur5: Path) -> None:
    server = start({"ur5": PolicyOptions(max_action_step=0.05, out_of_bounds="clip")})
    rng = np.random.default_rng(0)
    ways: list[tuple[dict[str, Any], dict[str, str]]] = [({"session_id": "a"}, {}), ({}, {"x-session-id": "b"})]
    for said, headers in ways:
        for step in range(5):
            body = {"obs": (3 * rng.standard_normal(27)).tolist(), **said}
            if "session_id" in said and step == 0:
                body["reset"] = True
            if step in (0, 3) or "session_id" not in said:
                body["last_action"] = [0.1 * step + 0.1] * 6
            assert server.act("ur5", body, **headers)[0] == 200
    assert len(server.recorded()) == 2
    report = replay(Recording(server.folder), ur5)
    assert (report.compared, report.identical, report.changed) == (10, 10, 0)


def test_what_a_policy_sees_of_its_actions_is_what_it_gave(start: Callable[..., Server], recurrent: Path) -> None:
    server, rng = start(), np.random.default_rng(0)
    with PolicyClient(server.url, "lstm_previous") as client:
        space = client.contract.action_space
        size = client.contract.observation_space.size
    assert isinstance(space, DiscreteSpec)
    given = None
    for step in range(6):
        body = {"obs": rng.standard_normal(size).tolist(), "session_id": "a", "reset": step == 0, "reward": 0.5}
        body["explore"] = True  # so that the distributions are compared, and not their modes alone
        if step in (2, 4):
            body["last_action"] = space.start if given != space.start else space.start + 1
        status, reply = server.act("lstm_previous", body)
        assert status == 200
        given = reply["action"]
    (episode,) = server.recorded()
    assert episode.fell_back.sum() == 2
    report = replay(Recording(server.folder), recurrent / "lstm_previous" / "1")
    assert (report.compared, report.identical, report.changed) == (6, 6, 0)


def test_records_keep_no_large_request_alive(start: Callable[..., Server], monkeypatch: pytest.MonkeyPatch) -> None:
    server, kept = start(), []
    monkeypatch.setattr(server.recorder.recorder, "record", kept.append)
    header = json.dumps(
        {
            "inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "parameters": {"binary_data_size": 108}}],
            "parameters": {"sequence_id": "b" * 120},
        }
    )
    header += " " * (100_000 - len(header))
    long = "l" * 5000
    headers = {"inference-header-content-length": "100000", "x-request-id": long}
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)) as connection:
        connection.request("POST", "/v2/models/ur5/infer", header.encode() + bytes(108), headers)
        assert connection.getresponse().status == 200
    server.act("ur5", {"obs": [0] * 27}, **{"x-session-id": long, "x-request-id": long})
    state = server.act("lstm_box", {"obs": [0, 0, 0], "state": {}}, **{"x-session-id": long})[1]["state"]
    server.act("lstm_box", {"obs": [0, 0, 0], "state": state}, **{"x-session-id": long})
    server.recorder.close()
    assert len(kept) == 4
    for record in kept:
        assert all(array.base is None for array in record.obs.values())
        assert len(record.request_id or "") <= 128 and len(record.episode) <= 140
    assert kept[2].episode == kept[3].episode and (kept[2].step, kept[3].step) == (0, 1)


def test_a_fault_of_the_recorder_costs_no_request_and_one_line(
    start: Callable[..., Server], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    server = start()
    recorder = server.recorder.recorder
    write = recorder.record

    def fail(record: Any) -> None:
        if record.seq == 1:
            raise KeyError("a fault")
        write(record)

    monkeypatch.setattr(recorder, "record", fail)
    for seq in (1, 1, 1, 2):
        assert server.act("ur5", {"obs": [0] * 27, "seq": seq})[0] == 200
    (episode,) = server.recorded()
    assert len(episode) == 1 and server.metrics()["rlservo_records_dropped_total"] == 3
    (line,) = [record for record in caplog.records if record.levelname == "ERROR"]
    assert line.name == request_recorder.__name__ and "was not recorded" in line.message


def test_policies_whose_options_say_so_are_left_out(start: Callable[..., Server]) -> None:
    server = start({"ur5": PolicyOptions(record=False)})
    assert server.act("ur5", {"obs": [0] * 27})[0] == 200
    assert server.act("lstm_box", {"obs": [0, 0, 0], "state": {}})[0] == 200
    assert [one.policy.contract.name for one in server.recorded()] == ["lstm_box"]


def test_a_mark_that_a_client_made_up_is_taken_as_none(start: Callable[..., Server]) -> None:
    server = start()
    state = server.act("lstm_box", {"obs": [0, 0, 0], "state": {}})[1]["state"]
    identity = state["@policy"].partition("~")[0]
    for mark in ("~", "~a", "~a~-1", "~a~1e3", f"~{'a' * 300}~1", "~a~" + "9" * 20):
        status, _ = server.act("lstm_box", {"obs": [0, 0, 0], "state": {**state, "@policy": identity + mark}})
        assert status == 200, mark
    found = server.recorded()
    assert len(found) == 7 and [one.begins for one in found] == [True] + [False] * 6


def test_nothing_of_headers_is_in_the_file_and_only_the_owner_reads_it(start: Callable[..., Server]) -> None:
    server = start()
    server.act("ur5", {"obs": [0] * 27}, authorization="Bearer secret-7", cookie="secret-8")
    server.recorded()
    (file,) = server.folder.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600 and stat.S_IMODE(server.folder.stat().st_mode) == 0o700
    (entry,) = Recording(server.folder).entries()
    assert "secret" not in json.dumps(entry.fields)


def test_a_reward_that_is_no_number_is_not_recorded(start: Callable[..., Server]) -> None:
    server, headers = start(), {"x-session-id": "cell-7"}
    for reward in (None, "much", {"a": 1}, "nan", 1.0):
        assert server.act("ur5", {"obs": [0] * 27, "reward": reward}, **headers)[0] == 200
    (episode,) = server.recorded()
    assert len(episode) == 5 and np.isfinite(episode.reward).tolist() == [False, False, False, True, False]
    assert server.metrics()["rlservo_records_dropped_total"] == 0


def test_a_folder_that_cannot_be_written_to_is_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(UsageError, match="file exists: expected a new file, or a folder"):
        create_app(control_of(None), ServerSettings(record=str(file)))


@pytest.mark.parametrize(
    "begins", [{"session_id": "a", "reset": True}, {"state": {}}], ids=["a session", "a carried state"]
)
def test_a_request_that_begins_an_episode_cannot_tell_how_one_ended(
    start: Callable[..., Server], begins: dict[str, Any]
) -> None:
    server = start()
    body = {"obs": [0.5, 0.25, 0.125], **begins}
    status, reply = server.act("lstm_box", body | {"final_status": "success"})
    assert status == 400 and reply["error"].startswith("'final_status' ends an episode, and this request begins one")
    assert server.act("lstm_box", body)[0] == 200


def test_a_carried_state_that_is_sent_again_is_one_decision(start: Callable[..., Server], recurrent: Path) -> None:
    server, state, obs = start(), {}, [0.5, 0.25, 0.125]
    for step in range(4):
        before = state
        state = server.act("lstm_box", {"obs": obs, "state": before, "seq": step})[1]["state"]
    state = server.act("lstm_box", {"obs": obs, "state": before, "seq": 4, "reward": 0.5})[1]["state"]
    last = {"obs": obs, "state": state, "reward": 1, "final_status": "success"}
    assert server.act("lstm_box", last)[0] == 200
    (episode,) = server.recorded()
    assert (episode.field("seq"), episode.gap, episode.final_status) == ([0, 1, 2, 4], None, "success")
    assert np.isfinite(episode.reward).tolist() == [False, False, True, True]
    report = replay(Recording(server.folder), recurrent / "lstm_box" / "1")
    assert (report.identical, report.changed) == (4, 0)


def test_a_number_and_its_digits_are_two_sessions(start: Callable[..., Server]) -> None:
    server = start()
    for session_id in (7, "7"):
        for step in range(2):
            body = {
                "inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": [0] * 27}],
                "parameters": {"sequence_id": session_id, "sequence_start": step == 0},
            }
            assert server.post("/v2/models/ur5/infer", body)[0] == 200
    assert sorted((one.id, len(one), one.begins) for one in server.recorded()) == [("#7", 2, True), ("7", 2, True)]


def test_what_a_client_by_label_asks_from_reset_to_reset_is_an_episode(start: Callable[..., Server]) -> None:
    server = start()
    with PolicyClient(server.url, "ur5", label="cell-7") as policy:
        for _ in range(2):
            policy.reset()
            for obs in observations(policy, 3):
                policy.act(obs)
    found = server.recorded()
    assert [(one.id.partition(".")[0], len(one), one.begins) for one in found] == [("cell-7", 3, True)] * 2
    for label in ("", "a\r\nb", "é", "x" * 101):
        with pytest.raises(UsageError, match="label must be"):
            PolicyClient(server.url, "ur5", label=label)


def test_limits_that_count_from_an_altered_state_replay(start: Callable[..., Server], ur5: Path) -> None:
    server, rng = start({"ur5": PolicyOptions(max_action_step=0.05, out_of_bounds="clip")}), np.random.default_rng(0)
    state: dict[str, Any] = {}
    for step in range(5):
        status, reply = server.act("ur5", {"obs": (3 * rng.standard_normal(27)).tolist(), "state": state})
        assert status == 200
        state = reply["state"]
        if step == 2:
            state = {**state, "@last_action": [0.1] * 6}
    (episode,) = server.recorded()
    assert len(episode) == 5
    report = replay(Recording(server.folder), ur5)
    assert (report.compared, report.identical, report.changed) == (5, 5, 0)


def test_a_key_in_the_place_of_a_name_is_refused_and_in_no_recording(
    start: Callable[..., Server], caplog: pytest.LogCaptureFixture
) -> None:
    server, (key, _) = start(log_requests=True), new_key("robot")
    caplog.set_level("INFO", "rlservo")
    obs = {"obs": arms(1)[0]}
    for body in ({"session_id": key, "reset": True}, {"session_id": f"cell {key}", "reset": True}):
        status, reply = server.act("lstm_box", {**obs, **body})
        assert status == 400 and "'session_id' holds an API key" in reply["error"] and key not in reply["error"]
    body = {"inputs": [{"name": "obs", "shape": [1, 3], "datatype": "FP32", "data": obs["obs"]}]}
    status, reply = server.post(
        "/v2/models/lstm_box/infer", {**body, "parameters": {"sequence_id": key, "sequence_start": True}}
    )
    assert status == 400 and "API key" in reply["error"]
    arm = {"obs": [0.0] * 27}
    assert server.act("ur5", arm, **{"x-session-id": key})[0] == 400
    assert server.act("ur5", {**arm, "session_id": "cell", "final_status": key})[0] == 400
    assert server.act("ur5", arm, **{"x-request-id": key})[0] == 200
    assert server.act("lstm_box", {**obs, "session_id": "cell-7", "reset": True})[0] == 200
    assert [episode.id for episode in server.recorded()] == ["", "cell-7"]
    assert server.recorder.recorder.dropped == 0
    assert all(key.encode() not in file.read_bytes() for file in server.folder.iterdir())
    assert caplog.records and all(key not in str(record.__dict__) for record in caplog.records)
