"""Metrics of what is there at the moment somebody asks: the queue, and the drift of observations.

`Metrics.sources` takes functions such as these; sessions or shadows add their own. It knows the core and Prometheus'
families.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric

if TYPE_CHECKING:
    from rlservo.serve_app.core import Core

MAX_ELEMENTS = 128  # an image's pixels are no series each: only the largest is told
LARGEST = "largest"


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
