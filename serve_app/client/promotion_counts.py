"""Counts of a promotion: growth of the servers' metrics of a policy since it began.

A process counts from its own start. Its increments between two checks are summed; one that disappears
keeps what it had, and one that is new counts from its first look. Counters never fall: metrics that do are not trusted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from prometheus_client.parser import text_string_to_metric_families

from rlservo.export.contract.errors import UnavailableError

ANSWERS, OUTCOMES, ENDS = "rlservo_request_seconds_bucket", "rlservo_requests_total", "rlservo_episode_ends_total"
DIFFERENCES, MISSED = "rlservo_shadow_difference_bucket", "rlservo_shadow_missed_total"
COUNTED = {  # the labels that distinguish a policy's series; those of other labels are summed
    ANSWERS: ("version", "le"),
    OUTCOMES: ("version", "code"),
    ENDS: ("version", "outcome"),
    DIFFERENCES: ("version", "shadow", "le"),
    MISSED: ("version", "shadow", "reason"),
}
Numbers = dict[str, float]  # by "name/label/..."


class UntrustedError(Exception):
    """The metrics contradict themselves or an earlier reading."""


@dataclass
class Process:
    """One process of a server, as its metrics show it."""

    plan: float = 0  # number of the plan that it follows
    versions: set[str] = field(default_factory=set)  # of the policy, loaded
    numbers: Numbers = field(default_factory=dict)


def read_metrics(text: str, policy: str) -> dict[str, Process]:
    """Return the processes in a text for Prometheus, by name. Raises UntrustedError, and UnavailableError for none."""
    processes: dict[str, Process] = {}
    try:
        for family in text_string_to_metric_families(text):
            for name, labels, value, *_ in family.samples:
                process = Process() if (replica := labels.get("replica", "")) not in processes else processes[replica]
                if name == "rlservo_plan_generation":
                    process.plan = value
                elif name == "rlservo_policy_loaded" and labels["policy"] == policy:
                    process.versions.add(labels["version"])
                elif name in COUNTED and labels["policy"] == policy:
                    if not 0 <= value < math.inf:
                        raise UntrustedError(f"replica '{replica}' has {value} for {name} {labels}")
                    path = "/".join((name, *(labels[label] for label in COUNTED[name])))
                    process.numbers[path] = process.numbers.get(path, 0.0) + value
                else:
                    continue
                processes[replica] = process
    except (ValueError, KeyError) as error:
        raise UntrustedError(f"the metrics cannot be read: {error!r}") from None
    if not processes:
        raise UnavailableError(f"the metrics have no series of policy '{policy}'")
    for replica, process in processes.items():
        for version in process.versions:
            counts = [count for _, count in buckets(process.numbers, ANSWERS, version)]
            answered = process.numbers.get(f"{OUTCOMES}/{version}/ok", 0.0)
            if counts != sorted(counts) or answered > max(counts, default=0.0):
                raise UntrustedError(f"replica '{replica}' reports contradictory counts for version {version}")
    return processes


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

    total: Numbers = field(default_factory=dict)
    seen: dict[str, Numbers] = field(default_factory=dict)
    """Each process's numbers at its last reading."""

    def add(self, processes: Mapping[str, Process]) -> None:
        """Add the counts since the last reading. Raises UntrustedError."""
        for name, process in processes.items():
            now = process.numbers
            before = self.seen.get(name, now)
            for path in {**before, **now}:
                grown = now.get(path, 0.0) - before.get(path, 0.0)
                if grown < 0:
                    raise UntrustedError(f"{path} of replica '{name}' fell by {-grown:g}: was its server restarted?")
                self.total[path] = self.total.get(path, 0.0) + grown
            self.seen[name] = now
