"""The autoscaling policy on the numbers Serve gives it, and the measure behind them."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from rlservo.serve_app.ray_serve.autoscaling import BUSY, Load, by_load


@pytest.mark.parametrize(
    ("shares", "target", "replicas"),
    [
        ([0.1], 1, 1),
        ([0.95], 1, 2),
        ([0.9, 0.9], 2, 3),
        ([1.0, 1.0, 1.0, 1.0], 4, 4),  # the most that was allowed
        ([0.5, 0.5], 2, 2),  # one could just carry it, at 100%
        ([0.28, 0.28], 2, 2),  # one could carry it, but would be called back soon
        ([0.1, 0.1], 2, 1),
        ([0.1, 0.1, 0.1, 0.1], 4, 1),
        ([], 3, 3),  # nothing is known: nothing changes
    ],
)
def test_replicas_follow_the_load_and_do_not_go_to_and_fro(shares: list[float], target: int, replicas: int) -> None:
    context = SimpleNamespace(
        target_num_replicas=target,
        current_num_replicas=len(shares) or target,
        aggregated_metrics={BUSY: dict(enumerate(shares))} if shares else {},
        capacity_adjusted_min_replicas=1,
        capacity_adjusted_max_replicas=4,
    )
    assert by_load(context) == (replicas, {})


def test_a_thread_that_works_counts_as_busy_and_one_that_sleeps_does_not() -> None:
    load = Load()
    time.sleep(0.3)
    idle = load.measure()
    end = time.perf_counter() + 0.5
    while time.perf_counter() < end:
        pass
    assert idle < 0.7 < load.measure() <= 1.0
