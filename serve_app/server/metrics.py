"""Prometheus metrics of one process, or of all workers of a server if they share a folder.

Histograms are prometheus_client's own and take values directly. `sampled_metrics.py` copies the server's plain numbers
into counters and gauges. Every series has the label `replica`, the process that counted it: if PROMETHEUS_MULTIPROC_DIR
names a folder, the client library keeps values in files there and each worker answers for all.

Names follow Prometheus' conventions (base units, `_total`).
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector

from rlservo.serve_app.versions.policy_store import Decision

FOLDER_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"  # read by prometheus_client when it is imported
IDLE = "idle"  # close code of a stream that was silent for too long
SUCCESS = "success"  # the environments' final status of an episode that reached its goal
SECONDS = (1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0)
BATCHES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096)
DIFFERENCES = (1e-6, 1e-5, 1e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


@contextlib.contextmanager
def shared_by_workers() -> Iterator[None]:
    """Let worker processes started inside this context share their metrics; the files are removed at the end."""
    with tempfile.TemporaryDirectory(prefix="rlservo-metrics-") as folder:
        os.environ[FOLDER_VARIABLE] = folder
        try:
            yield
        finally:
            del os.environ[FOLDER_VARIABLE]


@dataclass(frozen=True)
class Totals:
    """Answers of one version of a policy since the start, over all protocols."""

    requests: int
    failures: int
    observations: int
    request_s: float
    inference_s: float
    last_answer_ms: int  # since 1970; 0 if there was none


@dataclass(slots=True)
class Answers:
    """Answered requests to one version of a policy over one protocol."""

    latency: Histogram
    inference: Histogram
    batch: Histogram
    count: int = 0
    observations: int = 0
    last_s: float = 0.0  # since 1970


class Metrics(Collector):
    """The metrics of one process, `replica`."""

    def __init__(self, replica: str = "") -> None:
        self._replica = replica
        self._folder = os.environ.get(FOLDER_VARIABLE)
        self._registry = registry = CollectorRegistry()

        def histogram(name: str, documentation: str, last_label: str, bounds: Sequence[float]) -> Histogram:
            labels = ["replica", "policy", "version", last_label]
            return Histogram(name, documentation, labels, buckets=bounds, registry=registry)

        latency = "Time from a request's first byte to its answer"
        self._latency = histogram("rlservo_request_seconds", latency, "protocol", SECONDS)
        inference = "Time to check the observation, run the network and check the action"
        self._inference = histogram("rlservo_inference_seconds", inference, "protocol", SECONDS)
        batch = "Observations per batch request"
        self._batch = histogram("rlservo_batch_size", batch, "protocol", BATCHES)
        difference = (
            "Largest difference of any element between a shadow's action and the one sent, in the element's unit"
        )
        self._difference = histogram("rlservo_shadow_difference", difference, "shadow", DIFFERENCES)
        self.sampled = Sampled(replica)
        self.answers: dict[tuple[str, str, str], Answers] = {}  # by policy, version, protocol
        self.failures: dict[tuple[str, str, str, str], int] = {}  # by the same and the error's code
        self.streams: dict[str, int] = {}  # by policy
        self.ends: dict[tuple[str, str, bool], int] = {}  # by policy, version and success

    @property
    def is_shared(self) -> bool:
        """Whether several workers share their metrics."""
        return self._folder is not None

    def record_answer(self, protocol: str, decision: Decision, seconds: float) -> None:
        """Count a request that got its action `seconds` after it arrived."""
        key = (decision.name, decision.version, protocol)
        answers = self.answers.get(key)
        if answers is None:
            labels = (self._replica, *key)
            latency, inference, batch = self._latency, self._inference, self._batch
            answers = Answers(latency.labels(*labels), inference.labels(*labels), batch.labels(*labels))
            self.answers[key] = answers
        answers.latency.observe(seconds)
        answers.inference.observe(decision.infer_ms / 1e3)
        if decision.batch is not None:
            answers.batch.observe(decision.batch)
        answers.count += 1
        answers.observations += decision.batch or 1
        answers.last_s = time.time()

    def count_failure(self, protocol: str, policy: str, version: str, code: str) -> None:
        """Count a request that got no action; `policy` is empty unless loaded: clients must not invent labels."""
        key = (policy, version, protocol, code)
        self.failures[key] = self.failures.get(key, 0) + 1

    def count_end(self, decision: Decision, status: str) -> None:
        """Count an episode whose end a client reported. Its status is free text: counted as `success` or as another."""
        key = (decision.name, decision.version, status == SUCCESS)
        self.ends[key] = self.ends.get(key, 0) + 1

    def count_stream(self, policy: str, change: int) -> None:
        """Count a WebSocket that opened (1) or closed (-1)."""
        self.streams[policy] = self.streams.get(policy, 0) + change

    def record_differences(self, policy: str, version: str, shadow: str, differences: Iterable[float]) -> None:
        """Record by how much a shadow's actions differ from those of the version that answered."""
        histogram = self._difference.labels(self._replica, policy, version, shadow)
        for difference in differences:
            histogram.observe(difference)

    def requests(self, policy: str, version: str) -> int:
        """Return the number of requests to a version that this process has answered, over all protocols."""
        return sum(answers.count for key, answers in self.answers.items() if key[:2] == (policy, version))

    def totals(self, policy: str, version: str) -> Totals:
        """Return the sums over a version's requests; failures that did not ask for an action do not count."""
        found = [answers for key, answers in self.answers.items() if key[:2] == (policy, version)]
        failed = (count for key, count in self.failures.items() if key[:2] == (policy, version) and key[3] != IDLE)
        return Totals(
            requests=sum(answers.count for answers in found),
            failures=sum(failed),
            observations=sum(answers.observations for answers in found),
            request_s=sum(_sum_of(answers.latency) for answers in found),
            inference_s=sum(_sum_of(answers.inference) for answers in found),
            last_answer_ms=round(1e3 * max((answers.last_s for answers in found), default=0.0)),
        )

    def text(self) -> bytes:
        """Return all metrics as Prometheus reads them: of this process, or of all workers."""
        registry = CollectorRegistry()
        registry.register(self)
        return generate_latest(registry)

    def collect(self) -> Iterator[Metric]:
        """Yield the current metric families."""
        # Counters come first here and in the files: no answer is counted before it is timed.
        own = itertools.chain(self.sampled.registry.collect(), self._registry.collect())
        for family in own if self._folder is None else _of_all_workers(Path(self._folder)):
            family.samples = [
                each for each in family.samples if not math.isnan(each.value) and not each.name.endswith("_created")
            ]
            yield family


class Sampled:
    """Counters and gauges that follow the server's own numbers; a gauge that is not set in a round disappears."""

    def __init__(self, replica: str) -> None:
        self.registry = CollectorRegistry()
        self._replica = replica
        self._counters: dict[str, Counter] = {}
        self._counted: dict[tuple[str, ...], float] = {}  # by name and labels
        self._gauges: dict[str, Gauge] = {}
        self._before: dict[tuple[str, ...], float] = {}  # in the last round
        self._now: dict[tuple[str, ...], float] = {}

    def counter(self, name: str, documentation: str, total: float, **labels: str) -> None:
        """Raise a counter to a total; a smaller total than before has restarted from zero."""
        key = (name, *labels.values())
        counted = self._counted.get(key)
        if counted == total:
            return
        if name not in self._counters:
            self._counters[name] = Counter(name, documentation, ["replica", *labels], registry=self.registry)
        grown = total - counted if counted is not None and counted < total else total
        self._counters[name].labels(self._replica, *key[1:]).inc(grown)
        self._counted[key] = total

    def gauge(self, name: str, documentation: str, value: float, **labels: str) -> None:
        """Set a gauge."""
        key = (name, *labels.values())
        self._now[key] = value
        if self._before.pop(key, None) == value:
            return
        if name not in self._gauges:
            self._gauges[name] = Gauge(
                name, documentation, ["replica", *labels], registry=self.registry, multiprocess_mode="livesum"
            )
        self._gauges[name].labels(self._replica, *key[1:]).set(value)

    def end_round(self) -> None:
        """Remove the gauges that were not set since the last round."""
        for name, *labels in self._before:
            # In files a series cannot be removed; `Metrics.collect` leaves these out.
            self._gauges[name].labels(self._replica, *labels).set(math.nan)
        self._before, self._now = self._now, {}


def _sum_of(histogram: Histogram) -> float:
    (family,) = histogram.collect()
    return next(sample.value for sample in family.samples if sample.name.endswith("_sum"))


def _of_all_workers(folder: Path) -> Iterable[Metric]:
    """Return the families from the files of running workers; the files of dead ones are removed."""
    living = []
    for file in sorted(folder.glob("*.db")):  # such as histogram_4711.db; those of counters come first
        if psutil.pid_exists(int(file.stem.rpartition("_")[2])):
            living.append(str(file))
        else:
            file.unlink(missing_ok=True)
    try:
        families: Iterable[Metric] = MultiProcessCollector.merge(living)  # type: ignore[no-untyped-call]
    except FileNotFoundError:  # of a worker that has just died
        return _of_all_workers(folder)
    return families
