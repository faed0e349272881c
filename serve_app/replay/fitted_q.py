"""Fitted Q evaluation: the value of a deterministic policy from another policy's episodes (Le, Voloshin, Yue 2019).

The value of an action in a state is a weighted sum of fixed features of both (and of the step, since episodes have a
time limit). It is fitted repeatedly by least squares to the reward plus the value of the bundle's next action, clipped
to what the remaining steps can earn. The same model is fitted to the recorded policy, whose return is known: its error
there is subtracted and added to the interval. Two sets of features are fitted, and the interval spans both. If they
disagree, miss the recorded return by much, or if the bundle's actions are unlike the recorded ones, no estimate is
given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LARGEST_BASIS = 200
WAVES = 150  # random Fourier features (Rahimi, Recht 2007), if squares and products would be too many
RIDGE = 1e-3  # relative to the features' own scale
RESAMPLES = 30
SETTLED = 1e-4  # of the values' scale: fitting ends when they change by less
MOST_ROWS = 6_000
FARTHEST = 0.05  # allowed share of the bundle's actions that are unlike recorded ones
FARTHEST_MODELS = 0.25  # of the recorded returns' deviation, between two models' estimates
FARTHEST_RETURN = 2.0  # of the recorded returns' deviation, from their mean to the estimate
WIDER = 1.5  # than the bootstrap's spread, which ignores model errors: chosen in one small simulation
LARGEST_ERROR = 4.0  # of the recorded policy's fitted return, in its standard errors

Episode = tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Rewards, observations, actions, the bundle's actions."""
Basis = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Fit:
    """The bundle's fitted return and its reliability."""

    value: float
    resampled: NDArray[np.float64]
    inside: float
    """The share of the bundle's actions that are like recorded ones."""
    doubt: str | None


def fitted_q(episodes: Sequence[Episode], gamma: float, rng: np.random.Generator) -> Fit:
    """Estimate the mean return of the policy that chose each episode's last array."""
    kept = _within(episodes, MOST_ROWS)
    lengths = np.array([len(rewards) for rewards, *_ in kept])
    longest = int(lengths.max())
    steps = np.concatenate([np.arange(length) for length in lengths])
    of_episode = np.repeat(np.arange(len(kept)), lengths)
    rewards, obs, actions, others = (np.concatenate(column).astype(np.float64) for column in zip(*kept, strict=True))
    share = (steps / longest)[:, None]
    recorded, chosen = (np.concatenate([obs, one, share], axis=1) for one in (actions, others))
    first = steps == 0
    last = np.append(first[1:], True)
    returns = np.zeros(len(kept))
    np.add.at(returns, of_episode, rewards * gamma**steps)
    known, spread = float(returns.mean()), float(returns.std())
    draws = rng.multinomial(len(kept), np.full(len(kept), 1 / len(kept)), RESAMPLES).astype(np.float64)

    values: list[float] = []
    samples: list[NDArray[np.float64]] = []
    doubts: list[str] = []
    inside = 1.0
    for products in (True, False):
        basis = _basis(recorded, rng, products=products)
        phi, other = basis(recorded), basis(chosen)
        model = _Model(phi, other, rewards, first, last, longest - 1 - steps, gamma)
        ((fitted,), (again,)) = model.values(np.ones((len(phi), 1)))
        values.append(float(known + fitted - again))
        wider = abs(again - known)  # the model's known error
        resampled = np.subtract(*model.values(draws.T[of_episode]))
        resampled += draws @ returns / len(kept)
        samples += [resampled - wider, resampled + wider]
        inside = min(inside, _inside(phi, other))
        if wider > LARGEST_ERROR * spread / np.sqrt(len(kept)):
            doubts.append(f"the fitted recorded return is {again:.4g}instead of {known:.4g}")
    value = float(np.mean(values))
    if inside < 1 - FARTHEST:
        doubts.append(f"{1 - inside:.0%} of the bundle's actions are unlike any recorded action")
    if abs(values[0] - values[1]) > FARTHEST_MODELS * spread:
        doubts.append(f"two models of the value differ: {values[0]:.4g} and {values[1]:.4g}")
    if not returns.min() <= value <= returns.max() or abs(value - known) > FARTHEST_RETURN * spread:
        doubts.append(f"the estimate {value:.4g} is far from the recorded returns, {known:.4g} +- {spread:.4g}")
    resampled = value + WIDER * (np.concatenate(samples) - value)
    return Fit(value, resampled, inside, doubts[0] if doubts else None)


@dataclass(frozen=True)
class _Model:
    """Least squares over all rows and their successors."""

    phi: NDArray[np.float64]
    other: NDArray[np.float64]
    """Features of the bundle's actions in the same rows."""
    rewards: NDArray[np.float64]
    first: NDArray[np.bool_]
    last: NDArray[np.bool_]
    left: NDArray[np.int64]
    """Number of steps that can follow a row."""
    gamma: float

    def values(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the fitted returns of the bundle and of the recorded policy, both `[samples]`.

        In each sample the rows count as often as `weights` `[rows, samples]` says.
        """
        size = self.phi.shape[1]
        inverses = np.empty((weights.shape[1], size, size))
        for inverse, counts in zip(inverses, weights.T, strict=True):
            gram = (self.phi * counts[:, None]).T @ self.phi
            inverse[:] = np.linalg.inv(gram + RIDGE * np.trace(gram) / size * np.eye(size))
        # An episode may end at any step and earn nothing afterwards.
        bounds = [extreme * self.left[:, None] for extreme in (min(self.rewards.min(), 0), max(self.rewards.max(), 0))]
        starts = weights[self.first] / weights[self.first].sum(axis=0)
        found = []
        for successors in (self.other, self.phi):
            following = np.concatenate([successors[1:], np.zeros((1, size))])
            coefficients = np.zeros((size, weights.shape[1]))
            values = np.full(weights.shape[1], np.inf)
            moving = np.arange(weights.shape[1])  # the samples whose values still change
            for _ in range(int(self.left.max()) + 1):
                to_come = np.clip(following @ coefficients[:, moving], *bounds)
                targets = self.rewards[:, None] + self.gamma * np.where(self.last[:, None], 0.0, to_come)
                sums = self.phi.T @ (weights[:, moving] * targets)
                coefficients[:, moving] = np.matmul(inverses[moving], sums.T[:, :, None])[:, :, 0].T
                before = values[moving]
                beginnings = successors[self.first] @ coefficients[:, moving]
                values[moving] = (starts[:, moving] * beginnings).sum(axis=0)
                now = values[moving]
                moving = moving[np.abs(now - before) > SETTLED * np.maximum(np.abs(now), 1e-9)]
                if not moving.size:
                    break
            found.append(values)
        return found[0], found[1]


def _within(episodes: Sequence[Episode], rows: int) -> list[Episode]:
    """Return the newest episodes with at most this number of rows in total, but at least one episode."""
    kept: list[Episode] = []
    total = 0
    for episode in reversed(episodes):
        total += len(episode[0])
        if kept and total > rows:
            break
        kept.append(episode)
    return kept


def _basis(rows: NDArray[np.float64], rng: np.random.Generator, *, products: bool) -> Basis:
    """Return features of state, action and step: squares and products if few enough, else random waves."""
    mean, scale = rows.mean(axis=0), rows.std(axis=0)
    varies = scale > 1e-6 * np.maximum(1.0, np.abs(mean))
    mean, scale = mean[varies], scale[varies]
    size = int(varies.sum())
    upper = np.triu_indices(size)
    products = products and 1 + size + len(upper[0]) <= LARGEST_BASIS
    frequencies = rng.standard_normal((size, WAVES)) / np.sqrt(size)
    phases = rng.uniform(0, 2 * np.pi, WAVES)

    def basis(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = np.clip((inputs[:, varies] - mean) / scale, -5.0, 5.0)
        one = np.ones((len(inputs), 1))
        if products:
            return np.concatenate([one, scaled, scaled[:, upper[0]] * scaled[:, upper[1]]], axis=1)
        return np.concatenate([one, scaled, np.cos(scaled @ frequencies + phases)], axis=1)

    return basis


def _inside(phi: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the share of the bundle's actions whose features lie among the recorded ones (their leverage)."""
    size = phi.shape[1]
    gram = phi.T @ phi
    inverse = np.linalg.inv(gram + 1e-6 * np.trace(gram) / size * np.eye(size))
    recorded, chosen = (np.einsum("ij,ij->i", rows @ inverse, rows) for rows in (phi, other))
    return float((chosen <= 2 * np.quantile(recorded, 0.999)).mean())
