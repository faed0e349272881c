"""Estimate of a bundle's return from recordings of another policy, before it drives anything.

Episodes of actions that explored, with known log-probabilities, are weighted by how much likelier the bundle makes them
(per-decision importance sampling: Precup, Sutton, Singh 2000). Each estimate states whether the recordings can support
it, and if not, why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import leaf_specs
from rlservo.errors import UsageError
from rlservo.recording.reader import Recording
from rlservo.recording.replay.follower import FollowedEpisode, Follower

LARGEST = 5_000_000  # numbers in one episodes-by-steps matrix
RESAMPLES = 1000
CONFIDENCE = 0.95
FEWEST_EPISODES = 600  # with 400, an ending of six in a thousand is too often missing
SMALLEST_SHARE = 0.5  # of effective episodes; below it the intervals miss the truth too often


@dataclass(frozen=True)
class Estimate:
    """One estimate of the bundle's mean return."""

    method: str
    value: float
    interval: tuple[float, float]
    effective_samples: float
    """Number of the bundle's own episodes that would hold as much information."""
    supported: bool
    reason: str
    """Reason why the interval is valid, or why the recordings cannot support it."""


@dataclass
class EstimateReport:
    """Estimate of a bundle's return from recordings."""

    bundle: str
    target: str
    """The bundle's policy: 'deterministic', as served by default, or 'exploring'."""
    policies: list[str] = field(default_factory=list)
    gamma: float = 1.0
    episodes: int = 0
    recorded_return: float | None = None
    """Mean over the used episodes, of all recorded versions together."""
    recorded_by_policy: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Used episodes and their mean return, by recorded policy and version."""
    recorded_interval: tuple[float, float] | None = None
    not_used: dict[str, int] = field(default_factory=dict)
    """Unusable episodes, by reason."""
    estimates: list[Estimate] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


@dataclass(frozen=True)
class Trajectory:
    """One episode in the form that an estimate needs."""

    rewards: NDArray[np.float64]
    log_weights: NDArray[np.float64] | None
    """Log of each action's probability ratio under the bundle; None if unknown."""


def estimate(
    recording: Recording,
    bundle: str | Path,
    *,
    explore: bool = False,
    gamma: float = 1.0,
    name: str | None = None,
    seed: int = 0,
    progress: Callable[[str], object] = lambda _: None,
) -> EstimateReport:
    """Estimate the mean return of a bundle's deterministic policy, or with `explore` of its exploratory policy.

    `progress` gets the current activity. Raises OtherContractError if the recording does not fit the bundle, and
    UsageError if no episode can be used.
    """
    if not 0 < gamma <= 1:
        raise UsageError(f"gamma must be above 0 and at most 1, got {gamma:g}")
    follower = Follower(bundle)
    contract = follower.contract
    if explore and contract.distribution is None:
        raise UsageError(f"policy '{contract.name}' has no action distribution and cannot explore")
    report = EstimateReport(
        f"{contract.name}/{contract.version}", "exploring" if explore else "deterministic", gamma=gamma
    )
    trajectories: list[Trajectory] = []
    titles: list[str] = []  # of the trajectories' policies
    for count, followed in enumerate(follower.follow(recording, name), 1):
        progress(f"{count} episodes read")
        if followed.episode.policy.title not in report.policies:
            report.policies.append(followed.episode.policy.title)
        reason = _why_not(followed)
        if reason is None:
            trajectories.append(_trajectory(followed, contract, explore))
            titles.append(followed.episode.policy.title)
        else:
            report.not_used[reason] = report.not_used.get(reason, 0) + 1
    if not trajectories:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report.not_used.items()) or "there are none"
        raise UsageError(f"no recorded episode can be used: {reasons}")
    longest = max(len(one.rewards) for one in trajectories)
    if longest * len(trajectories) > LARGEST:
        kept = max(1, LARGEST // longest)
        report.not_used["too large for the memory"] = len(trajectories) - kept
        trajectories, titles = trajectories[-kept:], titles[-kept:]
    rng = np.random.default_rng(seed)
    returns = np.array([_discounted(one.rewards, gamma) for one in trajectories])
    report.episodes = len(trajectories)
    report.recorded_return = float(returns.mean())
    for title in dict.fromkeys(titles):
        own = returns[[each == title for each in titles]]
        report.recorded_by_policy[title] = len(own), float(own.mean())
    report.recorded_interval = _interval(_resampled_means(returns, rng))
    if any(one.log_weights is None for one in trajectories):
        raise UsageError(
            "a return can be estimated only if every recorded action explored and has its log-probability, which "
            f"{contract.name}'s do not: record with --explore"
            if explore or _is_discrete(contract)
            else f"a single action of {contract.name}'s continuous ones has no probability: estimate its exploring "
            "policy with --explore, or simulate the deterministic one with `rlservo rollout`"
        )
    report.estimates += importance_sampling(trajectories, gamma, rng)
    return report


def importance_sampling(trajectories: list[Trajectory], gamma: float, rng: np.random.Generator) -> list[Estimate]:
    """Return per-decision importance sampling's estimates, the weighted form first."""
    longest = max(len(one.rewards) for one in trajectories)
    weights = np.zeros((len(trajectories), longest))
    earned = np.zeros((len(trajectories), longest))
    discounts = gamma ** np.arange(longest)
    for row, one in enumerate(trajectories):
        assert one.log_weights is not None
        steps = len(one.rewards)
        total = np.cumsum(one.log_weights)
        weights[row, :steps] = np.exp(np.minimum(total, 700.0))
        weights[row, steps:] = weights[row, steps - 1]  # the episode is over: it keeps its final weight
        earned[row, :steps] = one.rewards
    discounted = weights * earned * discounts
    final = weights[:, -1]
    squares = float((final**2).sum())
    effective = float(final.sum()) ** 2 / squares if squares > 0 else 0.0

    # The worst and the best episode are drawn twice as often: an ending that occurred k times then occurs k + 1 times
    # on average, whose upper quantile is about the exact limit (Clopper, Pearson 1934). A bootstrap's is too low.
    chances = np.ones(len(trajectories))
    returns = earned.sum(axis=1)
    chances[[int(np.argmin(returns)), int(np.argmax(returns))]] = 2
    counts = rng.multinomial(len(trajectories), chances / chances.sum(), RESAMPLES)
    numerators, denominators = counts @ discounted, counts @ weights
    with np.errstate(invalid="ignore", divide="ignore"):
        resampled = np.nan_to_num(numerators / denominators).sum(axis=1)
        weighted = float(np.nan_to_num(discounted.sum(axis=0) / weights.sum(axis=0)).sum())
    plain = discounted.sum(axis=1)
    # A few heavy weights make a bootstrap overconfident: widened by this measured factor, it covers the truth.
    wider = float(np.sqrt(len(trajectories) / effective)) if effective > 0 else 1.0
    supported, reason = _support(len(trajectories), effective)
    return [
        Estimate(
            "weighted per-decision importance sampling",
            weighted,
            _interval(weighted + wider * (resampled - weighted)),
            effective,
            supported,
            reason,
        ),
        Estimate(
            "per-decision importance sampling",
            float(plain.mean()),
            _interval(plain.mean() + wider * (counts @ plain / counts.sum(axis=1) - plain.mean())),
            effective,
            supported,
            reason,
        ),
    ]


def _support(episodes: int, effective: float) -> tuple[bool, str]:
    if episodes < FEWEST_EPISODES:
        return False, f"{episodes} episodes are too few: at least {FEWEST_EPISODES} are needed"
    if effective < SMALLEST_SHARE * episodes:
        return False, (
            f"the bundle acts too differently from the recorded policy: {episodes} episodes are worth as much as "
            f"{effective:.1f} of its own, and {SMALLEST_SHARE * episodes:.0f} are needed"
        )
    return True, (
        f"{episodes} episodes are worth as much as {effective:.0f} of the bundle's own; events in fewer than one "
        f"of {max(1, episodes // 3)} may be missing"
    )


def _why_not(followed: FollowedEpisode) -> str | None:
    episode = followed.episode
    if not episode.begins or not episode.id or episode.goes_on or episode.gap is not None:
        return "incomplete"
    if not episode.ended:
        return "without an end"
    if not np.isfinite(episode.reward).all():
        return "without every reward"
    if episode.fell_back.any() or not episode.acted.all():
        return "with fallback actions"
    return None if followed.known.all() else "in which the bundle's action is unsafe"


def _trajectory(followed: FollowedEpisode, contract: Contract, explore: bool) -> Trajectory:
    episode = followed.episode
    return Trajectory(episode.reward, _log_weights(followed, contract, explore))


def _log_weights(followed: FollowedEpisode, contract: Contract, explore: bool) -> NDArray[np.float64] | None:
    """Return the log of each action's probability ratio: under the bundle over under the recorded policy."""
    episode = followed.episode
    if not np.isfinite(episode.logp).all():
        return None
    if explore:
        assert followed.inputs is not None
        likelier = episode.policy.log_probability(followed.inputs, episode.own_action)
        return None if likelier is None else likelier - episode.logp
    if not _is_discrete(contract):
        return None
    same = np.ones(len(episode), np.bool_)
    for name, leaf in followed.action.items():
        same &= (leaf == episode.action[name]).reshape(len(episode), -1).all(axis=1)
    return np.where(same, 0.0, -np.inf) - episode.logp


def _is_discrete(contract: Contract) -> bool:
    """Return whether a single action has a probability, which it has not in a continuum."""
    return all(leaf.kind != "box" for leaf in leaf_specs(contract.action_space, "action").values())


def _discounted(rewards: NDArray[np.float64], gamma: float) -> float:
    return float((rewards * gamma ** np.arange(len(rewards))).sum())


def _resampled_means(values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    counts = rng.multinomial(len(values), np.full(len(values), 1 / len(values)), RESAMPLES)
    return np.asarray(counts @ values / len(values))


def _interval(resampled: Iterable[float]) -> tuple[float, float]:
    """Return the percentile bootstrap interval (Efron, Tibshirani 1993)."""
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(np.fromiter(resampled, np.float64), (tail, 100 - tail))
    return float(low), float(high)
