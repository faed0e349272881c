"""The domain randomisation wrapper: what it does, in numbers, and that it does nothing unasked."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.envs.randomization import DomainRandomization

ARM, BASE = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/NoObstacleNavigationMir100Sim-v0"


def episode(env: gym.Env, seed: int, steps: int = 25) -> np.ndarray:
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    rows = [observation]
    for _ in range(steps):
        observation, *_ = env.step(0.3 * env.action_space.sample())
        rows.append(observation)
    return np.array(rows)


def arm(**arguments: Any) -> DomainRandomization:
    return DomainRandomization(gym.make(ARM), **arguments)


@pytest.mark.parametrize("env_id", [ARM, BASE])
def test_nothing_asked_for_changes_nothing(env_id: str) -> None:
    plain, wrapped = gym.make(env_id), DomainRandomization(gym.make(env_id))
    assert (episode(plain, 3) == episode(wrapped, 3)).all()
    assert wrapped.observation_space == plain.observation_space


def test_action_latency_is_whole_cycles() -> None:
    plain, late = gym.make(BASE), DomainRandomization(gym.make(BASE), action_latency=(3, 3))
    turn, ahead = np.array([0, 1], np.float32), np.array([1, 0], np.float32)
    _, info = late.reset(seed=1)
    plain.reset(seed=1)
    assert info["randomization"] == {"action_latency": 3, "observation_latency": 0, "payload": 0.0}
    for step in range(12):
        seen, *_ = late.step(ahead if step else turn)
        # The first action repeats until the second comes through, three cycles late.
        expected, *_ = plain.step(turn if step <= 3 else ahead)
        assert (seen == expected).all()


def test_observation_latency_is_whole_cycles() -> None:
    plain = episode(gym.make(BASE), 2)
    old = episode(DomainRandomization(gym.make(BASE), observation_latency=(2, 2)), 2)
    assert (old[2:] == plain[:-2]).all()
    assert (old[:2] == plain[0]).all()


def test_noise_has_the_asked_spread_on_the_asked_elements_and_stays_in_the_space() -> None:
    sigma = {"target_x": 0.01, "base_position_normalized": 0.002}
    plain, noisy = episode(gym.make(ARM), 0, steps=290), episode(arm(observation_noise=sigma), 0, steps=290)
    difference = noisy - plain
    spread = difference.std(axis=0)
    assert spread[15] == pytest.approx(0.01, rel=0.2)
    assert spread[3] == pytest.approx(0.002, rel=0.2)
    assert abs(difference[:, 15].mean()) < 0.002
    others = np.delete(spread, [3, 15])
    assert (others == 0).all()
    wild = arm(observation_noise=10.0)
    assert all(row in wild.observation_space for row in episode(wild, 0))


def test_payload_is_drawn_from_its_range_and_felt_by_the_arm() -> None:
    env = arm(payload=(1.0, 4.0))
    drawn = [env.reset(seed=seed)[1]["randomization"]["payload"] for seed in range(40)]
    assert min(drawn) >= 1.0
    assert max(drawn) <= 4.0
    assert np.ptp(drawn) > 1.5
    plain, loaded = episode(gym.make(ARM), 5), episode(arm(payload=(4.0, 4.0)), 5)
    assert 1e-4 < np.abs(plain[:, 3:9] - loaded[:, 3:9]).max() < 0.05


def test_same_seed_gives_the_same_episode_and_another_draws_anew() -> None:
    arguments: dict[str, Any] = {
        "action_latency": (0, 3), "observation_latency": (0, 2), "observation_noise": 0.01, "payload": (0.0, 3.0),
    }  # fmt: skip
    env = arm(**arguments)
    first = episode(env, 8)
    assert (episode(env, 8) == first).all()
    assert (episode(arm(**arguments), 8) == first).all()
    seen = {str(env.reset(seed=seed)[1]["randomization"]) for seed in range(10)}
    assert len(seen) == 10
    env.reset(seed=8)
    assert len({str(env.reset()[1]["randomization"]["payload"]) for _ in range(5)}) == 5


def test_rewards_and_endings_are_of_what_really_happened() -> None:
    plain, noisy = gym.make(ARM), arm(observation_noise=1.0)
    for env in (plain, noisy):
        env.reset(seed=4)
    for _ in range(20):
        action = np.zeros(5, np.float32)
        assert plain.step(action)[1:4] == noisy.step(action)[1:4]


@pytest.mark.parametrize(
    ("env_id", "arguments", "message"),
    [
        (ARM, {"action_latency": (2, 1)}, r"action_latency is \(2, 1\): expected \(low, high\) with 0 <= low <= high"),
        (ARM, {"observation_latency": (0, 1.5)}, "expected whole control cycles"),
        (ARM, {"observation_noise": -0.1}, "negative or infinite standard deviation"),
        (ARM, {"observation_noise": [0.1, 0.2]}, r"observation_noise has shape \(2,\), expected one number or 27"),
        (ARM, {"observation_noise": {"elbow": 0.1}}, "observation_noise names elbow: expected some of target_r, "),
        (ARM, {"payload": (0.0, float("inf"))}, "payload is"),
        (BASE, {"payload": (0.0, 1.0)}, "NoObstacleNavigationMir100Sim has no simulation that carries one"),
    ],
)
def test_impossible_randomisation_is_refused(env_id: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DomainRandomization(gym.make(env_id), **arguments)


def test_randomization_by_id_is_the_wrapper_around_the_named_environment() -> None:
    by_id = gym.make("rlservo/Randomized-v0", env_id=ARM, action_latency=(3, 3), rs_state_to_info=False)
    wrapped = DomainRandomization(gym.make(ARM, rs_state_to_info=False), action_latency=(3, 3))
    for env in (by_id, wrapped):
        _, info = env.reset(seed=3)
        assert info["randomization"]["action_latency"] == 3
    action = np.full(5, 0.1, np.float32)
    for _ in range(5):
        np.testing.assert_array_equal(by_id.step(action)[0], wrapped.step(action)[0])
    with pytest.raises(ValueError, match="expected whole control cycles"):
        gym.make("rlservo/Randomized-v0", env_id=ARM, action_latency=(0, 0.5))
