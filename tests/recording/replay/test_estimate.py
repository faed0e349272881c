"""Estimates cover the truth if they claim to, and report if they cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bundles import write_box_policy
from command_line import rlservo_here
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy
from rlservo.recording.reader import Recording
from rlservo.recording.recorded_policy import WithRecording
from rlservo.recording.recorder import Recorder
from rlservo.recording.replay.estimate import Trajectory, estimate, importance_sampling

Rng = np.random.Generator
STEPS = 5


def walk(
    policy: Policy, episodes: int, rng: Rng, record: WithRecording | None = None, *, explore: bool = True
) -> float:
    """A walk over five cells of three actions, which earn by cell; return the mean return."""
    acting = record or policy
    rewards = np.random.default_rng(7).uniform(0, 1, (5, 3))
    total = 0.0
    for _ in range(episodes):
        acting.reset()
        cell = int(rng.integers(5))
        for step in range(STEPS):
            action = int(acting.act(cell, explore=explore, seed=int(rng.integers(2**31))))
            reward = float(rewards[cell, action])
            total += reward
            cell = (cell + action) % 5
            if record is not None:
                record.outcome(reward, terminated=step == STEPS - 1, final_obs=cell)
    return total / episodes


@pytest.fixture(scope="module")
def walked(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    policy, file = Policy.load(policies / "gridworld"), tmp_path_factory.mktemp("walked") / "run.mcap"
    with WithRecording(policy, file, wait=True) as record:
        walk(policy, 600, np.random.default_rng(0), record)
    return file


def test_the_recorded_policy_gets_its_own_return(policies: Path, walked: Path) -> None:
    report = estimate(Recording(walked), policies / "gridworld", explore=True)
    assert report.episodes == 600 and report.recorded_return is not None
    for one in report.estimates:
        assert one.supported and one.effective_samples == pytest.approx(600)
        assert one.value == pytest.approx(report.recorded_return, rel=1e-6)


def test_deterministic_policy_is_estimated_from_exploring_recordings(policies: Path, walked: Path) -> None:
    bundle = policies / "gridworld"
    truth = walk(Policy.load(bundle), 3000, np.random.default_rng(1), explore=False)
    report = estimate(Recording(walked), bundle)
    assert report.target == "deterministic" and len(report.estimates) == 2
    for one in report.estimates:
        if one.supported:
            assert one.interval[0] <= truth <= one.interval[1]
    weighted = report.estimates[0]
    assert not weighted.supported and "acts too differently" in weighted.reason  # five choices right in a row are rare


def test_intervals_cover_as_often_as_they_claim(rng_count: int = 60) -> None:
    """Two actions of one state, so often: the truth is known in closed form."""
    covered = claimed = 0
    for repetition in range(rng_count):
        rng = np.random.default_rng(repetition)
        behaviour, target = 0.5, 0.65
        made = []
        for _ in range(600):
            taken = rng.random(4) < behaviour
            rewards = taken + rng.normal(0, 0.5, 4)
            ratio = np.where(taken, target / behaviour, (1 - target) / (1 - behaviour))
            made.append(Trajectory(rewards, np.log(ratio)))
        for one in importance_sampling(made, 1.0, rng):
            claimed += one.supported
            covered += one.supported and one.interval[0] <= 4 * target <= one.interval[1]
    assert claimed == 2 * rng_count
    assert covered >= 0.9 * claimed


def test_policy_far_from_the_recorded_one_is_not_claimed() -> None:
    rng = np.random.default_rng(0)
    made = [Trajectory(np.ones(50), np.log(np.where(rng.random(50) < 0.5, 1.8, 0.2))) for _ in range(600)]
    for one in importance_sampling(made, 1.0, rng):
        assert not one.supported and "acts too differently" in one.reason and one.effective_samples < 20


def test_too_few_episodes_are_said(policies: Path, tmp_path: Path) -> None:
    policy = Policy.load(policies / "gridworld")
    with WithRecording(policy, tmp_path / "run.mcap") as record:
        walk(policy, 599, np.random.default_rng(0), record)
    report = estimate(Recording(tmp_path / "run.mcap"), policies / "gridworld", explore=True)
    assert not any(one.supported for one in report.estimates)
    assert "599 episodes are too few: at least 600 are needed" in report.estimates[0].reason


def test_exploring_return_needs_recorded_log_probabilities(policies: Path, tmp_path: Path) -> None:
    policy = Policy.load(policies / "gridworld")
    with WithRecording(policy, tmp_path / "run.mcap") as record:
        walk(policy, 40, np.random.default_rng(0), record, explore=False)
    with pytest.raises(UsageError, match="explored and has its log-probability, which gridworld's do not: record with"):
        estimate(Recording(tmp_path / "run.mcap"), policies / "gridworld", explore=True)


def test_episodes_without_rewards_cannot_be_used(ur5: Path, tmp_path: Path) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        for _ in range(3):
            policy.reset()
            policy.act(np.zeros(27, np.float32))
    with pytest.raises(UsageError, match="no recorded episode can be used: 3 without an end"):
        estimate(Recording(tmp_path / "run.mcap"), ur5)


def test_recorder_and_candidate_may_be_two_versions(tmp_path: Path) -> None:
    """Of a continuous policy: the same network as another version has the recorded return."""
    one, two = (write_box_policy(tmp_path / "policies", version=version) for version in ("1", "2"))
    rng = np.random.default_rng(0)
    with WithRecording(Policy.load(one), tmp_path / "run.mcap", wait=True) as policy:
        for _ in range(600):
            policy.reset()
            for step in range(5):
                action = policy.act(rng.standard_normal(27).astype(np.float32), explore=True)
                policy.outcome(float(action[0]), terminated=step == 4)
    report = estimate(Recording(tmp_path / "run.mcap"), two, explore=True)
    assert report.bundle == "ur5/2" and report.policies == ["ur5/1"]
    assert all(one.supported and one.value == pytest.approx(report.recorded_return) for one in report.estimates)


def test_the_return_of_several_recorded_versions_is_not_shown_as_one(tmp_path: Path) -> None:
    bundles = [write_box_policy(tmp_path / "policies", version=version, seed=int(version)) for version in ("1", "2")]
    with Recorder(tmp_path / "run.mcap") as recorder:
        for bundle, reward in zip(bundles, (1.0, 5.0), strict=True):
            acting = WithRecording(Policy.load(bundle), recorder)
            for _ in range(3):
                acting.reset()
                acting.act(np.zeros(27, np.float32), explore=True)
                acting.outcome(reward, terminated=True)
    done = rlservo_here("estimate", tmp_path / "run.mcap", "--bundle", bundles[1], "--explore")
    assert "recorded return of 2 versions together 3 " in done.stdout, done.stdout + done.stderr
    assert "  ur5/1: 1 in 3 episodes" in done.stdout and "  ur5/2: 5 in 3 episodes" in done.stdout


def test_a_deterministic_policy_of_continuous_actions_cannot_be_estimated(tmp_path: Path) -> None:
    bundle = write_box_policy(tmp_path / "policies")
    with WithRecording(Policy.load(bundle), tmp_path / "run.mcap") as policy:
        policy.reset()
        policy.act(np.zeros(27, np.float32), explore=True)
        policy.outcome(1.0, terminated=True)
    with pytest.raises(UsageError, match="continuous ones has no probability: estimate its exploring policy with"):
        estimate(Recording(tmp_path / "run.mcap"), bundle)
