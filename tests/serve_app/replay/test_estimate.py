"""Estimates cover the truth if they claim to, and report if they cannot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.recording.reader import Recording
from rlservo.serve_app.recording.recorded_policy import WithRecording
from rlservo.serve_app.replay.estimate import Trajectory, estimate, fitted_estimate, importance_sampling
from rlservo.serve_app.runtime.policy import Policy

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
    assert report.target == "deterministic" and len(report.estimates) == 3
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
            none = np.zeros((4, 1), np.float32)
            made.append(Trajectory(rewards, np.log(ratio), none, none, none))
        for one in importance_sampling(made, 1.0, rng):
            claimed += one.supported
            covered += one.supported and one.interval[0] <= 4 * target <= one.interval[1]
    assert claimed == 2 * rng_count
    assert covered >= 0.9 * claimed


def test_policy_far_from_the_recorded_one_is_not_claimed() -> None:
    rng = np.random.default_rng(0)
    none = np.zeros((50, 1), np.float32)
    made = [
        Trajectory(np.ones(50), np.log(np.where(rng.random(50) < 0.5, 1.8, 0.2)), none, none, none) for _ in range(600)
    ]
    for one in importance_sampling(made, 1.0, rng):
        assert not one.supported and "acts too differently" in one.reason and one.effective_samples < 20


def linear_world(episodes: int, rng: Rng, noise: float, shift: float) -> tuple[list[Trajectory], float]:
    """A point pulled to 0 by its action: reward -x^2. The bundle pulls harder by `shift`; return (data, its return)."""

    def run(gain: float, spread: float, count: int) -> tuple[list[Trajectory], float]:
        made, total = [], 0.0
        for _ in range(count):
            x, rows, actions, rewards = rng.normal(), [], [], []
            for _ in range(10):
                action = -gain * x + spread * rng.normal()
                rows.append([x])
                actions.append([action])
                rewards.append(-(x**2))
                x = x + 0.5 * action + 0.05 * rng.normal()
            obs, done = np.array(rows, np.float32), np.array(actions, np.float32)
            made.append(Trajectory(np.array(rewards), None, obs, done, (-(gain + shift) * obs).astype(np.float32)))
            total += sum(rewards)
        return made, total / count

    return run(0.5, noise, episodes)[0], run(0.5 + shift, 0.0, 4000)[1]


def test_fitted_q_finds_the_return_of_a_policy_inside_the_data() -> None:
    rng = np.random.default_rng(0)
    made, truth = linear_world(200, rng, noise=0.5, shift=0.2)
    one = fitted_estimate(made, 1.0, rng)
    assert one.supported, one.reason
    assert "experimental" in one.method
    assert one.interval[0] <= truth <= one.interval[1]
    assert abs(one.value - truth) < 0.15 * abs(truth)


def test_fitted_q_claims_nothing_outside_the_data() -> None:
    rng = np.random.default_rng(0)
    made, _ = linear_world(200, rng, noise=0.01, shift=2.0)
    one = fitted_estimate(made, 1.0, rng)
    assert not one.supported


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
    with pytest.raises(UsageError, match="explored and has its log-probability"):
        estimate(Recording(tmp_path / "run.mcap"), policies / "gridworld", explore=True)


def test_episodes_without_rewards_cannot_be_used(ur5: Path, tmp_path: Path) -> None:
    with WithRecording(Policy.load(ur5), tmp_path / "run.mcap") as policy:
        for _ in range(3):
            policy.reset()
            policy.act(np.zeros(27, np.float32))
    with pytest.raises(UsageError, match="no recorded episode can be used: 3 without an end"):
        estimate(Recording(tmp_path / "run.mcap"), ur5)


def test_recorder_and_candidate_may_be_two_versions(box_policy: Callable[..., Path], tmp_path: Path) -> None:
    """Of a continuous policy: the same network as another version has the recorded return."""
    one, two = (box_policy(tmp_path / "policies", version=version) for version in ("1", "2"))
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
