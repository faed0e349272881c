"""Fitted Q evaluation in closed form: the value of a deterministic policy from another policy's episodes.

The value of an action in a state is a sum over fixed features of both (and of the step, since episodes have a time
limit); least-squares temporal differences (Bradtke, Barto 1996; Lagoudakis, Parr 2003) give the weights. The same model
is fitted to the recorded policy, whose return is known: what it gets wrong there is taken off, and if that is much, or
if the bundle's actions are unlike the recorded ones, nothing is claimed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LARGEST_BASIS = 400
WAVES = 250  # random Fourier features (Rahimi, Recht 2007), where squares and products would be too many
RIDGE = 1e-4  # relative to the features' own scale
GROUPS = 60  # of episodes, for the bootstrap
FARTHEST = 0.05  # the share of the bundle's actions that may be unlike recorded ones
LARGEST_ERROR = 4.0  # of the recorded policy's fitted return, in its standard errors

Episode = tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Rewards, observations, actions, the bundle's actions."""
Basis = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Fit:
    """The bundle's fitted return, and how far to trust it."""

    value: float
    resampled: NDArray[np.float64]
    effective_samples: float
    inside: float
    """The share of the bundle's actions that are like recorded ones."""
    doubt: str | None


def fitted_q(episodes: Sequence[Episode], gamma: float, resamples: int, rng: np.random.Generator) -> Fit:
    """Estimate the mean return of the policy that chose each episode's last array."""
    longest = max(len(rewards) for rewards, *_ in episodes)
    steps = [np.arange(len(rewards))[:, None] / longest for rewards, *_ in episodes]
    recorded = [
        np.concatenate([obs, actions, t], axis=1) for (_, obs, actions, _), t in zip(episodes, steps, strict=True)
    ]
    chosen = [np.concatenate([obs, other, t], axis=1) for (_, obs, _, other), t in zip(episodes, steps, strict=True)]
    basis = _basis(np.concatenate(recorded), rng)

    groups = min(GROUPS, len(episodes))
    group_of = np.arange(len(episodes)) % groups
    first = basis(np.zeros((1, recorded[0].shape[1]))).shape[1]
    ours, theirs = (np.zeros((groups, first, first)) for _ in range(2))  # the bundle's, the recorded policy's
    rewards_by = np.zeros((groups, first))
    starts_ours, starts_theirs = np.zeros((groups, first)), np.zeros((groups, first))
    returns, sizes = np.zeros(groups), np.zeros(groups)
    gram = np.zeros((first, first))
    for index, (rewards, *_) in enumerate(episodes):
        group = group_of[index]
        phi, other = basis(recorded[index]), basis(chosen[index])
        nothing = np.zeros((1, first))  # after an episode's last action nothing is earned
        ours[group] += phi.T @ (phi - gamma * np.concatenate([other[1:], nothing]))
        theirs[group] += phi.T @ (phi - gamma * np.concatenate([phi[1:], nothing]))
        rewards_by[group] += phi.T @ rewards
        starts_ours[group] += other[0]
        starts_theirs[group] += phi[0]
        returns[group] += float((rewards * gamma ** np.arange(len(rewards))).sum())
        sizes[group] += 1
        gram += phi.T @ phi
    ridge = RIDGE * np.trace(gram) / first * np.eye(first) / len(episodes)

    def values(counts: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return (the bundle's fitted return, the recorded policy's, its mean) of so many of each group."""
        total = float(counts @ sizes)
        reward = np.tensordot(counts, rewards_by, 1)
        fits = []
        for matrices, starts in ((ours, starts_ours), (theirs, starts_theirs)):
            matrix = np.tensordot(counts, matrices, 1) + total * ridge
            fits.append(float(np.tensordot(counts, starts, 1) @ np.linalg.solve(matrix, reward)) / total)
        return fits[0], fits[1], float(counts @ returns) / total

    fitted, again, known = values(np.ones(groups))
    draws = rng.multinomial(groups, np.full(groups, 1 / groups), min(resamples, 200)).astype(np.float64)
    samples = np.array([values(draw) for draw in draws])
    inside = _inside(gram, basis, recorded, chosen)
    spread = float(samples[:, 2].std()) or 1e-9
    doubt = None
    own = np.array([float((rewards * gamma ** np.arange(len(rewards))).sum()) for rewards, *_ in episodes])
    value = known + fitted - again
    if inside < 1 - FARTHEST:
        doubt = f"{1 - inside:.0%} of the bundle's actions are unlike any that were recorded"
    elif abs(again - known) > LARGEST_ERROR * spread:
        doubt = f"the fitted value gives the recorded return as {again:.4g}, and it was {known:.4g}"
    elif not own.min() <= value <= own.max():
        doubt = f"the estimate {value:.4g} is beyond every recorded return"
    resampled = samples[:, 2] + samples[:, 0] - samples[:, 1]
    wider = abs(again - known)  # what the model is known to get wrong
    resampled = np.concatenate([resampled - wider, resampled + wider])
    return Fit(value, resampled, len(episodes) * inside, inside, doubt)


def _basis(rows: NDArray[np.float64], rng: np.random.Generator) -> Basis:
    """Return features of state, action and step: squares and products, or random waves where those are too many."""
    mean, scale = rows.mean(axis=0), rows.std(axis=0)
    varies = scale > 1e-6 * np.maximum(1.0, np.abs(mean))
    mean, scale = mean[varies], scale[varies]
    size = int(varies.sum())
    upper = np.triu_indices(size)
    products = 1 + size + len(upper[0]) <= LARGEST_BASIS
    frequencies = rng.standard_normal((size, WAVES)) / np.sqrt(size)
    phases = rng.uniform(0, 2 * np.pi, WAVES)

    def basis(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = np.clip((inputs[:, varies] - mean) / scale, -5.0, 5.0)
        one = np.ones((len(inputs), 1))
        if products:
            return np.concatenate([one, scaled, scaled[:, upper[0]] * scaled[:, upper[1]]], axis=1)
        return np.concatenate([one, scaled, scaled**2, np.cos(scaled @ frequencies + phases)], axis=1)

    return basis


def _inside(
    gram: NDArray[np.float64],
    basis: Basis,
    recorded: Sequence[NDArray[np.float64]],
    chosen: Sequence[NDArray[np.float64]],
) -> float:
    """Return the share of the bundle's actions whose features lie where the recorded ones do (their leverage)."""
    size = len(gram)
    inverse = np.linalg.inv(gram + 1e-6 * np.trace(gram) / size * np.eye(size))

    def leverage(rows: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.concatenate([np.einsum("ij,jk,ik->i", phi, inverse, phi) for phi in map(basis, rows)])

    limit = float(np.quantile(leverage(recorded), 0.999))
    return float((leverage(chosen) <= 2 * limit).mean())
