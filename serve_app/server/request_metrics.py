"""Prometheus counters and histograms of the requests that this replica answered.

Recording is a few additions in plain lists, from the one thread that answers: prometheus_client's own counters lock and
would cost several times as much per request. They become its families when somebody asks. Names follow Prometheus'
conventions (base units, `_total`).
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from rlservo.serve_app.versions.policy_store import Decision

IDLE = "idle"  # what a stream is closed with that was silent for too long
SECONDS = (1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0)
SUCCESS = "success"  # the final status of an episode that reached its goal, as the environments say it
BATCHES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0, 2048.0, 4096.0)


class Histogram:
    """Counts per bucket; the last one is for all that is larger."""

    __slots__ = ("bounds", "counts", "total")

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self.bounds = bounds
        self.counts = [0] * (len(bounds) + 1)
        self.total = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        self.counts[bisect_left(self.bounds, value)] += 1
        self.total += value

    def cumulative(self) -> list[tuple[str, float]]:
        """Return Prometheus' buckets: each counts all that is not larger."""
        labels = [*map(repr, self.bounds), "+Inf"]
        sums = [float(sum(self.counts[: index + 1])) for index in range(len(self.counts))]
        return list(zip(labels, sums, strict=True))


class _Series:
    """What is known of one policy's version over one protocol."""

    __slots__ = ("batch", "inference", "last_answer_s", "latency", "runs")

    def __init__(self) -> None:
        self.runs = 0.0  # of the network; of one that several requests share, each has its part
        self.last_answer_s = 0.0  # since 1970
        self.latency = Histogram(SECONDS)
        self.inference = Histogram(SECONDS)
        self.batch = Histogram(BATCHES)


@dataclass(frozen=True)
class Totals:
    """What one policy's version has answered since the start, over all protocols."""

    requests: int
    failures: int
    observations: int
    runs: int  # of the network
    request_s: float
    inference_s: float
    last_answer_ms: int  # since 1970; 0 where there was none


@dataclass
class VersionCounts:
    """What was counted of one policy's version since the start."""

    latency: list[int] = field(default_factory=lambda: [0] * (len(SECONDS) + 1))
    """Answered requests by how long they took: up to each of `SECONDS`, and longer."""
    failed: dict[str, int] = field(default_factory=dict)  # by the error's code
    ends: list[int] = field(default_factory=lambda: [0, 0])  # episodes that ended in success, and otherwise


class Metrics:
    """The counts of one replica."""

    def __init__(self) -> None:
        self._answered: dict[tuple[str, str, str], _Series] = {}
        self._failed: dict[tuple[str, str, str, str], int] = {}
        self._streams: dict[str, int] = {}
        self._ends: dict[tuple[str, str, bool], int] = {}

    def record_answer(self, protocol: str, decision: Decision, seconds: float) -> None:
        """Count a request that got its action `seconds` after it arrived."""
        key = (decision.name, decision.version, protocol)
        series = self._answered.get(key)
        if series is None:
            series = self._answered[key] = _Series()
        series.latency.add(seconds)
        series.inference.add(decision.infer_ms / 1e3)
        series.batch.add(decision.batch or 1)
        series.runs += 1 / decision.sharers
        series.last_answer_s = time.time()

    def count_failure(self, protocol: str, policy: str, version: str, code: str) -> None:
        """Count a request that got none; `policy` is empty unless it is loaded, so that nobody can make up labels."""
        key = (policy, version, protocol, code)
        self._failed[key] = self._failed.get(key, 0) + 1

    def count_end(self, decision: Decision, status: str) -> None:
        """Count an episode whose end a client told. Its word is free, so only `success` is told from the others."""
        key = (decision.name, decision.version, status == SUCCESS)
        self._ends[key] = self._ends.get(key, 0) + 1

    def count_stream(self, policy: str, change: int) -> None:
        """Count a WebSocket that opened (1) or closed (-1)."""
        self._streams[policy] = self._streams.get(policy, 0) + change

    def requests(self, policy: str, version: str) -> int:
        """Return how many requests a version has answered, over all protocols."""
        return sum(sum(series.latency.counts) for key, series in self._answered.items() if key[:2] == (policy, version))

    def totals(self, policy: str, version: str) -> Totals:
        """Return the sums over a version's requests; what failed without asking for an action does not count."""
        found = [series for key, series in self._answered.items() if key[:2] == (policy, version)]
        failed = (count for key, count in self._failed.items() if key[:2] == (policy, version) and key[3] != IDLE)
        return Totals(
            requests=self.requests(policy, version),
            failures=sum(failed),
            observations=round(sum(series.batch.total for series in found)),
            runs=round(sum(series.runs for series in found)),
            request_s=sum(series.latency.total for series in found),
            inference_s=sum(series.inference.total for series in found),
            last_answer_ms=round(1e3 * max((series.last_answer_s for series in found), default=0.0)),
        )

    def counts(self, policy: str) -> dict[str, VersionCounts]:
        """Return what was counted of each version of a policy since the start, over all protocols."""
        found: dict[str, VersionCounts] = {}
        for (name, version, _), series in self._answered.items():
            if name == policy:
                counts = found.setdefault(version, VersionCounts())
                counts.latency = [a + b for a, b in zip(counts.latency, series.latency.counts, strict=True)]
        for (name, version, _, code), count in self._failed.items():
            if name == policy and version:
                failed = found.setdefault(version, VersionCounts()).failed
                failed[code] = failed.get(code, 0) + count
        for (name, version, succeeded), count in self._ends.items():
            if name == policy:
                ends = found.setdefault(version, VersionCounts()).ends
                ends[int(not succeeded)] += count
        return found

    def families(self, replica: str) -> Iterator[Metric]:
        """Yield the families as they are now; `replica` tells the replicas' series apart."""
        names = ["replica", "policy", "version", "protocol"]
        requests = CounterMetricFamily("rlservo_requests", "Requests by outcome", labels=[*names, "code"])
        families = {
            "latency": HistogramMetricFamily(
                "rlservo_request_seconds", "From the first byte to the answer, of requests that got one", labels=names
            ),
            "inference": HistogramMetricFamily(
                "rlservo_inference_seconds",
                "Checking the observation, the network (where several requests share a run, the whole), checking the "
                "action",
                labels=names,
            ),
            "batch": HistogramMetricFamily("rlservo_batch_size", "Observations per request", labels=names),
        }
        for key, series in self._answered.items():
            labels = [replica, *key]
            requests.add_metric([*labels, "ok"], sum(series.latency.counts))
            for name, family in families.items():
                histogram: Histogram = getattr(series, name)
                family.add_metric(labels, histogram.cumulative(), histogram.total)
        for (policy, version, protocol, code), count in self._failed.items():
            requests.add_metric([replica, policy, version, protocol, code], count)
        yield requests
        yield from families.values()
        streams = GaugeMetricFamily("rlservo_streams", "Open WebSockets", labels=["replica", "policy"])
        for policy, count in self._streams.items():
            streams.add_metric([replica, policy], count)
        yield streams
        ends = CounterMetricFamily(
            "rlservo_episode_ends",
            "Episodes whose end clients told (`final_status`); outcome: success, other",
            labels=["replica", "policy", "version", "outcome"],
        )
        for (policy, version, succeeded), count in self._ends.items():
            ends.add_metric([replica, policy, version, SUCCESS if succeeded else "other"], count)
        yield ends
