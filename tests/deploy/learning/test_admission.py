"""Admission of recorded episodes to learning: one that is used, and every reason for which others are not."""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.deploy.learning.episode_filter import Admitted, EpisodeFilter, KnownVersion, named_reward, reward_of
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.episodes import EpisodeAssembler, RecordedEpisode, episodes
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording

OBS = np.linspace(-0.1, 0.1, 27, dtype=np.float32)
OLD = KnownVersion("7", "0" * 64, "0" * 64)


def recorded(bundle: Path, file: Path, play: Callable[[WithRecording], None] | None = None) -> RecordedEpisode:
    with WithRecording(Policy.load(bundle), file) as policy:
        if play is not None:
            play(policy)
        else:
            for step in range(4):
                policy.act(OBS, explore=True, seed=step)
                policy.outcome(0.5, terminated=step == 3, final_obs=OBS if step == 3 else None)
    (episode,) = episodes(Recording(file))
    return episode


def known(episode: RecordedEpisode) -> KnownVersion:
    policy = episode.policy
    return KnownVersion(policy.contract.version, policy.graph_hash, policy.contract_hash)


def test_a_whole_explored_episode_of_a_known_version_is_admitted(ur5: Path, tmp_path: Path) -> None:
    episode = recorded(ur5, tmp_path / "run.mcap")
    admission = EpisodeFilter("ur5", max_age=1)
    (admitted,) = admission.judge(episode, [known(episode), OLD])
    assert isinstance(admitted, Admitted)
    assert admitted.age == 1 and admitted.version == known(episode) and admitted.rewards.tolist() == [0.5] * 4
    assert admission.judge(episode, [known(episode), OLD, OLD]) == ["of a version that is too old"]
    assert admission.judge(episode, [OLD]) == ["of a version that this run did not make"]
    foreign = KnownVersion(known(episode).version, "0" * 64, known(episode).contract_sha256)
    assert admission.judge(episode, [foreign]) == ["whose graph or contract is not the version's"]
    assert EpisodeFilter("another", max_age=1).judge(episode, [known(episode)]) == []


def acted(explore: list[bool], rewards: list[float], *, final: bool = True) -> Callable[[WithRecording], None]:
    def play(policy: WithRecording) -> None:
        for step, (explores, reward) in enumerate(zip(explore, rewards, strict=True)):
            policy.act(OBS, explore=explores)
            last = step == len(explore) - 1
            policy.outcome(reward, truncated=last, final_obs=OBS if last and final else None)

    return play


def fell_back(policy: WithRecording) -> None:
    policy.act(OBS, explore=True)
    policy.set_last_action(np.zeros(6, np.float32))
    policy.outcome(1.0, terminated=True)


@pytest.mark.parametrize(
    ("play", "reason"),
    [
        (acted([True, False, True], [1.0] * 3), "in which not every action explored"),
        (acted([True, True], [1.0, float("nan")]), "without every reward"),
        (acted([True, True], [1.0, float("inf")]), "without every reward"),
        (acted([True, True], [1.0, 1e39]), "without every reward"),
        (acted([True], [1.0], final=False), "cut off, without the observation after the last action"),
        (fell_back, "in which a fallback acted"),
    ],
)
def test_what_a_robot_did_otherwise_is_dropped(
    ur5: Path, tmp_path: Path, play: Callable[[WithRecording], None], reason: str
) -> None:
    episode = recorded(ur5, tmp_path / "run.mcap", play)
    assert EpisodeFilter("ur5", max_age=1).judge(episode, [known(episode)]) == [reason]


def change_logp(decision: dict[str, Any]) -> None:
    decision["logp"] += 0.01


def change_action(decision: dict[str, Any]) -> None:
    decision["action"] = dict.fromkeys(decision["action"], 0.25)


def leave_the_bounds(decision: dict[str, Any]) -> None:
    decision["action"] = dict.fromkeys(decision["action"], 3.0)


def spoil_the_observation(decision: dict[str, Any]) -> None:
    decision["obs"] = dict.fromkeys(decision["obs"])


def drop(decision: dict[str, Any]) -> None:
    decision["step"] += 1


@pytest.mark.parametrize(
    ("forge", "reason"),
    [
        (change_logp, "whose log-probabilities do not match their distributions"),
        (change_action, "whose actions are not the policy's draws"),
        (leave_the_bounds, "with an action outside the contract's bounds"),
        (spoil_the_observation, "with an observation that is not finite"),
        (drop, "without their beginning or with a gap"),
    ],
)
def test_a_forged_decision_is_dropped_with_its_episode(
    ur5: Path, tmp_path: Path, forge: Callable[[dict[str, Any]], None], reason: str
) -> None:
    recorded(ur5, tmp_path / "run.mcap")
    entries = list(Recording(tmp_path / "run.mcap").entries())
    forge([entry.fields for entry in entries if entry.kind == "decision"][3])
    assembler = EpisodeAssembler()
    (episode,) = (episode for entry in entries for episode in assembler.add(entry))
    assert EpisodeFilter("ur5", max_age=0).judge(episode, [known(episode)]) == [reason]


def test_a_reward_function_stands_in_for_what_clients_say(ur5: Path, tmp_path: Path) -> None:
    episode = recorded(ur5, tmp_path / "run.mcap", acted([True, True], [float("nan")] * 2))
    reward = reward_of("def reward(obs, action, next_obs):\n    return float(next_obs[0] - obs[1])\n", "r.py")
    (admitted,) = EpisodeFilter("ur5", max_age=0, reward=reward).judge(episode, [known(episode)])
    assert isinstance(admitted, Admitted)
    assert admitted.rewards == pytest.approx([OBS[0] - OBS[1]] * 2)
    fails = reward_of("def reward(obs, action, next_obs):\n    return obs['x']\n", "r.py")
    with pytest.raises(UsageError, match="the reward function failed"):
        EpisodeFilter("ur5", max_age=0, reward=fails).judge(episode, [known(episode)])
    for source in ("x = 1", "def reward(:"):
        with pytest.raises(UsageError, match=r"--reward r\.py"):
            reward_of(source, "r.py")


def silent(policy: WithRecording) -> None:
    """A client that says nothing of what came of its actions."""
    for step in range(6):
        policy.act(np.full(27, step / 10, np.float32), explore=True)


def test_a_reward_function_may_say_where_episodes_end(ur5: Path, tmp_path: Path) -> None:
    episode = recorded(ur5, tmp_path / "run.mcap", silent)
    source = "def reward(obs, action, next_obs):\n    return float(next_obs[0]), bool(next_obs[0] > 0.25)\n"
    admission = EpisodeFilter("ur5", max_age=0, reward=reward_of(source, "r.py"))
    parts = [one for one in admission.judge(episode, [known(episode)]) if isinstance(one, Admitted)]
    assert [(len(part.episode), part.episode.terminated) for part in parts] == [(3, True), (1, True), (1, True)]
    assert [part.rewards.tolist() for part in parts] == [
        pytest.approx([0.1, 0.2, 0.3]), pytest.approx([0.4]), pytest.approx([0.5]),
    ]  # fmt: skip
    assert EpisodeFilter("ur5", max_age=0).judge(episode, [known(episode)]) == ["without an end"]
    # Without an end anywhere the last decision is only the observation after the one before.
    never = EpisodeFilter("ur5", max_age=0, reward=reward_of("def reward(o, a, n):\n    return 1.0\n", "r.py"))
    (whole,) = never.judge(episode, [known(episode)])
    assert isinstance(whole, Admitted) and whole.episode.truncated and whole.rewards.tolist() == [1.0] * 5
    assert whole.episode.final_obs is not None and whole.episode.final_obs["obs"][0, 0] == pytest.approx(0.5)


REWARDS = """from subprocess import run
from math import hypot
height = 1.0
class Reward:
    pass
def reach(obs, action, next_obs):
    return float(next_obs[0])
"""


@pytest.fixture
def cell_rewards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    name = f"rewards_{secrets.token_hex(4)}"
    (tmp_path / f"{name}.py").write_text(REWARDS)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize("function", ["no_such_function", "height", "run", "hypot", "Reward", "__loader__"])
def test_only_a_modules_own_function_is_a_reward(cell_rewards: str, function: str) -> None:
    assert named_reward(f"{cell_rewards}:reach", [cell_rewards])(None, None, [2.0]) == 2.0
    sentence = f"the contract's reward function {cell_rewards}:{function}: expected a function {function}"
    with pytest.raises(UsageError, match=re.escape(sentence)):
        named_reward(f"{cell_rewards}:{function}", [cell_rewards])


def test_a_module_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(UsageError, match="the contract's reward function no_such_module:reward cannot be loaded"):
        named_reward("no_such_module:reward", ["no_such_module"])


@pytest.mark.parametrize("modules", [[], ["my_rewards"], ["signals"]])
def test_a_contract_has_no_module_imported_that_the_command_does_not_name(
    cell_rewards: str, modules: list[str]
) -> None:
    for name in (f"{cell_rewards}:reach", "ctypes:memset", "signal:setitimer", "pty:spawn"):
        with pytest.raises(UsageError, match=f"function {name}.*if you trust it, add --reward-from"):
            named_reward(name, modules)
    assert cell_rewards not in sys.modules
