"""Coverage of estimates' intervals: how often those from repeated recordings contain the true return.

Each repetition records episodes with one policy and estimates the return of others, whose true returns come from many
episodes of their own. `--world linear` is a point pulled to 0, for fitted Q evaluation alone. Repetition i has the seed
FIRST_SEED + i: seeds below 1000 were used when the limits of the estimates were chosen.
Run: python benchmarks/estimates.py --importance-only; python benchmarks/estimates.py --world linear --episodes 100
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rlservo.serve_app.replay.estimate import Estimate, Trajectory, fitted_estimate, importance_sampling

DIRECTION = np.array([0.05, 0.35, 2.2, 1.1])  # a linear policy that balances
BEHAVIOUR = 1.0
TRUTH_EPISODES = 20_000
LIMIT = 200  # steps of an episode
FIRST_SEED = 1000
LINEAR_GAIN, LINEAR_STEPS = 0.5, 10  # of the recorded policy in the linear world

Probability = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Probability of pushing right, for observations `[rows, 4]`."""


@dataclass
class Candidate:
    """A policy to estimate, and the counts of the claims about it."""

    name: str
    probability: Probability
    deterministic: bool
    truth: float = 0.0
    claimed: dict[str, int] = field(default_factory=dict)
    covered: dict[str, int] = field(default_factory=dict)
    widths: dict[str, list[float]] = field(default_factory=dict)
    effective: dict[str, list[float]] = field(default_factory=dict)
    covered_unclaimed: dict[str, int] = field(default_factory=dict)

    def count(self, estimate: Estimate) -> None:
        low, high = estimate.interval
        covers = low <= self.truth <= high
        method = estimate.method
        self.effective.setdefault(method, []).append(estimate.effective_samples)
        if estimate.supported:
            self.claimed[method] = self.claimed.get(method, 0) + 1
            self.covered[method] = self.covered.get(method, 0) + covers
            self.widths.setdefault(method, []).append(high - low)
        else:
            self.covered_unclaimed[method] = self.covered_unclaimed.get(method, 0) + covers


def linear(gain: float, shift: float = 0.0) -> Probability:
    return lambda obs: 1 / (1 + np.exp(-gain * (obs @ DIRECTION + shift)))


def greedy(direction: Sequence[float]) -> Probability:
    weights = np.array(direction)
    return lambda obs: (obs @ weights > 0).astype(np.float64)


def run_episodes(
    probability: Probability, episodes: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return (observations `[steps, episodes, 4]`, actions `[steps, episodes]`, lengths)."""
    env = gym.make_vec("CartPole-v1", num_envs=episodes, vectorization_mode="vector_entry_point")
    rng = np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    seen, done = [], []
    lengths = np.full(episodes, LIMIT, np.int64)
    alive = np.ones(episodes, np.bool_)
    for step in range(LIMIT):
        action = (rng.random(episodes) < probability(obs.astype(np.float64))).astype(np.int64)
        seen.append(obs.astype(np.float64))
        done.append(action)
        obs, _, terminated, truncated, _ = env.step(action)
        ended = alive & (terminated | truncated)
        lengths[ended] = step + 1
        alive &= ~ended
        if not alive.any():
            break
    env.close()
    return np.array(seen), np.array(done), lengths


def trajectories(
    obs: NDArray[np.float64],
    actions: NDArray[np.int64],
    lengths: NDArray[np.int64],
    recorded: Probability | None,
    candidate: Candidate,
) -> list[Trajectory]:
    """Return the parts of an estimate; `recorded` is None if the log-probabilities are not known."""
    found = []
    one_hot = np.eye(2, dtype=np.float32)
    for index, length in enumerate(lengths):
        rows, taken = obs[:length, index], actions[:length, index]
        right = candidate.probability(rows)
        weights = None
        if recorded is not None:
            known = recorded(rows)
            with np.errstate(divide="ignore"):
                weights = np.log(np.where(taken == 1, right, 1 - right)) - np.log(
                    np.where(taken == 1, known, 1 - known)
                )
        chosen = one_hot[(right > 0.5).astype(np.int64)]
        found.append(Trajectory(np.ones(length), weights, rows.astype(np.float32), one_hot[taken], chosen))
    return found


def study(candidates: list[Candidate], recorded: Probability, episodes: int, seeds: range) -> None:
    """Fill in the candidates' counts."""
    for candidate in candidates:
        candidate.truth = float(run_episodes(candidate.probability, TRUTH_EPISODES, 10**6)[2].mean())
    for seed in seeds:
        obs, actions, lengths = run_episodes(recorded, episodes, seed)
        rng = np.random.default_rng(seed)
        for candidate in candidates:
            made = trajectories(obs, actions, lengths, recorded, candidate)
            for one in importance_sampling(made, 1.0, rng):
                candidate.count(one)
            if candidate.deterministic:
                candidate.count(fitted_estimate(made, 1.0, rng))


def linear_episodes(
    gain: float, noise: float, episodes: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (positions, actions) `[episodes, steps]` of a point that earns -x^2 at x and moves by half its action."""
    position = rng.normal(size=episodes)
    positions, actions = [], []
    for _ in range(LINEAR_STEPS):
        action = -gain * position + noise * rng.normal(size=episodes)
        positions.append(position)
        actions.append(action)
        position = position + 0.5 * action + 0.05 * rng.normal(size=episodes)
    return np.array(positions).T, np.array(actions).T


def linear_study(episodes: int, seeds: range) -> list[Candidate]:
    """Return fitted Q's counts for policies that pull harder or weaker than the recorded one, which explores by noise.

    The candidates differ from that of the tests (noise 0.5, pulls harder by 0.2), on which it was tuned.
    """
    found = []
    for noise, shift in [(0.5, 0.2), (0.5, 0.0), (0.5, -0.3), (0.5, 0.5), (0.2, 0.2), (0.2, -0.1)]:
        candidate = Candidate(f"recorded with noise {noise:g}, gain {LINEAR_GAIN + shift:g}", linear(0.0), True)
        truth, _ = linear_episodes(LINEAR_GAIN + shift, 0.0, 10 * TRUTH_EPISODES, np.random.default_rng(10**6))
        candidate.truth = float(-(truth**2).sum(axis=1).mean())
        for seed in seeds:
            rng = np.random.default_rng(seed)
            positions, actions = linear_episodes(LINEAR_GAIN, noise, episodes, rng)
            made = [
                Trajectory(
                    -(x**2),
                    None,
                    x[:, None].astype(np.float32),
                    a[:, None].astype(np.float32),
                    (-(LINEAR_GAIN + shift) * x[:, None]).astype(np.float32),
                )
                for x, a in zip(positions, actions, strict=True)
            ]
            candidate.count(fitted_estimate(made, 1.0, rng))
        found.append(candidate)
    return found


def candidates_of_the_study() -> list[Candidate]:
    return [
        Candidate("the recorded policy", linear(BEHAVIOUR), False),
        Candidate("gain 1.1", linear(1.1), False),
        Candidate("gain 1.3", linear(1.3), False),
        Candidate("gain 1.6", linear(1.6), False),
        Candidate("gain 2", linear(2.0), False),
        Candidate("gain 4", linear(4.0), False),
        Candidate("gain 1, leaning", linear(1.0, 0.2), False),
        Candidate("greedy", greedy(DIRECTION.tolist()), True),
        Candidate("greedy, angle only", greedy([0, 0, 1, 0]), True),
        Candidate("greedy, angle and its speed", greedy([0, 0, 1, 1]), True),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=600)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--importance-only", action="store_true", help="leave out fitted Q evaluation, which is slow")
    parser.add_argument("--world", choices=["cartpole", "linear"], default="cartpole")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.repetitions)
    if arguments.world == "linear":
        candidates = linear_study(arguments.episodes, seeds)
    else:
        candidates = candidates_of_the_study()
        if arguments.importance_only:
            candidates = [candidate for candidate in candidates if not candidate.deterministic]
        study(candidates, linear(BEHAVIOUR), arguments.episodes, seeds)
    report(candidates, arguments.repetitions, arguments.episodes)


def report(candidates: list[Candidate], repetitions: int, episodes: int) -> None:
    """Print the claims about each candidate, and how often they held."""
    print(f"{repetitions} repetitions of {episodes} episodes; 95% intervals")
    for candidate in candidates:
        print(f"{candidate.name}: true return {candidate.truth:.4g}")
        for method in sorted({*candidate.claimed, *candidate.covered_unclaimed}):
            claimed, covered = candidate.claimed.get(method, 0), candidate.covered.get(method, 0)
            width = float(np.mean(candidate.widths[method])) if claimed else float("nan")
            outside = candidate.covered_unclaimed.get(method, 0)
            print(
                f"  {method}: claimed {claimed}, covered {covered} of them, mean width {width:.3g}; "
                f"covered {outside} of {repetitions - claimed} not claimed; "
                f"mean of effective episodes {np.mean(candidate.effective[method]):.0f}"
            )


if __name__ == "__main__":
    main()
