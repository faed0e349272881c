"""Prometheus gauges sampled at scrape time: queue, sessions, micro-batches, observation drift.

`Metrics.sources` takes functions such as these; shadows add their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric

from rlservo.serve_app.server.core import Core

MAX_ELEMENTS = 128  # an image's pixels are no series each: only the largest is told
LARGEST = "largest"


def gauges_of(core: Core) -> list[Callable[[], Iterator[Metric]]]:
    """Return the gauges of a core, for its `metrics.sources`."""
    return [partial(families, core, core.replica) for families in (queue, batches, drift, sessions, keys)]


def queue(core: Core, replica: str) -> Iterator[Metric]:
    """Yield what is known of the work before this replica."""
    admission = core.admission
    labels = ["replica"]
    for name, help_text, value in (
        ("rlservo_queue_longest", "Most requests that waited for the processor at once, since the start",
         admission.longest),
        ("rlservo_requests_incoming", "Requests whose body is on its way", admission.incoming),
    ):  # fmt: skip
        gauge = GaugeMetricFamily(name, help_text, labels=labels)
        gauge.add_metric([replica], value)
        yield gauge
    turned_away = CounterMetricFamily(
        "rlservo_turned_away", "Requests answered 503 before anything was read of them", labels=labels
    )
    turned_away.add_metric([replica], admission.turned_away)
    yield turned_away


def keys(core: Core, replica: str) -> Iterator[Metric]:
    """Yield whether the API keys in use are those of their file."""
    current = GaugeMetricFamily(
        "rlservo_api_keys_current",
        "1 while the API keys in use are those of their file; 0: the file cannot be used, and older keys stay",
        labels=["replica"],
    )
    current.add_metric([replica], core.keys.current)
    yield current


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
    remembered = GaugeMetricFamily(
        "rlservo_episodes_remembered",
        "Episodes in memory, in sessions and on streams; a batch is so many",
        labels=["replica"],
    )
    remembered.add_metric([replica], kept.rows)
    yield from (open_now, *families, remembered)


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
