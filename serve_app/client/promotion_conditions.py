"""Conditions against a promotion, `error_rate>0.1% or latency_p99>20ms`: their language, and their figures.

A figure is an estimate with its interval. The interval says when to stop early: a version is rolled back while it is
watched only when all of the interval is beyond the condition's limit, and three cases at least are. The estimate says
how it ends, and only when there is enough to judge.

Sources: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927); R. G.
Newcombe, "Interval estimation for the difference between independent proportions", Statistics in Medicine 17 (1998),
method 10.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rlservo.export.contract.errors import UsageError

Z = 3.0  # standard deviations of every interval, 99.7%: it is looked at often, and each look may err
FEWEST = 3  # cases before anything stops early
FEWEST_DIFFERENCES = 30  # for the mean of differences, whose interval takes them for normally distributed
CLIENTS_OWN = frozenset(  # failures that say nothing of the version that was asked
    {
        *("bad-request", "wrong-media-type", "too-large", "unauthenticated", "forbidden", "rate-limited", "idle"),
        *("bad-observation", "session-conflict", "session-lost", "late", "over-capacity", "deadline-passed"),
        "unavailable",
    }
)
UNITS = {"%": 0.01, "us": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0}
KNOWN = {  # by name: units, whether a quantile must be named, may be (None) or must not be
    "error_rate": (("%",), False),
    "latency": (("ms", "us", "s"), True),
    "action_difference": (("",), None),
    "success_drop": (("%",), False),
}
NAMES = "error_rate [%], latency_p50 to latency_p999 [ms], action_difference, action_difference_p99, success_drop [%]"
PATTERN = re.compile(
    r"(?P<name>[a-z_]+?)(?:_p(?P<quantile>[0-9]{1,5}))?\s*(?P<operator>[<>=!]+)\s*"
    r"(?P<number>[0-9]+(?:\.[0-9]+)?(?:e-?[0-9]{1,2})?)\s*(?P<unit>[a-z%]*)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Condition:
    """One condition: the version stays out where its figure is above `limit`."""

    text: str
    name: str
    limit: float  # as a fraction, in seconds, or in the action's own units
    quantile: float | None = None  # 0.99 of `_p99`
    is_inclusive: bool = False  # '>='

    def is_beyond(self, value: float) -> bool:
        """Whether a value meets the condition."""
        return value > self.limit or (self.is_inclusive and value == self.limit)


@dataclass(frozen=True)
class Figure:
    """What a condition's quantity is, as far as it was counted."""

    condition: Condition
    value: float | None
    low: float | None
    high: float | None
    count: int  # what it was counted of
    needed: int  # of those, to judge in the end
    what: str  # ... of which these are so many
    is_beyond: bool
    """Whether the estimate meets the condition."""
    is_certain: bool
    """Whether all of the interval does, by cases enough."""

    @property
    def is_enough(self) -> bool:
        return self.count >= self.needed

    def sentence(self) -> str:
        """Say the figure with its interval."""
        text, unit = self.condition.text, self.condition.name
        if self.value is None:
            return f"{text}: {self.what}"
        low, high = (_shown(unit, bound) for bound in (self.low, self.high))
        return f"{text}: it is {_shown(unit, self.value)} (99.7% interval {low} to {high}; {self.what})"


@dataclass
class Tally:
    """What was counted of a version, over all replicas."""

    latency: list[float] = field(default_factory=list)  # requests by how long they took
    failed: dict[str, float] = field(default_factory=dict)
    ends: tuple[float, float] = (0.0, 0.0)  # episodes that ended in success, and otherwise

    @property
    def answered(self) -> int:
        return int(sum(self.latency))

    @property
    def faults(self) -> dict[str, int]:
        """Failures that are the version's own, by code."""
        return {code: int(count) for code, count in sorted(self.failed.items()) if code not in CLIENTS_OWN and count}

    @property
    def asked(self) -> int:
        """Requests that reached the version."""
        return self.answered + sum(self.faults.values())


@dataclass
class Comparison:
    """How a shadow's actions differ from those that were sent, over all replicas."""

    differences: list[float] = field(default_factory=list)
    total: float = 0.0
    squares: float = 0.0
    failed: float = 0.0
    left_out: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """All that is known when a version is judged."""

    candidate: Tally
    production: Tally
    comparison: Comparison
    latency_bounds: Sequence[float]  # [s]
    difference_bounds: Sequence[float]


def parse_conditions(text: str) -> tuple[Condition, ...]:
    """Return the conditions of `name>number unit or ...`. Raises UsageError, which names what is known."""
    parts = re.split(r"\s+or\s+|\s*\|\|\s*", text.strip(), flags=re.IGNORECASE)
    return tuple(_parse(part.strip(), text) for part in parts)


def _parse(part: str, text: str) -> Condition:
    match = PATTERN.fullmatch(part)
    if match is None:
        raise UsageError(
            f"--unless {text[:200]!r}: {part[:80]!r} is no condition: expected a name, '>', a number and its unit, "
            f"joined by 'or', such as 'error_rate>0.1% or latency_p99>20ms'; known are {NAMES}"
        )
    name, digits, unit = match["name"].lower(), match["quantile"], match["unit"].lower()
    if name not in KNOWN:
        raise UsageError(f"--unless: no quantity is called {part[: match.end('name')][:80]!r}: known are {NAMES}")
    units, has_quantile = KNOWN[name]
    if has_quantile is not None and has_quantile != (digits is not None):
        expected = f"which share of the requests, such as {name}_p99" if has_quantile else f"{name} alone"
        raise UsageError(f"--unless: {part!r}: expected {expected}; known are {NAMES}")
    if match["operator"] not in (">", ">="):
        raise UsageError(f"--unless: {part!r}: a condition says what is too much, with '>' or '>='")
    if unit not in units:
        wanted = " or ".join(units) if units != ("",) else "no unit: it is in the action's own"
        raise UsageError(f"--unless: {part!r}: expected {wanted} after the number")
    quantile = None if digits is None else int(digits) / 10 ** len(digits)
    if quantile is not None and not 0 < quantile < 1:
        raise UsageError(f"--unless: {part!r}: expected a share such as p50, p95, p99 or p999")
    limit = float(match["number"]) * UNITS[unit]
    if unit == "%" and limit >= 1:
        raise UsageError(f"--unless: {part!r}: nothing is above 100%")
    return Condition(part, name, limit, quantile, match["operator"] == ">=")


def check_limits(conditions: Sequence[Condition], evidence: Evidence) -> None:
    """Raise UsageError for a limit that the server's histograms cannot tell from others."""
    for condition in conditions:
        if condition.quantile is None:
            continue
        is_latency = condition.name == "latency"
        largest = (evidence.latency_bounds if is_latency else evidence.difference_bounds)[-1]
        if condition.limit > largest:
            unit = " s" if is_latency else ""
            raise UsageError(f"--unless: {condition.text!r}: the server tells values apart up to {largest:g}{unit}")


def judge(condition: Condition, evidence: Evidence, *, min_requests: int, min_episodes: int) -> Figure:
    """Return a condition's figure."""
    if condition.name == "error_rate":
        return _error_rate(condition, evidence.candidate, min_requests)
    if condition.name == "success_drop":
        return _success_drop(condition, evidence, min_episodes)
    if condition.name == "latency":
        counts = evidence.candidate.latency
        return _quantile_figure(condition, counts, evidence.latency_bounds, min_requests, "requests")
    return _difference(condition, evidence, min_requests)


def _error_rate(condition: Condition, tally: Tally, min_requests: int) -> Figure:
    faults, asked = tally.faults, tally.asked
    failed = sum(faults.values())
    # Of fewer requests than this a version at the limit fails none, more often than not.
    needed = max(min_requests, math.ceil(1 / condition.limit) if condition.limit else 0)
    what = f"{failed:,} of {asked:,} requests failed"
    if faults:
        what += " by " + ", ".join(f"{code} {count:,}" for code, count in faults.items())
    if not asked:
        return Figure(condition, None, None, None, 0, needed, "no request", is_beyond=False, is_certain=False)
    low, high = wilson(failed, asked)
    rate = failed / asked
    certain = failed >= FEWEST and condition.is_beyond(low)
    return Figure(condition, rate, low, high, asked, needed, what, condition.is_beyond(rate), certain)


def _success_drop(condition: Condition, evidence: Evidence, min_episodes: int) -> Figure:
    (won, lost), (new_won, new_lost) = evidence.production.ends, evidence.candidate.ends
    before, after = int(won + lost), int(new_won + new_lost)
    what = f"{int(new_won):,} of {after:,} episodes succeeded, {int(won):,} of {before:,} in production"
    fewer = min(before, after)
    if not fewer:
        return Figure(condition, None, None, None, 0, min_episodes, what, is_beyond=False, is_certain=False)
    drop, low, high = newcombe(won, before, new_won, after)
    certain = fewer >= FEWEST and condition.is_beyond(low)
    return Figure(condition, drop, low, high, fewer, min_episodes, what, condition.is_beyond(drop), certain)


def _difference(condition: Condition, evidence: Evidence, min_requests: int) -> Figure:
    comparison = evidence.comparison
    counts, failed = comparison.differences, int(comparison.failed)
    compared = int(sum(counts))
    if condition.quantile is not None:
        # An action that the candidate could not compute differs by more than any limit.
        counts = [*counts[:-1], counts[-1] + failed] if counts else [0.0] * len(evidence.difference_bounds) + [failed]
        return _quantile_figure(condition, counts, evidence.difference_bounds, min_requests, "actions compared")
    what = f"{compared:,} actions compared"
    what += f", {failed:,} that it could not compute" if failed else ""
    what += f", {int(comparison.left_out):,} left out" if comparison.left_out else ""
    certain = failed >= FEWEST
    if not compared:
        return Figure(condition, None, None, None, 0, min_requests, what, is_beyond=certain, is_certain=certain)
    mean = comparison.total / compared
    deviation = math.sqrt(max(comparison.squares / compared - mean**2, 0.0))
    width = Z * deviation / math.sqrt(compared)
    low, high = max(mean - width, 0.0), mean + width
    certain = certain or (compared >= FEWEST_DIFFERENCES and condition.is_beyond(low))
    return Figure(
        condition, mean, low, high, compared, min_requests, what, certain or condition.is_beyond(mean), certain
    )


def _quantile_figure(
    condition: Condition, counts: Sequence[float], bounds: Sequence[float], least: int, of_what: str
) -> Figure:
    assert condition.quantile is not None
    share = condition.quantile
    total = int(sum(counts))
    needed = max(least, math.ceil(1 / (1 - share) - 1e-6))
    if not total:
        what = f"no {of_what}"
        return Figure(condition, None, None, None, 0, needed, what, is_beyond=False, is_certain=False)
    width = Z * math.sqrt(share * (1 - share) / total)
    value, low, high = (quantile(counts, bounds, each) for each in (share, share - width, share + width))
    # Those of the bucket that the limit is in may be below it.
    slower = int(sum(count for count, least in zip(counts, (0.0, *bounds), strict=True) if least >= condition.limit))
    certain = slower >= FEWEST and wilson(slower, total)[0] > 1 - share
    what = f"{total:,} {of_what}, {slower:,} of them surely above the limit"
    return Figure(condition, value, low, high, total, needed, what, condition.is_beyond(value), certain)


def wilson(successes: float, trials: float, z: float = Z) -> tuple[float, float]:
    """Return Wilson's score interval of a proportion."""
    share = successes / trials
    centre = (successes + z * z / 2) / (trials + z * z)
    width = z / (trials + z * z) * math.sqrt(trials * share * (1 - share) + z * z / 4)
    low = max(centre - width, 0.0) if successes else 0.0  # exactly: the difference leaves 1e-17, which nobody reads
    return low, min(centre + width, 1.0)


def newcombe(
    first: float, first_of: float, second: float, second_of: float, z: float = Z
) -> tuple[float, float, float]:
    """Return (first proportion less the second, the interval's lower bound, its upper one)."""
    p, q = first / first_of, second / second_of
    (p_low, p_high), (q_low, q_high) = wilson(first, first_of, z), wilson(second, second_of, z)
    difference = p - q
    low = difference - math.hypot(p - p_low, q_high - q)
    return difference, low, difference + math.hypot(p_high - p, q - q_low)


def quantile(counts: Sequence[float], bounds: Sequence[float], share: float) -> float:
    """Return a quantile of a histogram, evenly spread within its buckets, as Prometheus' `histogram_quantile` does."""
    wanted, below, lower = min(max(share, 0.0), 1.0) * sum(counts), 0.0, 0.0
    for count, upper in zip(counts, (*bounds, math.inf), strict=True):
        if count and below + count >= wanted:
            return upper if math.isinf(upper) else lower + (upper - lower) * (wanted - below) / count
        below, lower = below + count, upper
    return math.inf


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "unknown"
    if name == "latency":
        return f"{value * 1e3:.3g} ms" if math.isfinite(value) else "more than the server tells apart"
    return f"{value * 100:.3g}%" if name in ("error_rate", "success_drop") else f"{value:.3g}"


def document(figure: Figure) -> Mapping[str, object]:
    """Return a figure as the log has it; what is infinite has no number in JSON."""
    numbers = {"value": figure.value, "low": figure.low, "high": figure.high}
    return {
        "condition": figure.condition.text,
        **{name: value if value is None or math.isfinite(value) else None for name, value in numbers.items()},
        "count": figure.count,
        "needed": figure.needed,
        "what": figure.what,
        "beyond": figure.is_beyond,
        "certain": figure.is_certain,
    }
