"""Rollouts and clients record: over HTTP and over a WebSocket, with rewards and ends, late answers and fallbacks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry

from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.drive.control_loop import rollout
from rlservo.drive.fallback import WithFallback
from rlservo.errors import UnavailableError, UsageError
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder
from rlservo.recording.replay.replay import replay
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import over_uvicorn
from stores import control_of, load_store


class Countdown(gym.Env[Any, Any]):
    """Ten steps of the ur5 bundle's shape, in one buffer that is overwritten each step."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (27,), np.float32)
    high = np.array([1, 1, 1, 2, 1, 1], np.float32)
    action_space = gym.spaces.Box(-high, high)

    def __init__(self) -> None:
        self.buffer = np.zeros(27, np.float32)

    def observe(self) -> Any:
        self.buffer[:] = self.np_random.standard_normal(27)
        return self.buffer

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        ends = self.steps == 10
        return self.observe(), float(self.steps), ends, False, {"final_status": "success"} if ends else {}


@pytest.fixture(scope="module", autouse=True)
def environment() -> Iterator[None]:
    register("Recorded-v0", lambda: Countdown())
    yield
    del registry["Recorded-v0"]


@pytest.fixture(scope="module")
def url(policies: Path) -> Iterator[str]:
    store = load_store(policies)
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port:
        yield f"http://127.0.0.1:{port}"
    store.close()


def all_of(path: Path) -> list[RecordedEpisode]:
    return list(episodes(Recording(path)))


def check_rollout(found: list[RecordedEpisode]) -> None:
    assert [len(episode) for episode in found] == [10, 10, 10]
    for episode in found:
        assert episode.begins and episode.gap is None and episode.terminated
        assert episode.final_status == "success"
        assert episode.reward.tolist() == list(range(1, 11))
        assert episode.final_obs is not None
        assert len(np.unique(episode.obs["obs"][:, 0])) == 10  # not ten views of one buffer


@pytest.mark.parametrize("explore", [False, True])
def test_rollout_records_in_process(ur5: Path, tmp_path: Path, explore: bool) -> None:
    with Policy.load(ur5) as policy:
        rollout(policy, "Recorded-v0", episodes=3, seed=1, explore=explore, record=tmp_path / "run.mcap")
    check_rollout(all_of(tmp_path / "run.mcap"))
    report = replay(Recording(tmp_path / "run.mcap"), ur5)
    assert (report.identical, report.same_graph) == (30, True)


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_rollout_records_a_servers_policy(
    url: str, ur5: Path, tmp_path: Path, kind: type[PolicyClient | StreamClient]
) -> None:
    with kind(url, "ur5") as policy:
        rollout(policy, "Recorded-v0", episodes=3, seed=1, record=tmp_path / "run.mcap")
    found = all_of(tmp_path / "run.mcap")
    check_rollout(found)
    assert all(isinstance(seq, int) for seq in found[0].field("seq"))
    report = replay(Recording(tmp_path / "run.mcap"), ur5)
    assert (report.compared, report.identical, report.same_graph) == (30, 30, None)


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_client_records_itself(url: str, tmp_path: Path, kind: type[PolicyClient | StreamClient]) -> None:
    env = Countdown()
    with kind(url, "ur5", record=tmp_path / "run.mcap") as policy:
        for seed in range(3):
            policy.reset()
            obs, _ = env.reset(seed=seed)
            ends = False
            while not ends:
                obs, reward, ends, _, facts = env.step(policy.act(obs))
                status = facts.get("final_status")
                policy.outcome(reward, terminated=ends, final_status=status, final_obs=obs if ends else None)
    check_rollout(all_of(tmp_path / "run.mcap"))


def test_client_that_records_nothing_takes_outcomes(url: str) -> None:
    with PolicyClient(url, "ur5") as policy:
        policy.outcome(1.0)


class Failing:
    """A policy whose every third answer is missing."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._calls = 0
        self.contract = policy.contract
        self.commands: list[Any] = []

    def act(self, obs: Any, **more: Any) -> Any:
        self._calls += 1
        if self._calls % 3 == 0:
            raise UnavailableError("away")
        return self._policy.act(obs)

    def set_last_action(self, action: Any) -> None:
        self.commands.append(action)

    def reset(self) -> None: ...

    def close(self) -> None: ...


def test_fallbacks_are_recorded_as_what_the_robot_did(ur5: Path, tmp_path: Path) -> None:
    failing: Any = Failing(Policy.load(ur5))
    policy = WithFallback(failing, "hold")
    rollout(policy, "Recorded-v0", episodes=1, seed=1, record=tmp_path / "run.mcap")
    (episode,) = all_of(tmp_path / "run.mcap")
    missing = [2, 5, 8]
    assert np.flatnonzero(episode.fell_back).tolist() == missing
    assert [row for row, code in enumerate(episode.errors) if code == "unavailable"] == missing
    executed = episode.executed["action"]
    for row in missing:
        assert not episode.acted[row] and (executed[row] == executed[row - 1]).all()
    assert len(failing.commands) == 3  # a client still gets to know
    report = replay(Recording(tmp_path / "run.mcap"), ur5)
    assert (report.compared, report.identical, report.not_compared) == (7, 7, 3)


@pytest.mark.parametrize("recording_outside", [True, False])
def test_report_counts_fallbacks_whatever_wraps_what(ur5: Path, tmp_path: Path, recording_outside: bool) -> None:
    failing: Any = Failing(Policy.load(ur5))
    file = tmp_path / "run.mcap"
    policy = (
        WithRecording(WithFallback(failing, "hold"), file)
        if recording_outside
        else WithFallback(WithRecording(failing, file), "hold")
    )
    with policy:
        report = rollout(policy, "Recorded-v0", episodes=1, seed=1)
    assert report.link is not None and (report.link.fallback, report.link.fallback_steps) == ("hold", 3)


def test_commands_reach_the_policy_through_a_recording(ur5: Path, tmp_path: Path) -> None:
    failing: Any = Failing(Policy.load(ur5))
    with WithFallback(WithRecording(failing, tmp_path / "run.mcap"), "zero") as policy:
        for _ in range(3):
            policy.act(np.zeros(27, np.float32))
    assert len(failing.commands) == 1 and (failing.commands[0] == 0).all()
    (episode,) = all_of(tmp_path / "run.mcap")
    assert episode.fell_back.tolist() == [False, False, True]
    assert (episode.executed["action"][2] == 0).all()


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
@pytest.mark.parametrize("wraps", [False, True], ids=["records itself", "is wrapped"])
def test_server_gets_the_commanded_action_of_a_recorded_client(
    policies: Path,
    tmp_path: Path,
    kind: type[PolicyClient | StreamClient],
    wraps: bool,
) -> None:
    """The server limits the step from the last action: what comes next is at most that far from the commanded one."""
    store = load_store(policies, options={"ur5": PolicyOptions(max_action_step=0.01)})
    commanded = np.full(6, 0.9, np.float32)
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port:
        url = f"http://127.0.0.1:{port}"
        record = tmp_path / "run.mcap"
        with WithRecording(kind(url, "ur5"), record) if wraps else kind(url, "ur5", record=record) as policy:
            policy.reset()
            first = policy.act(np.zeros(27, np.float32))
            assert (np.abs(first - commanded) > 0.02).all()
            policy.set_last_action(commanded)
            following = policy.act(np.zeros(27, np.float32))
    store.close()
    assert (np.abs(following - commanded) <= 0.011).all()
    (episode,) = all_of(record)
    assert (episode.executed["action"][0] == commanded).all()


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_client_that_cannot_be_made_leaves_no_file(tmp_path: Path, kind: type[PolicyClient | StreamClient]) -> None:
    with pytest.raises(UsageError, match="ftp"):
        kind("ftp://127.0.0.1", "ur5", record=tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_clients_share_a_recorder(url: str, tmp_path: Path) -> None:
    obs = np.zeros(27, np.float32)
    with Recorder(tmp_path / "folder") as recorder:
        for _ in range(2):
            with PolicyClient(url, "ur5", record=recorder) as policy:
                policy.act(obs)
        with StreamClient(url, "ur5", record=recorder) as stream:
            stream.act(obs)
    assert [len(episode) for episode in all_of(tmp_path / "folder")] == [1, 1, 1]
