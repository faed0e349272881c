"""Coverage of estimates' intervals on the UR5: recordings of the shipped policy exploring, and candidates near it.

Candidates move the mean of the shipped policy's actions by a part of their spread, or change the spread. Each one's
true return is measured by driving the simulated arm with it; the estimates weight recorded episodes. `--fitted` counts
fitted Q evaluation, for candidates that do not explore.
Run (half an hour): rlservo export examples/checkpoints/ur5_positioning --out policies --name ur5 &&
python benchmarks/robot_estimates.py policies/ur5 && python benchmarks/robot_estimates.py policies/ur5 --fitted
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
from rlservo.serve_app.replay.estimate import Trajectory, fitted_estimate, importance_sampling
from rlservo.serve_app.runtime.exploration import draw_action
from rlservo.serve_app.runtime.policy import Policy

ENV = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
ABREAST = 64  # episodes that run side by side
VARIANTS = {  # mean moved by so many standard deviations, and the log of the standard deviation by so much
    "the recorded policy": (0.0, 0.0),
    "mean moved by 0.03 of the spread": (0.03, 0.0),
    "spread 2% smaller": (0.0, -0.02),
    "mean moved by 0.3 of the spread": (0.3, 0.0),
}
DETERMINISTIC = {  # with e^-20 of the spread
    "the mode": (0.0, -20.0),
    "the mode moved by 0.3 of the spread": (0.3, -20.0),
    "the mode moved by the spread": (1.0, -20.0),
}


@dataclass
class Recorded:
    """One episode, and the variants' probabilities of its actions."""

    rewards: list[float] = field(default_factory=list)
    weights: list[NDArray[np.float64]] = field(default_factory=list)
    """Logarithms at each step, `[VARIANTS]`."""
    obs: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    chosen: list[NDArray[np.float32]] = field(default_factory=list)
    """Actions at each step, `[DETERMINISTIC, elements]`."""


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
        modes = [
            draw_action(move(inputs, other), contract.distribution, contract.action_space, rng).action["action"]
            for other in DETERMINISTIC.values()
        ]
        still, following_obs = [], []
        for row, (env, episode, number) in enumerate(arms):
            obs, reward, terminated, truncated, _ = env.step(drawn.action["action"][row])
            episode.rewards.append(float(reward))
            episode.weights.append(ratios[row])
            episode.obs.append(np.asarray(seen[row], np.float32))
            episode.actions.append(np.asarray(drawn.action["action"][row], np.float32))
            episode.chosen.append(np.stack([mode[row] for mode in modes]).astype(np.float32))
            if terminated or truncated:
                following = next(waiting, None)
                if following is None:
                    env.close()
                    continue
                number, episode = following
                obs = env.reset(seed=first_seed + number)[0]
            still.append((env, episode, number))
            following_obs.append(obs)
        arms, seen = still, following_obs
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--episodes", type=int, default=600, help="in each recording")
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--truth", type=int, default=4000, help="episodes for each candidate's true return")
    parser.add_argument("--fitted", action="store_true", help="fitted Q evaluation, and not importance sampling")
    arguments = parser.parse_args()
    variants = DETERMINISTIC if arguments.fitted else VARIANTS
    candidates = [Candidate(name, linear(0.0), arguments.fitted) for name in variants]
    with Policy.load(arguments.bundle) as policy:
        for candidate, variant in zip(candidates, variants.values(), strict=True):
            driven = run_episodes(policy, variant, arguments.truth, 10**6)
            candidate.truth = float(np.mean([sum(one.rewards) for one in driven]))
            print(f"{candidate.name}: true return {candidate.truth:.3f}", flush=True)
        recorded = run_episodes(policy, (0.0, 0.0), arguments.episodes * arguments.repetitions, 0)
        if not arguments.fitted:  # more episodes than above (one recording is a hundredth of them) give a better truth
            candidates[0].truth = float(np.mean([sum(one.rewards) for one in recorded]))
        for repetition in range(arguments.repetitions):
            episodes = recorded[repetition * arguments.episodes :][: arguments.episodes]
            for index, candidate in enumerate(candidates):
                made = [trajectory_of(one, index, arguments.fitted) for one in episodes]
                rng = np.random.default_rng(repetition)
                estimated = (
                    [fitted_estimate(made, 1.0, rng)] if arguments.fitted else importance_sampling(made, 1.0, rng)
                )
                for estimate in estimated:
                    candidate.count(estimate)
            if (repetition + 1) % 10 == 0:
                print(f"{repetition + 1} of {arguments.repetitions} repetitions estimated", flush=True)
    report(candidates, arguments.repetitions, arguments.episodes)


def trajectory_of(one: Recorded, variant: int, fitted: bool) -> Trajectory:
    """Return an estimate's input."""
    weights = None if fitted else np.array(one.weights)[:, variant]
    chosen = np.array(one.chosen)[:, variant if fitted else 0]
    return Trajectory(np.array(one.rewards), weights, np.array(one.obs), np.array(one.actions), chosen)


if __name__ == "__main__":
    main()
