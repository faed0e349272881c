"""Coverage of importance sampling's intervals on the UR5: recordings of the shipped policy exploring, candidates near.

Candidates move the mean of the shipped policy's actions by a part of their spread, or change the spread. Each one's
true return is measured by driving the simulated arm with it; the estimates have its weights from recorded episodes.
Run (half an hour): rlservo export examples/checkpoints/ur5_positioning policies/ur5 --name ur5 &&
python benchmarks/robot_estimates.py policies/ur5
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from estimates import Candidate, linear, report
from numpy.typing import NDArray

from rlservo.export.contract.log_probability import log_probability
from rlservo.serve_app.replay.estimate import Trajectory, importance_sampling
from rlservo.serve_app.runtime.exploration import draw_action
from rlservo.serve_app.runtime.policy import Policy

ENV = "rlservo/EndEffectorPositioningURSim-v0"
ABREAST = 64  # episodes that run side by side
VARIANTS = {  # mean moved by so many standard deviations, log of the standard deviation moved by
    "the recorded policy": (0.0, 0.0),
    "mean moved by 0.03 of the spread": (0.03, 0.0),
    "spread 2% smaller": (0.0, -0.02),
    "mean moved by 0.3 of the spread": (0.3, 0.0),
}


@dataclass
class Recorded:
    """One episode: rewards, and for each variant how much likelier it makes each action."""

    rewards: list[float] = field(default_factory=list)
    weights: list[NDArray[np.float64]] = field(default_factory=list)
    """At each step, logarithms `[variants]`."""


def move(inputs: NDArray[Any], variant: tuple[float, float]) -> NDArray[np.float64]:
    """Return a variant's distribution parameters from the policy's: `[rows, (mean, log_std)]`."""
    mean, log_std = np.split(np.asarray(inputs, np.float64), 2, axis=1)
    return np.concatenate([mean + variant[0] * np.exp(log_std), log_std + variant[1]], axis=1)


def run_episodes(policy: Policy, variant: tuple[float, float], episodes: int, first_seed: int) -> list[Recorded]:
    """Drive the arm with a variant of the policy; return the episodes by seed, i is reset with `first_seed` + i."""
    contract, rng = policy.contract, np.random.default_rng(first_seed)
    assert contract.distribution is not None
    found = [Recorded() for _ in range(episodes)]
    waiting = iter(enumerate(found))
    arms = [(gym.make(ENV), one, number) for number, one in itertools.islice(waiting, ABREAST)]
    seen = [env.reset(seed=first_seed + number)[0] for env, _, number in arms]
    while arms:
        policy.act(np.stack(seen), explore=True)
        assert policy.draw is not None
        inputs = policy.draw.inputs
        drawn = draw_action(move(inputs, variant), contract.distribution, contract.action_space, rng)
        moved = [
            log_probability(move(inputs, other), drawn.own, contract.distribution, contract.action_space)
            for other in VARIANTS.values()
        ]
        own = log_probability(move(inputs, variant), drawn.own, contract.distribution, contract.action_space)
        ratios = np.stack(moved, axis=1) - own[:, None]
        still, seen = [], []
        for row, (env, episode, number) in enumerate(arms):
            obs, reward, terminated, truncated, _ = env.step(drawn.action["action"][row])
            episode.rewards.append(float(reward))
            episode.weights.append(ratios[row])
            if terminated or truncated:
                following = next(waiting, None)
                if following is None:
                    env.close()
                    continue
                number, episode = following
                obs = env.reset(seed=first_seed + number)[0]
            still.append((env, episode, number))
            seen.append(obs)
        arms = still
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--episodes", type=int, default=600, help="in each recording")
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--truth", type=int, default=4000, help="episodes for each candidate's true return")
    arguments = parser.parse_args()
    candidates = [Candidate(name, linear(0.0), False) for name in VARIANTS]
    with Policy.load(arguments.bundle) as policy:
        for candidate, variant in zip(candidates, VARIANTS.values(), strict=True):
            driven = run_episodes(policy, variant, arguments.truth, 10**6)
            candidate.truth = float(np.mean([sum(one.rewards) for one in driven]))
            print(f"{candidate.name}: true return {candidate.truth:.3f}", flush=True)
        recorded = run_episodes(policy, (0.0, 0.0), arguments.episodes * arguments.repetitions, 0)
        # Ten times as many episodes as above, of which one recording is a hundredth: the better truth.
        candidates[0].truth = float(np.mean([sum(one.rewards) for one in recorded]))
        for repetition in range(arguments.repetitions):
            episodes = recorded[repetition * arguments.episodes :][: arguments.episodes]
            for index, candidate in enumerate(candidates):
                made = [trajectory_of(one, index) for one in episodes]
                for estimate in importance_sampling(made, 1.0, np.random.default_rng(repetition)):
                    candidate.count(estimate)
    report(candidates, arguments.repetitions, arguments.episodes)


def trajectory_of(one: Recorded, variant: int) -> Trajectory:
    """Return what importance sampling is made of: it looks at neither observations nor actions."""
    nothing = np.zeros((len(one.rewards), 0), np.float32)
    return Trajectory(np.array(one.rewards), np.array(one.weights)[:, variant], nothing, nothing, nothing)


if __name__ == "__main__":
    main()
