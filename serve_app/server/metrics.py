"""Prometheus metrics of one process, or of all workers of a server if they share a folder.

Counters, gauges and the times of answers are sampled from the server's own numbers when Prometheus asks and, where
several workers share their metrics, every second. Every series has the label `replica`, the process that counted
it: if PROMETHEUS_MULTIPROC_DIR names a folder, the client library keeps values in files there and each worker answers
for all. The counts of a worker that has ended stay for a while, and those that died without an orderly end are counted.

Names follow Prometheus' conventions (base units, `_total`).
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import prometheus_client
import psutil
from prometheus_client import CollectorRegistry, Gauge, Histogram, generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector

from rlservo.client.formats.request_names import SUCCESS
from rlservo.serve_app.versions.policy_store import Decision

FOLDER_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"  # read by prometheus_client when it is imported
EVERY_S = 1.0
MOST_UNTIMED = 100  # answers, which take 0.2 ms together
KEPT_S = 600.0  # that the counts of an ended worker stay: a promotion looks more often
BEGAN, LEFT, GONE = ".began", ".left", ".gone"  # marks of a worker in the folder: its start, orderly end, end seen
IDLE = "idle"  # close code of a stream that was silent for too long
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


@dataclass(slots=True)
class Answers:
    """Answered requests to one version of a policy over one protocol."""

    latency: Histogram
    inference: Histogram
    batch: Histogram
    count: int = 0
    observations: int = 0
    last_s: float = 0.0  # since 1970
    untimed: list[tuple[float, float, int | None]] = field(default_factory=list)
    """Latency, inference [s] and batch of the latest, not in the histograms yet: together they take less time."""

    def time(self) -> None:
        """Bring the histograms up to date."""
        for latency, inference, batch in self.untimed:
            self.latency.observe(latency)
            self.inference.observe(inference)
            if batch is not None:
                self.batch.observe(batch)
        self.untimed.clear()


class Metrics(Collector):
    """The metrics of one process, `replica`."""

    def __init__(self, replica: str = "") -> None:
        self._replica = replica
        self.began, self.began_at = time.monotonic(), time.time()
        self.folder = os.environ.get(FOLDER_VARIABLE)  # that several workers share
        self._mark(BEGAN)
        self._registry = registry = CollectorRegistry()
        self._counted = CollectorRegistry()  # what is sampled
        self._sampled: dict[str, Any] = {}  # counters and gauges by name
        self._values: dict[tuple[str, ...], float] = {}  # of counters, by name and labels
        self._gauges: dict[tuple[str, ...], float] = {}  # in the last round
        self._round: dict[tuple[str, ...], float] = {}

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
        self.answers: dict[tuple[str, str, str], Answers] = {}  # by policy, version, protocol
        self.failures: Counter[tuple[str, str, str, str]] = Counter()  # by the same and the error's code
        self.ends: Counter[tuple[str, str, bool]] = Counter()  # by policy, version and success

    def record_answer(self, protocol: str, decision: Decision, seconds: float) -> None:
        """Count a request that got its action `seconds` after it arrived."""
        key = (decision.name, decision.version, protocol)
        answers = self.answers.get(key)
        if answers is None:
            labels = (self._replica, *key)
            latency, inference, batch = self._latency, self._inference, self._batch
            answers = Answers(latency.labels(*labels), inference.labels(*labels), batch.labels(*labels))
            self.answers[key] = answers
        answers.untimed.append((seconds, decision.infer_ms / 1e3, decision.batch))
        if len(answers.untimed) == MOST_UNTIMED:
            answers.time()
        answers.count += 1
        answers.observations += decision.batch or 1
        answers.last_s = time.time()

    def count_failure(self, protocol: str, policy: str, version: str, code: str) -> None:
        """Count a request that got no action; `policy` is empty unless loaded: clients must not invent labels."""
        self.failures[policy, version, protocol, code] += 1

    def count_end(self, decision: Decision, status: str) -> None:
        """Count an episode whose end a client reported. Its status is free text: counted as `success` or as another."""
        self.ends[decision.name, decision.version, status == SUCCESS] += 1

    def record_differences(self, policy: str, version: str, shadow: str, differences: Iterable[float]) -> None:
        """Record by how much a shadow's actions differ from those of the version that answered."""
        histogram = self._difference.labels(self._replica, policy, version, shadow)
        for difference in differences:
            histogram.observe(difference)

    def answers_of(self, policy: str, version: str) -> list[Answers]:
        """Return the answers of a version since the start, one for each protocol."""
        found = [answers for key, answers in self.answers.items() if key[:2] == (policy, version)]
        for answers in found:
            answers.time()
        return found

    def counter(self, name: str, documentation: str, total: float, **labels: str) -> None:
        """Raise a counter to a total; a smaller total than before has restarted from zero."""
        key = (name, *labels.values())
        before = self._values.get(key)
        if total != before:
            grown = total - before if before is not None and before < total else total
            self._series(prometheus_client.Counter, key, documentation, labels).inc(grown)
            self._values[key] = total

    def gauge(self, name: str, documentation: str, value: float, **labels: str) -> None:
        """Set a gauge; one that is not set in a round disappears."""
        key = (name, *labels.values())
        if self._gauges.pop(key, None) != value:
            self._series(Gauge, key, documentation, labels, multiprocess_mode="livesum").set(value)
        self._round[key] = value

    def end_round(self) -> None:
        """Remove the gauges that were not set since the last round."""
        for name, *labels in self._gauges:
            # In files a series cannot be removed; `collect` leaves these out.
            self._sampled[name].labels(self._replica, *labels).set(math.nan)
        self._gauges, self._round = self._round, {}

    def _series(self, kind: Any, key: tuple[str, ...], documentation: str, labels: Iterable[str], **mode: str) -> Any:
        name, *values = key
        if name not in self._sampled:
            self._sampled[name] = kind(name, documentation, ["replica", *labels], registry=self._counted, **mode)
        return self._sampled[name].labels(self._replica, *values)

    def leave(self) -> None:
        """Note that this process shuts down cleanly: a worker without this note has died."""
        self._mark(LEFT)

    def _mark(self, mark: str) -> None:
        if self.folder is not None and self._replica:
            with contextlib.suppress(OSError):  # removed with the last of the server
                Path(self.folder, f"{self._replica}{mark}").touch()

    def text(self) -> bytes:
        """Return all metrics as Prometheus reads them: of this process, or of all workers."""
        return generate_latest(self)

    def collect(self) -> Iterator[Metric]:
        """Yield the current metric families."""
        # Counters come first here and in the files: no answer is counted before it is timed.
        own: Iterable[Metric] = itertools.chain(self._counted.collect(), self._registry.collect())
        if self.folder is not None:
            own = _of_all_workers(Path(self.folder))
        for family in own:
            family.samples = [
                each for each in family.samples if not math.isnan(each.value) and not each.name.endswith("_created")
            ]
            yield family

    def lost_workers(self) -> int | None:
        """Return how many workers have died without an orderly end; None where none share their metrics."""
        return None if self.folder is None else len(_ended(Path(self.folder))[1])


def sum_of(histogram: Histogram) -> float:
    """Return the sum of a histogram's values."""
    (family,) = histogram.collect()
    return next(sample.value for sample in family.samples if sample.name.endswith("_sum"))


def _of_all_workers(folder: Path) -> Iterable[Metric]:
    """Return the families from the workers' files; those of ended ones are removed, their counts' after a while."""
    ended, _ = _ended(folder)
    shown = []
    for file in sorted(folder.glob("*.db")):  # such as histogram_4711.db; those of counters come first
        kind, _, worker = file.stem.rpartition("_")
        if worker not in ended or (kind in ("counter", "histogram") and ended[worker] < KEPT_S):
            shown.append(str(file))
        else:
            file.unlink(missing_ok=True)
    try:
        families: Iterable[Metric] = MultiProcessCollector.merge(shown)  # type: ignore[no-untyped-call]
    except FileNotFoundError:  # of a worker that has just died
        return _of_all_workers(folder)
    return families


def _ended(folder: Path) -> tuple[dict[str, float], set[str]]:
    """Return how long ago [s] the end of each ended worker was seen, and those of them that did not end in order."""
    ended, lost = {}, set()
    for began in folder.glob(f"*{BEGAN}"):
        if psutil.pid_exists(int(began.stem)):
            continue
        gone = began.with_suffix(GONE)
        with contextlib.suppress(OSError):  # of another server's folder that is being removed
            if not gone.exists():
                gone.touch()
            ended[began.stem] = time.time() - gone.stat().st_mtime
        if not began.with_suffix(LEFT).exists():
            lost.add(began.stem)
    return ended, lost
