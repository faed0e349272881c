"""Coverage of estimates' intervals: how often those from repeated recordings contain the true return.

Each repetition records episodes with one policy that explores, and estimates the return of others, whose true returns
come from many episodes of their own. Repetition i has the seed FIRST_SEED + i: seeds below 1000 were used when the
limits of the estimates were chosen. Worlds: CartPole; and with `--bundle` the simulated UR5, whose candidates move the
mean of that policy's actions by a part of their spread, or change the spread.

    python benchmarks/estimates.py
    rlservo export examples/checkpoints/ur5_positioning --out policies --name ur5    # then half an hour:
    python benchmarks/estimates.py --bundle policies/ur5
"""

from __future__ import annotations

import argparse
import itertools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.log_probability import log_probability
from rlservo.policy.exploration import draw_action
from rlservo.policy.policy import Policy
from rlservo.recording.replay.estimate import Estimate, Trajectory, importance_sampling

FIRST_SEED, TRUTH_SEED = 1000, 10**6
Array = NDArray[np.float64]


@dataclass
class Claims:
    """The estimates of one method about one candidate."""

    widths: list[float] = field(default_factory=list)  # of those that are claimed
    covered: int = 0  # of those
    covered_unclaimed: int = 0
    effective: list[float] = field(default_factory=list)


@dataclass
class Candidate:
    """A policy to estimate, as its world describes it, and the claims about it."""

    name: str
    policy: Any
    truth: float = 0.0
    claims: defaultdict[str, Claims] = field(default_factory=lambda: defaultdict(Claims))

    def count(self, estimate: Estimate) -> None:
        low, high = estimate.interval
        claims, covers = self.claims[estimate.method], low <= self.truth <= high
        claims.effective.append(estimate.effective_samples)
        if estimate.supported:
            claims.widths.append(high - low)
            claims.covered += covers
        else:
            claims.covered_unclaimed += covers


class World(NamedTuple):
    """Candidates, and a function that records with a seed: it returns one that gives a candidate's trajectories."""

    candidates: list[Candidate]
    record: Callable[[int], Callable[[Candidate], list[Trajectory]]]


# CartPole: a policy is its probability of pushing right, for observations [rows, 4].

DIRECTION = np.array([0.05, 0.35, 2.2, 1.1])  # a linear policy that balances
BEHAVIOUR = 1.0
TRUTH_EPISODES = 20_000
LIMIT = 200  # steps of an episode
Probability = Callable[[Array], Array]


def linear(gain: float, shift: float = 0.0) -> Probability:
    return lambda obs: 1 / (1 + np.exp(-gain * (obs @ DIRECTION + shift)))


def cartpole(episodes: int) -> World:
    policies = {
        "the recorded policy": linear(BEHAVIOUR), "gain 1.1": linear(1.1), "gain 1.3": linear(1.3),
        "gain 1.6": linear(1.6), "gain 2": linear(2.0), "gain 4": linear(4.0), "gain 1, leaning": linear(1.0, 0.2),
    }  # fmt: skip
    candidates = [Candidate(name, policy) for name, policy in policies.items()]
    for candidate in candidates:
        candidate.truth = float(balance(candidate.policy, TRUTH_EPISODES, TRUTH_SEED)[2].mean())

    def record(seed: int) -> Callable[[Candidate], list[Trajectory]]:
        obs, actions, lengths = balance(linear(BEHAVIOUR), episodes, seed)
        return lambda candidate: [
            pushes(obs[:length, index], actions[:length, index], candidate.policy)
            for index, length in enumerate(lengths)
        ]

    return World(candidates, record)


def balance(probability: Probability, episodes: int, seed: int) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
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


def pushes(rows: Array, taken: NDArray[np.int64], policy: Probability) -> Trajectory:
    """Return an episode as the estimate of a policy reads it."""
    right, known = policy(rows), linear(BEHAVIOUR)(rows)
    with np.errstate(divide="ignore"):
        weights = np.log(np.where(taken == 1, right, 1 - right)) - np.log(np.where(taken == 1, known, 1 - known))
    return Trajectory(np.ones(len(rows)), weights)


# The UR5: a policy is the shipped one, its mean moved by so many standard deviations, and their logarithm by so much.

ENV = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
ABREAST = 64  # episodes that run side by side
Variant = tuple[float, float]
VARIANTS: dict[str, Variant] = {
    "the recorded policy": (0.0, 0.0),
    "mean moved by 0.03 of the spread": (0.03, 0.0),
    "spread 2% smaller": (0.0, -0.02),
    "mean moved by 0.3 of the spread": (0.3, 0.0),
}
Step = tuple[float, Array]
"""Reward, and logarithms of the weights `[VARIANTS]`."""


def arm(policy: Policy, args: argparse.Namespace) -> World:
    candidates = [Candidate(name, index) for index, name in enumerate(VARIANTS)]
    for candidate, variant in zip(candidates, VARIANTS.values(), strict=True):
        candidate.truth = mean_return(drive(policy, variant, args.truth, TRUTH_SEED))
        print(f"{candidate.name}: true return {candidate.truth:.3f}", flush=True)
    recorded = drive(policy, (0.0, 0.0), args.episodes * args.repetitions, 0)
    # More episodes than above (one recording is a hundredth of them) give a better truth.
    candidates[0].truth = mean_return(recorded)

    def record(seed: int) -> Callable[[Candidate], list[Trajectory]]:
        episodes = recorded[(seed - args.first_seed) * args.episodes :][: args.episodes]
        return lambda candidate: [trajectory_of(one, candidate.policy) for one in episodes]

    return World(candidates, record)


def mean_return(episodes: list[list[Step]]) -> float:
    return float(np.mean([sum(reward for reward, *_ in one) for one in episodes]))


def trajectory_of(steps: list[Step], variant: int) -> Trajectory:
    rewards, weights = map(np.array, zip(*steps, strict=True))
    return Trajectory(rewards, weights[:, variant])


def move(inputs: NDArray[Any], variant: Variant) -> Array:
    """Return a variant's distribution parameters from the policy's: `[rows, (mean, log_std)]`."""
    mean, log_std = np.split(np.asarray(inputs, np.float64), 2, axis=1)
    return np.concatenate([mean + variant[0] * np.exp(log_std), log_std + variant[1]], axis=1)


def drive(policy: Policy, variant: Variant, episodes: int, first_seed: int) -> list[list[Step]]:
    """Drive the arm with a variant of the policy; return the episodes by seed, i is reset with `first_seed` + i."""
    contract, rng = policy.contract, np.random.default_rng(first_seed)
    assert contract.distribution is not None
    found: list[list[Step]] = [[] for _ in range(episodes)]
    waiting = iter(enumerate(found))
    arms = [(gym.make(ENV), one, number) for number, one in itertools.islice(waiting, ABREAST)]
    seen = [env.reset(seed=first_seed + number)[0] for env, _, number in arms]
    while arms:
        policy.act(np.stack(seen), explore=True)
        assert policy.draw is not None
        inputs = policy.draw.inputs
        drawn = draw_action(move(inputs, variant), contract.distribution, contract.action_space, rng)
        own, *moved = (
            log_probability(move(inputs, other), drawn.own, contract.distribution, contract.action_space)
            for other in (variant, *VARIANTS.values())
        )
        ratios = np.stack(moved, axis=1) - own[:, None]
        still, following_obs = [], []
        for row, (env, episode, number) in enumerate(arms):
            action = drawn.action["action"][row]
            obs, reward, terminated, truncated, _ = env.step(action)
            episode.append((float(reward), ratios[row]))
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, help="the UR5's policy, for its world")
    parser.add_argument("--episodes", type=int, default=600, help="in each recording")
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--truth", type=int, default=4000, help="UR5: episodes for each candidate's true return")
    args = parser.parse_args()
    if args.bundle is not None:
        with Policy.load(args.bundle) as policy:
            world = arm(policy, args)
    else:
        world = cartpole(args.episodes)
    for repetition in range(args.repetitions):
        recording = world.record(args.first_seed + repetition)
        for candidate in world.candidates:
            made, rng = recording(candidate), np.random.default_rng(args.first_seed + repetition)
            for estimate in importance_sampling(made, 1.0, rng):
                candidate.count(estimate)
        if (repetition + 1) % 10 == 0:
            print(f"{repetition + 1} of {args.repetitions} repetitions estimated", flush=True)
    report(world.candidates, args.repetitions, args.episodes)


def report(candidates: list[Candidate], repetitions: int, episodes: int) -> None:
    """Print the claims about each candidate, and how often they held."""
    print(f"{repetitions} repetitions of {episodes} episodes; 95% intervals")
    for candidate in candidates:
        print(f"{candidate.name}: true return {candidate.truth:.4g}")
        for method, claims in sorted(candidate.claims.items()):
            claimed = len(claims.widths)
            width = float(np.mean(claims.widths)) if claimed else float("nan")
            print(
                f"  {method}: claimed {claimed}, covered {claims.covered} of them, mean width {width:.3g}; "
                f"covered {claims.covered_unclaimed} of {repetitions - claimed} not claimed; "
                f"mean of effective episodes {np.mean(claims.effective):.0f}"
            )


if __name__ == "__main__":
    main()
