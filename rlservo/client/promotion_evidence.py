"""Evidence of a promotion: the growth of the servers' counts of a policy since it began, against its limits.

A process counts from its own start, so its increments between two checks are summed. A process that disappears keeps
its sum, and a new one counts from its first check. Counters that fall are not trusted, nor is an old copy, in which
the uptime has not grown.

A process that died is evidence against the version on trial: its last request has no other trace. A server of several
workers counts those that did not end in order. Another process has died, or was ended, if it no longer answers or has
started again; one that joins is no evidence.

A limit is the share of requests, actions or episodes that may count against a version: failed requests, requests of any
version that waited too long (the share before plus the limit: while one is computed, all wait), requests slower than
the p99 (1%), actions further apart (1%), episodes without success (production's share plus the drop). During the watch
a version is rolled back if the lower bound of the share's 99.7% interval is above the limit, with at least three cases.
At the end the share itself decides.

Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from prometheus_client.parser import text_string_to_metric_families

from rlservo.errors import UnavailableError, UsageError

PLAN, UPTIME, LOADED = "rlservo_plan_generation", "rlservo_uptime_seconds", "rlservo_policy_loaded"
START, LOST = "rlservo_start_time_seconds", "rlservo_workers_lost_total"
ANSWERS, OUTCOMES, ENDS = "rlservo_request_seconds_bucket", "rlservo_requests_total", "rlservo_episode_ends_total"
DIFFERENCES, MISSED = "rlservo_shadow_difference_bucket", "rlservo_shadow_missed_total"
READ = {  # the labels that distinguish a policy's series; those of other labels are summed
    PLAN: (),
    UPTIME: (),
    START: (),
    LOST: (),
    LOADED: ("version",),
    ANSWERS: ("version", "le"),
    OUTCOMES: ("version", "code"),
    ENDS: ("version", "outcome"),
    DIFFERENCES: ("version", "shadow", "le"),
    MISSED: ("version", "shadow", "reason"),
}
Numbers = dict[str, float]  # by "name/label/..."


class UntrustedError(UsageError):
    """The metrics contradict themselves or an earlier check."""


def read_metrics(text: str, policy: str) -> dict[str, Numbers]:
    """Return each process's numbers in a text for Prometheus. Raises UntrustedError, and UnavailableError for none."""
    processes: dict[str, Numbers] = {}
    lines = set()
    try:
        families = text_string_to_metric_families(text)
        for name, labels, value, *_ in (sample for family in families for sample in family.samples):
            if name in READ and (name in (PLAN, UPTIME, START, LOST) or labels["policy"] == policy):
                line = (name, *sorted(labels.items()))
                if not 0 <= value < math.inf or not float(labels.get("le", 0)) >= 0 or "" in labels or line in lines:
                    raise UntrustedError(f"{name} {labels} is {value}, or appears twice")
                lines.add(line)
                numbers = processes.setdefault(labels.get("replica", ""), {})
                path = "/".join((name, *(labels[label] for label in READ[name])))
                numbers[path] = numbers.get(path, 0.0) + value
    except (ValueError, LookupError) as error:
        raise UntrustedError(f"the metrics cannot be read: {error!r}") from None
    if not processes:
        raise UnavailableError(f"the metrics have no series for policy '{policy}'")
    for replica, numbers in processes.items():
        for version in group(numbers, LOADED):
            counts = [count for _, count in buckets(numbers, ANSWERS, version)]
            answered = numbers.get(f"{OUTCOMES}/{version}/ok", 0.0)
            if counts != sorted(counts) or answered > max(counts, default=0.0):
                raise UntrustedError(f"replica '{replica}' reports contradictory counts for version {version}")
    return processes


def check_lag(processes: Mapping[str, Numbers], generation: int, version: str) -> None:
    """Raise UnavailableError if a process follows an older plan or has not loaded the version."""
    for name, numbers in processes.items():
        if has_ended(numbers):
            continue
        plan = numbers.get(PLAN, 0)
        if plan < generation:
            raise UnavailableError(f"replica '{name}' follows plan {plan:g}, not yet {generation}")
        if f"{LOADED}/{version}" not in numbers:
            raise UnavailableError(f"replica '{name}' has not loaded version {version}")


def has_ended(numbers: Mapping[str, float]) -> bool:
    """Whether these are the last counts of a worker that has ended."""
    return UPTIME not in numbers


def lost_workers(processes: Mapping[str, Numbers]) -> float | None:
    """Return how many workers of a server have died; None if it does not count them."""
    counts = [numbers[LOST] for numbers in processes.values() if LOST in numbers]
    return max(counts, default=None)


def group(numbers: Mapping[str, float], *path: str) -> Numbers:
    """Return the numbers under a path, by the label that follows it."""
    prefix = "/".join((*path, ""))
    return {key.removeprefix(prefix): count for key, count in numbers.items() if key.startswith(prefix)}


def buckets(numbers: Mapping[str, float], *path: str) -> list[tuple[float, float]]:
    """Return a histogram's (upper bound, cases up to it), the smallest bound first."""
    return sorted((float(bound), count) for bound, count in group(numbers, *path).items())


@dataclass
class Counts:
    """Sums over all processes since a promotion began."""

    total: Numbers
    seen: dict[str, Numbers]
    """Each process' own numbers when it was last seen."""

    def add(self, processes: Mapping[str, Numbers]) -> None:
        """Add what was counted since the last look. Raises UntrustedError."""
        for name, numbers in processes.items():
            now = {path: count for path, count in numbers.items() if not path.startswith((PLAN, LOADED, LOST))}
            before = self.seen.get(name, now)
            if has_ended(now):
                before = {path: count for path, count in before.items() if path not in (UPTIME, START)}
            elif name in self.seen and now[UPTIME] == before.get(UPTIME):
                raise UnavailableError(f"the metrics of replica '{name}' are still those of the last check")
            for path in {**before, **now}:
                grown = now.get(path, 0.0) - before.get(path, 0.0)
                if grown < 0:
                    raise UntrustedError(f"{path} of replica '{name}' fell by {-grown:g}: was its server restarted?")
                self.total[path] = self.total.get(path, 0.0) + grown
            self.seen[name] = now


Z = 3.0  # standard deviations of every interval, 99.7%: there are many checks, and each may err
FEWEST = 3  # cases against a version before anything stops early
TAIL = 0.01  # share of the requests and actions beyond a p99
CLIENTS_OWN = {  # failures that are not the version's fault
    *("bad-request", "wrong-media-type", "too-large", "unauthenticated", "forbidden", "rate-limited", "idle"),
    *("bad-observation", "session-conflict", "session-lost", "unavailable"),
}
LATE = ("late", "over-capacity", "deadline-passed")  # one slow version keeps the requests of every version waiting


@dataclass(frozen=True)
class PromotionLimits:
    """Limits of one promotion; None for no limit."""

    error_rate: float | None = None
    p99_s: float | None = None
    action_difference: float | None = None
    success_drop: float | None = None
    min_requests: int = 100
    min_episodes: int = 20


@dataclass(frozen=True)
class Figure:
    """Cases that speak against a version, of all of their kind."""

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


def figures(
    limits: PromotionLimits,
    total: Numbers,
    production: str,
    candidate: str,
    late_before: tuple[float, float] = (0.0, 0.0),
) -> Iterator[Figure]:
    """Yield a figure for every limit; `late_before` is `late_requests` of the time before the promotion."""

    def of_requests(what: str, against: float, cases: float, allowed: float) -> Figure:
        # With fewer, a version at its limit would more likely than not have no case against it.
        needed = max(limits.min_requests, math.ceil(1 / allowed) if allowed else 0)
        why = f" for a limit of {100 * allowed:.3g}%, whatever --min-requests" if needed > limits.min_requests else ""
        return Figure(what, against, cases, allowed, "" if cases >= needed else f"{needed:,} needed{why}")

    if limits.error_rate is not None:
        outcomes = group(total, OUTCOMES, candidate)
        faults = {code for code, count in outcomes.items() if count} - CLIENTS_OWN - {"ok", *LATE}
        failed = sum(outcomes[code] for code in faults)
        what = f"failed requests ({', '.join(sorted(faults))})" if faults else "failed requests"
        yield of_requests(what, failed, outcomes.get("ok", 0.0) + failed, limits.error_rate)
        (late, requests), before = late_requests(total), late_before[0] / max(late_before[1], 1.0)
        if late:
            high = interval(*late_before)[1] if late_before[1] else 0.0
            what = "requests of all versions that waited too long"
            allowed = before + limits.error_rate
            yield Figure(what, late, requests, allowed, surely=high + limits.error_rate)
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


def late_requests(total: Numbers) -> tuple[float, float]:
    """Return how many requests of all versions waited too long, and of how many."""
    counts: defaultdict[str, float] = defaultdict(float)
    for path, count in total.items():
        if path.startswith(f"{OUTCOMES}/"):
            counts[path.rpartition("/")[2]] += count
    late = sum(counts[code] for code in LATE)
    return late, late + counts["ok"]


def _unsuccessful(total: Numbers, version: str) -> tuple[float, float]:
    ends = group(total, ENDS, version)
    return sum(ends.values()) - ends.get("success", 0.0), sum(ends.values())


def _beyond(total: Numbers, limit: float, *path: str) -> tuple[float, float, float]:
    """Return (bound, cases above it, all cases) of a histogram: its largest bound within the limit."""
    counted = buckets(total, *path) or [(limit, 0.0)]
    (bound, within), cases = max((each for each in counted if each[0] <= limit), default=(0.0, 0.0)), counted[-1][1]
    return bound, cases - within, cases
