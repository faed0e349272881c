"""Limits of a promotion: the share of requests, actions or episodes that may count against a version.

Each is such a share: of failed requests, of requests slower than a p99 (1%), of actions further apart (1%), of episodes
without success (production's share and the drop). While a version is watched it is rolled back when the share is surely
too large: the lower bound of its 99.7% interval is, by three cases at least. In the end the share itself decides.

Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from rlservo.serve_app.client.promotion_counts import (
    ANSWERS,
    DIFFERENCES,
    ENDS,
    MISSED,
    OUTCOMES,
    Numbers,
    buckets,
    group,
)

Z = 3.0  # standard deviations of every interval, 99.7%: it is looked at often, and each look may err
FEWEST = 3  # cases against a version before anything stops early
TAIL = 0.01  # of the requests and actions, what a p99 leaves out
CLIENTS_OWN = frozenset(  # failures that are not the version's fault
    {
        *("bad-request", "wrong-media-type", "too-large", "unauthenticated", "forbidden", "rate-limited", "idle"),
        *("bad-observation", "session-conflict", "session-lost", "late", "over-capacity", "deadline-passed"),
        "unavailable",
    }
)


@dataclass(frozen=True)
class Limits:
    """Limits of one promotion; None for no limit."""

    error_rate: float | None = None
    p99_s: float | None = None
    action_difference: float | None = None
    success_drop: float | None = None
    min_requests: int = 100
    min_episodes: int = 20


@dataclass(frozen=True)
class Figure:
    """Cases that count against a version, of all of their kind."""

    what: str
    against: float
    cases: float
    allowed: float  # share of the cases
    lacks: str = ""  # missing cases for a decision
    surely: float = 0.0  # share that is surely too large, if that is more than `allowed`

    @property
    def is_beyond(self) -> bool:
        """Whether the share is too large."""
        return self.against > self.allowed * self.cases

    @property
    def is_surely_beyond(self) -> bool:
        """Whether the share is too large even by its interval's lower bound."""
        low, _ = interval(self.against, self.cases)
        return self.against >= FEWEST and low > max(self.allowed, self.surely)

    def __str__(self) -> str:
        share = f", {100 * self.against / self.cases:.3g}%" if self.cases else ""
        return (
            f"{self.what}: {self.against:,.0f} of {self.cases:,.0f}{share} (allowed {100 * self.allowed:.3g}%"
            f"{', ' * bool(self.lacks)}{self.lacks})"
        )


def figures(limits: Limits, total: Numbers, production: str, candidate: str) -> Iterator[Figure]:
    """Yield a figure for every limit."""

    def of_requests(what: str, against: float, cases: float, allowed: float) -> Figure:
        # With fewer a version at its limit has no case against it, more often than not.
        needed = max(limits.min_requests, math.ceil(1 / allowed) if allowed else 0)
        return Figure(what, against, cases, allowed, "" if cases >= needed else f"{needed:,} needed")

    if limits.error_rate is not None:
        outcomes = group(total, OUTCOMES, candidate)
        faults = {code for code, count in outcomes.items() if count} - CLIENTS_OWN - {"ok"}
        failed = sum(outcomes[code] for code in faults)
        what = f"failed requests ({', '.join(sorted(faults))})" if faults else "failed requests"
        yield of_requests(what, failed, outcomes.get("ok", 0.0) + failed, limits.error_rate)
    if limits.p99_s is not None:
        bound, slower, cases = _beyond(total, limits.p99_s, ANSWERS, candidate)
        yield of_requests(f"requests above {1e3 * bound:g} ms", slower, cases, TAIL)
    if limits.action_difference is not None:
        bound, apart, cases = _beyond(total, limits.action_difference, DIFFERENCES, production, candidate)
        missed = group(total, MISSED, production, candidate).get("failed", 0.0)  # further apart than any limit
        yield of_requests(f"actions more than {bound:g} apart", apart + missed, cases + missed, TAIL)
    if limits.success_drop is not None:
        (before, ends), (lost, cases) = _unsuccessful(total, production), _unsuccessful(total, candidate)
        what = f"episodes without success (in production {before:,.0f} of {ends:,.0f})"
        lacks = "" if min(cases, ends) >= limits.min_episodes else f"{limits.min_episodes:,} of each version needed"
        share, high = before / max(ends, 1.0), interval(before, ends)[1]
        yield Figure(what, lost, cases, share + limits.success_drop, lacks, surely=high + limits.success_drop)


def interval(against: float, cases: float) -> tuple[float, float]:
    """Return Wilson's score interval of a share."""
    if not cases:
        return 0.0, 1.0
    share, square = against / cases, Z * Z / cases
    centre, width = share + square / 2, Z * math.sqrt(share * (1 - share) / cases + square / (4 * cases))
    return (centre - width) / (1 + square), (centre + width) / (1 + square)


def _unsuccessful(total: Numbers, version: str) -> tuple[float, float]:
    ends = group(total, ENDS, version)
    return sum(ends.values()) - ends.get("success", 0.0), sum(ends.values())


def _beyond(total: Numbers, limit: float, *path: str) -> tuple[float, float, float]:
    """Return (bound, cases above it, all cases) of a histogram: its largest bound within the limit."""
    counted = buckets(total, *path)
    bound, within = max((each for each in counted if each[0] <= limit), default=(0.0 if counted else limit, 0.0))
    return bound, (counted[-1][1] if counted else 0.0) - within, counted[-1][1] if counted else 0.0
