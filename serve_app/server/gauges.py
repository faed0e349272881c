"""Prometheus' text: the requests' metrics, and gauges sampled when it is asked for (queue, sessions, drift, ...)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from rlservo.serve_app.server.core import Core

MAX_ELEMENTS = 128  # an image's pixels are no series each: only the largest is told
LARGEST = "largest"


def exposition(core: Core) -> bytes:
    """Return all metrics as Prometheus reads them."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Families(core))
    return generate_latest(registry)


class _Families(Collector):
    def __init__(self, core: Core) -> None:
        self._core = core

    def collect(self) -> Iterator[Metric]:
        core, replica = self._core, self._core.replica
        yield from core.metrics.families(replica)
        for families in (loaded, networks, queue, batches, drift, sessions, keys, recording):
            yield from families(core, replica)
        yield from core.shadows.families(replica)


def loaded(core: Core, replica: str) -> Iterator[Metric]:
    """Yield which versions are there, and which is the default."""
    family = GaugeMetricFamily(
        "rlservo_policy_loaded",
        "1 for the default version, 0 for the others",
        labels=["replica", "policy", "version"],
    )
    for name, version, _ in core.policies():
        family.add_metric([replica, name, version], float(version == core.store().default(name)))
    yield family


def networks(core: Core, replica: str) -> Iterator[Metric]:
    """Yield how many networks are in memory, and how often one was opened again, where there is a bound."""
    restores = CounterMetricFamily(
        "rlservo_network_restores",
        "Networks that had been dropped from memory and were opened again",
        labels=["replica", "policy", "version"],
    )
    in_memory = 0
    for name, version, policy in core.policies():
        network = policy.droppable
        if network is None:
            return
        in_memory += network.is_in_memory
        restores.add_metric([replica, name, version], network.restores)
    yield _gauge("rlservo_networks_in_memory", "Networks in memory, of all that are loaded", replica, in_memory)
    yield restores


def queue(core: Core, replica: str) -> Iterator[Metric]:
    """Yield what is known of the work before this replica."""
    admission = core.admission
    waited = "Most requests that waited for the processor at once, since the start"
    yield _gauge("rlservo_queue_longest", waited, replica, admission.longest)
    yield _gauge("rlservo_requests_incoming", "Requests whose body is on its way", replica, admission.incoming)


def keys(core: Core, replica: str) -> Iterator[Metric]:
    """Yield whether the API keys in use are those of their file, and whose requests were refused by their rate."""
    current = "1 while the API keys in use are those of their file; 0: the file cannot be used, and older keys stay"
    yield _gauge("rlservo_api_keys_current", current, replica, core.keys.current)
    limited = CounterMetricFamily(
        "rlservo_rate_limited", "Requests refused because their key asked too often", labels=["replica", "key"]
    )
    for label, count in core.keys.limits.refused.items():
        limited.add_metric([replica, label], count)
    yield limited


def recording(core: Core, replica: str) -> Iterator[Metric]:
    """Yield what is recorded and what is missing, where a recording was asked for."""
    if core.recorder is None:
        return
    recorder = core.recorder.recorder
    goes_on = "1 while decisions are recorded; 0: the folder could not be written to"
    yield _gauge("rlservo_recording", goes_on, replica, recorder.failure is None)
    for name, help_text, count in (
        ("rlservo_records_written", "Decisions, and what came of them, in the recording", recorder.written),
        ("rlservo_records_dropped", "Decisions that did not fit into the recording's buffer", recorder.dropped),
    ):
        family = CounterMetricFamily(name, help_text, labels=["replica"])
        family.add_metric([replica], count)
        yield family


def batches(core: Core, replica: str) -> Iterator[Metric]:
    """Yield how many observations were computed together, of the policies whose options ask for it."""
    labels = ["replica", "policy", "version"]
    runs = CounterMetricFamily("rlservo_micro_batch_runs", "Runs of the network for single observations", labels=labels)
    observations = CounterMetricFamily(
        "rlservo_micro_batch_observations", "Single observations computed in those runs", labels=labels
    )
    for name, version, policy in core.policies():
        batcher = core.store().batcher_of(policy)
        if batcher is not None:
            runs.add_metric([replica, name, version], batcher.runs)
            observations.add_metric([replica, name, version], batcher.observations)
    yield from (runs, observations)


def sessions(core: Core, replica: str) -> Iterator[Metric]:
    """Yield what is known of the memories that are kept here."""
    kept = core.episodes.sessions
    labels = ["replica", "policy"]
    open_now = GaugeMetricFamily("rlservo_sessions", "Sessions kept under an id", labels=labels)
    counted = (
        ("rlservo_sessions_begun", "Sessions begun under an id", kept.begun),
        ("rlservo_sessions_evicted", "Sessions forgotten because nobody asked them anything", kept.evicted),
        ("rlservo_sessions_lost", "Requests whose session is not here (any more)", kept.lost),
    )
    families = [CounterMetricFamily(name, help_text, labels=labels) for name, help_text, _ in counted]
    now = kept.count()
    for name in sorted({*now, *kept.begun, *kept.lost}):
        open_now.add_metric([replica, name], now[name])
        for family, (_, _, count) in zip(families, counted, strict=True):
            family.add_metric([replica, name], count[name])
    yield from (open_now, *families)
    remembered = "Episodes in memory, in sessions and on streams; a batch is so many"
    yield _gauge("rlservo_episodes_remembered", remembered, replica, kept.rows)


def drift(core: Core, replica: str) -> Iterator[Metric]:
    """Yield how far the observations of each policy have moved from its training."""
    labels = ["replica", "policy", "version"]
    shift = GaugeMetricFamily(
        "rlservo_observation_shift",
        "Mean of each observation element, from its mean in training, in standard deviations of training",
        labels=[*labels, "element"],
    )
    spread = GaugeMetricFamily(
        "rlservo_observation_spread",
        "Standard deviation of each observation element, relative to training",
        labels=[*labels, "element"],
    )
    looks = CounterMetricFamily("rlservo_observation_looks", "Observations looked at for drift", labels=labels)
    for name, version, policy in core.policies():
        found = policy.drift
        if found is None:
            continue
        who = [replica, name, version]
        looks.add_metric(who, found.looks)
        if not found.looks:
            continue
        moved, varied = found.shift, found.spread
        if len(moved) > MAX_ELEMENTS:
            worst = int(np.argmax(np.abs(moved)))
            shift.add_metric([*who, LARGEST], moved[worst])
            spread.add_metric([*who, LARGEST], varied.max())
            continue
        for element, mean, deviation in zip(found.elements, moved, varied, strict=True):
            shift.add_metric([*who, element], mean)
            spread.add_metric([*who, element], deviation)
    yield from (shift, spread, looks)


def _gauge(name: str, documentation: str, replica: str, value: float) -> Metric:
    gauge = GaugeMetricFamily(name, documentation, labels=["replica"])
    gauge.add_metric([replica], value)
    return gauge
