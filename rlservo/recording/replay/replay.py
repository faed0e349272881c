"""Replay: differences between recorded actions and a bundle's actions on the same observations."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import UsageError
from rlservo.recording.reader import Recording
from rlservo.recording.replay.follower import FollowedEpisode, Follower

WORST_MOMENTS = 10


@dataclass
class ElementDifference:
    """Differences of one action element, over all compared decisions."""

    name: str
    unit: str
    changed: int = 0
    """Decisions that differ by more than the tolerance."""
    largest: float = 0.0
    mean: float = 0.0
    """Largest and mean absolute difference."""


@dataclass(frozen=True)
class Moment:
    """One of the largest differences, ranked relative to the element's range, if it has one."""

    time_s: float
    episode: str
    step: int
    element: str
    recorded: float
    replayed: float


@dataclass
class ReplayReport:
    """Result of a replay."""

    bundle: str
    policies: list[str] = field(default_factory=list)
    """The recorded policies, `name/version`."""
    same_graph: bool | None = None
    """Whether the recorded graph is the bundle's; None if a recording does not name it."""
    tolerance: float = 0.0
    episodes: int = 0
    decisions: int = 0
    compared: int = 0
    identical: int = 0
    """Decisions whose action (or whose distribution, if it explored) is the same bit for bit."""
    changed: int = 0
    """Decisions with an element beyond the tolerance."""
    explored: int = 0
    """Compared decisions that explored: their distributions' parameters were compared, not the draws."""
    largest_distribution_difference: float = 0.0
    unsafe: int = 0
    """Decisions for which the bundle's action is outside its space."""
    not_compared: int = 0
    """Decisions without an action, after a gap if the policy is recurrent, or explored with nothing to compare."""
    other_policies: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    """Records that the recorder had to drop."""
    elements: list[ElementDifference] = field(default_factory=list)
    worst: list[Moment] = field(default_factory=list)
    golden_atol: float = 0.0
    golden_rtol: float = 0.0

    @property
    def changed_share(self) -> float:
        """The share of compared decisions that would change."""
        return self.changed / self.compared if self.compared else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {**asdict(self), "changed_share": self.changed_share}


def replay(
    recording: Recording, bundle: str | Path, *, tolerance: float = 0.0, name: str | None = None
) -> ReplayReport:
    """Replay every recorded episode through a bundle and return the differences.

    `name` selects a recorded policy if there are several; by default the one with the bundle's name. Raises
    OtherContractError if the recording does not fit the bundle, and UsageError if there is nothing to compare.
    """
    if not tolerance >= 0:
        raise UsageError(f"the tolerance must be 0 or more, got {tolerance}")
    follower = Follower(bundle)
    parity = follower.contract.parity
    report = ReplayReport(
        f"{follower.contract.name}/{follower.contract.version}",
        tolerance=tolerance,
        golden_atol=parity.atol,
        golden_rtol=parity.rtol,
    )
    comparison = _Comparison(report)
    for followed in follower.follow(recording, name):
        comparison.add(followed)
        recorded = followed.episode.policy
        if recorded.title not in report.policies:
            report.policies.append(recorded.title)
        if recorded.graph_hash:
            same = recorded.graph_hash == follower.policy.graph_hash
            report.same_graph = same if report.same_graph is None else report.same_graph and same
    report.other_policies = follower.skipped
    report.dropped = sum(facts.dropped for facts in recording.files)
    if not report.decisions:
        others = ", ".join(sorted(follower.skipped)) or "none"
        raise UsageError(f"the recording has no decisions of the policy {name or follower.contract.name!r}: {others}")
    comparison.finish()
    return report


class _Comparison:
    """Sums over all episodes."""

    def __init__(self, report: ReplayReport) -> None:
        self._report = report
        self._sums: dict[str, NDArray[np.float64]] = {}
        self._changed: dict[str, NDArray[np.int64]] = {}
        self._largest: dict[str, NDArray[np.float64]] = {}
        self._compared = 0
        self._worst: list[tuple[float, int, Moment]] = []
        self._order = itertools.count()  # breaks ties, as moments cannot be compared
        self._followed: FollowedEpisode | None = None

    def add(self, followed: FollowedEpisode) -> None:
        report, episode = self._report, followed.episode
        self._followed = followed
        explored = followed.known & episode.explored
        plain = followed.known & ~episode.explored
        identical = np.ones(len(episode), np.bool_)
        changed = np.zeros(len(episode), np.bool_)
        for name, replayed in followed.action.items():
            recorded = episode.action[name]
            identical &= _same_bits(recorded, replayed)
            changed |= self._compare(name, recorded, replayed, plain, followed)
        if explored.any():
            explored &= np.isfinite(episode.logp)
            if followed.inputs is not None and explored.any():
                same, difference = _distribution_difference(episode.dist_inputs, followed.inputs)
                identical[explored] = same[explored]
                changed[explored] = difference[explored] > report.tolerance
                largest = float(difference[explored].max())
                report.largest_distribution_difference = max(report.largest_distribution_difference, largest)
            report.explored += int(explored.sum())
        compared = plain | explored
        report.episodes += int(episode.begins and bool(episode.id))
        report.decisions += len(episode)
        report.compared += int(compared.sum())
        report.identical += int((identical & compared).sum())
        report.changed += int((changed & compared).sum()) + int(followed.unsafe.sum())
        report.unsafe += int(followed.unsafe.sum())
        report.compared += int(followed.unsafe.sum())
        report.not_compared += int((~compared & ~followed.unsafe).sum())
        self._compared += int(plain.sum())

    def finish(self) -> None:
        assert self._followed is not None
        for name, space in self._followed.episode.policy.actions.leaves.items():
            labels = self._followed.episode.policy.actions.labels(name)
            for index, label in enumerate(labels):
                unit = space.elements[index].unit if index < len(space.elements) else ""
                element = ElementDifference(label, unit)
                if self._compared:
                    element.changed = int(self._changed[name][index])
                    element.largest = float(self._largest[name][index])
                    element.mean = float(self._sums[name][index]) / self._compared
                self._report.elements.append(element)
        self._report.worst = [moment for _, _, moment in sorted(self._worst, reverse=True)]

    def _compare(
        self,
        name: str,
        recorded: NDArray[Any],
        replayed: NDArray[Any],
        rows: NDArray[np.bool_],
        followed: FollowedEpisode,
    ) -> NDArray[np.bool_]:
        """Add one leaf's differences; return the rows with an element beyond the tolerance."""
        flat = recorded.reshape(len(recorded), -1).astype(np.float64)
        difference = np.abs(replayed.reshape(len(replayed), -1).astype(np.float64) - flat)
        difference[~rows] = 0.0
        beyond = difference > self._report.tolerance
        size = difference.shape[1]
        zeros = np.zeros(size)
        self._sums[name] = self._sums.get(name, zeros) + difference.sum(axis=0)
        self._changed[name] = self._changed.get(name, np.zeros(size, np.int64)) + beyond.sum(axis=0)
        self._largest[name] = np.maximum(self._largest.get(name, zeros), difference.max(axis=0, initial=0.0))
        low, high = (bound.ravel() for bound in followed.episode.policy.actions.leaves[name].bounds())
        span = np.where(np.isfinite(high - low) & (high > low), high - low, 1.0)
        self._keep_worst(name, difference / span, beyond, followed)
        return np.asarray(beyond.any(axis=1))

    def _keep_worst(
        self, name: str, scaled: NDArray[np.float64], beyond: NDArray[np.bool_], followed: FollowedEpisode
    ) -> None:
        episode = followed.episode
        worst = np.where(beyond, scaled, 0.0).max(axis=1)
        for row in np.argsort(worst)[::-1][:WORST_MOMENTS]:
            size = float(worst[row])
            if size == 0.0 or (len(self._worst) == WORST_MOMENTS and size <= self._worst[0][0]):
                return
            index = int(np.argmax(scaled[row]))
            moment = Moment(
                float(episode.time_s[row]),
                episode.id,
                int(episode.steps[row]),
                episode.policy.actions.labels(name)[index],
                float(episode.action[name].reshape(len(episode), -1)[row, index]),
                float(followed.action[name].reshape(len(episode), -1)[row, index]),
            )
            heapq.heappush(self._worst, (size, next(self._order), moment))
            if len(self._worst) > WORST_MOMENTS:
                heapq.heappop(self._worst)


def _same_bits(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the rows that are the same bit for bit."""
    rows = len(one)
    ours, theirs = (np.ascontiguousarray(array).reshape(rows, -1).view(np.uint8) for array in (one, other))
    return np.asarray((ours == theirs).all(axis=1))


def _distribution_difference(
    recorded: NDArray[np.float32], replayed: NDArray[Any]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return (mask of the equal rows, each row's largest difference); two infinities are equal."""
    same = (recorded == replayed).all(axis=1)
    with np.errstate(invalid="ignore"):
        difference = np.abs(recorded.astype(np.float64) - replayed)
    return np.asarray(same), np.nan_to_num(difference, nan=0.0).max(axis=1)
