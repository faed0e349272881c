"""Prometheus metrics of one process, or of all workers of a server if they share a folder.

Histograms take values directly. Counters and gauges are sampled from the server's own numbers when Prometheus asks and,
where several workers share their metrics, every second. Every series has the label `replica`, the process that counted
it: if PROMETHEUS_MULTIPROC_DIR names a folder, the client library keeps values in files there and each worker answers
for all.

Names follow Prometheus' conventions (base units, `_total`).
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import prometheus_client
import psutil
from prometheus_client import CollectorRegistry, Gauge, Histogram, generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector

from rlservo.serve_app.versions.policy_store import Decision

if TYPE_CHECKING:
    from rlservo.serve_app.server.request_handler import RequestHandler

FOLDER_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"  # read by prometheus_client when it is imported
EVERY_S = 1.0
MAX_ELEMENTS = 128  # not a series for each pixel of an image: only the largest is shown
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
        self.began = time.monotonic()
        self.folder = os.environ.get(FOLDER_VARIABLE)  # that several workers share
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
        answers.latency.observe(seconds)
        answers.inference.observe(decision.infer_ms / 1e3)
        if decision.batch is not None:
            answers.batch.observe(decision.batch)
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
        return [answers for key, answers in self.answers.items() if key[:2] == (policy, version)]

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

    def text(self) -> bytes:
        """Return all metrics as Prometheus reads them: of this process, or of all workers."""
        return generate_latest(self)

    def collect(self) -> Iterator[Metric]:
        """Yield the current metric families."""
        # Counters come first here and in the files: no answer is counted before it is timed.
        own = itertools.chain(self._counted.collect(), self._registry.collect())
        for family in own if self.folder is None else _of_all_workers(Path(self.folder)):
            family.samples = [
                each for each in family.samples if not math.isnan(each.value) and not each.name.endswith("_created")
            ]
            yield family


def sum_of(histogram: Histogram) -> float:
    """Return the sum of a histogram's values."""
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


async def exposition(handler: RequestHandler) -> bytes:
    """Return all metrics as Prometheus reads them."""
    await sample(handler)
    return await asyncio.to_thread(handler.metrics.text)  # thousands of series take a while


async def sample(handler: RequestHandler) -> None:
    """Bring all counters and gauges up to date."""
    for part in (requests, versions, process, sessions):
        part(handler)
    handler.metrics.end_round()


def requests(handler: RequestHandler) -> None:
    """Sample the counts of requests, streams, episodes and shadows."""
    show = handler.metrics
    outcomes = {(*key, "ok"): answers.count for key, answers in show.answers.items()} | show.failures
    for (policy, version, protocol, code), count in outcomes.items():
        which = {"policy": policy, "version": version, "protocol": protocol, "code": code}
        show.counter("rlservo_requests", "Requests by outcome", count, **which)
    for policy, count in handler.admission.streams.items():
        show.gauge("rlservo_streams", "Open WebSockets", count, policy=policy)
    for (policy, version, succeeded), count in show.ends.items():
        which = {"policy": policy, "version": version, "outcome": SUCCESS if succeeded else "other"}
        show.counter("rlservo_episode_ends", "Episodes whose end a client reported (`final_status`)", count, **which)
    for ((policy, version, shadow), reason), count in list(handler.shadows.missed.items()):
        which = {"policy": policy, "version": version, "shadow": shadow, "reason": reason}
        show.counter("rlservo_shadow_missed", "Actions not compared with a shadow's", count, **which)


def versions(handler: RequestHandler) -> None:
    """Sample the plan that this process follows, and each version's default flag, batches and drift."""
    show = handler.metrics
    plan, store = handler.control.plan, handler.control.store
    if plan is None or store is None:
        return
    show.gauge("rlservo_plan_generation", "Plan that this process follows", plan.generation)
    for policy in store.policies:
        name, version = policy.contract.name, policy.contract.version
        which, is_default = {"policy": name, "version": version}, version == store.default(name)
        show.gauge("rlservo_policy_loaded", "1 for the default version, 0 for the others", is_default, **which)
        drift = policy.drift
        if drift is None:
            continue
        show.counter("rlservo_observation_looks", "Observations checked for drift", drift.looks, **which)
        elements, moved, varied = drift.elements if drift.looks else (), drift.shift, drift.spread
        if len(elements) > MAX_ELEMENTS:
            elements, moved, varied = ("largest",), moved[[np.argmax(np.abs(moved))]], varied[[np.argmax(varied)]]
        for element, mean, deviation in zip(elements, moved.tolist(), varied.tolist()):  # noqa: B905 - none before a look
            shift = "Shift of an observation element's mean from training's, in training's standard deviations"
            show.gauge("rlservo_observation_shift", shift, mean, **which, element=element)
            spread = "Standard deviation of an observation element, relative to training"
            show.gauge("rlservo_observation_spread", spread, deviation, **which, element=element)


def process(handler: RequestHandler) -> None:
    """Sample this process's queue, API keys and recording."""
    admission, keys, show = handler.admission, handler.keys, handler.metrics
    show.gauge("rlservo_uptime_seconds", "Time since this process' start", time.monotonic() - show.began)
    waited = "Largest number of requests that waited for the processor at once, since the start"
    show.gauge("rlservo_queue_longest", waited, admission.longest)
    show.gauge("rlservo_requests_incoming", "Requests whose body is still arriving", admission.incoming)
    current = "1 while the API keys in use are those of their file; 0 if older keys stay in use"
    show.gauge("rlservo_api_keys_current", current, keys.current)
    for label, count in keys.limits.refused.items():
        show.counter("rlservo_rate_limited", "Requests refused because their key exceeded its rate", count, key=label)
    if handler.recorder is not None:
        recorder = handler.recorder.recorder
        goes_on = "1 while decisions are recorded; 0 if the folder cannot be written"
        show.gauge("rlservo_recording", goes_on, recorder.failure is None)
        show.counter("rlservo_records_written", "Decisions and outcomes in the recording", recorder.written)
        show.counter("rlservo_records_dropped", "Decisions dropped by a full recording buffer", recorder.dropped)


def sessions(handler: RequestHandler) -> None:
    """Sample the episodes in memory."""
    episodes, kept, show = handler.episodes, handler.episodes.sessions, handler.metrics
    now = kept.count()
    for name in sorted({*now, *episodes.begun, *episodes.lost}):
        show.gauge("rlservo_sessions", "Sessions in this process", now[name], policy=name)
        show.counter("rlservo_sessions_begun", "Sessions begun", episodes.begun[name], policy=name)
        show.counter("rlservo_sessions_evicted", "Sessions forgotten when idle", kept.evicted[name], policy=name)
        show.counter("rlservo_sessions_lost", "Requests for unknown sessions", episodes.lost[name], policy=name)
    if episodes.store is not None:
        failed = "Failed reads and writes of sessions in Redis; the requests were answered with 503"
        show.counter("rlservo_session_store_failures", failed, episodes.store.unreachable)
    show.gauge("rlservo_episodes_remembered", "Episodes in memory, in sessions and on streams", kept.rows)
