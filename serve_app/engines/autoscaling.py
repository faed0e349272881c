"""Autoscaling by processor time: enough replicas to keep the load of each moderate.

Ray Serve counts requests in progress. A policy's request is over before it is counted, so a replica at its limit looks
idle, while one with a hundred silent streams looks busy; hence this measure instead. In serve.yaml:
`autoscaling_config: {policy: {policy_function: rlservo.serve_app.engines.autoscaling:by_load}, ...}`. It imports
nothing from Ray: Serve's controller imports it.
"""

from __future__ import annotations

import contextlib
import math
import time
from pathlib import Path
from typing import Any

BUSY = "busy"
TARGET = 0.6  # share of one core per replica; above it, simultaneous requests noticeably delay each other
ENOUGH = 0.45  # one replica less only if the others stay below this, to avoid oscillation


class ThreadLoad:
    """Share of the time in which this process's busiest thread wanted a core, whether it got one or not.

    Processor time looks modest exactly when the machine is overloaded.
    """

    def __init__(self) -> None:
        self._wall, self._wanted = time.perf_counter(), _wanted_by_thread()

    def measure(self) -> float:
        """Return the share since the last measurement, between 0 and 1, and start the next one."""
        wall, wanted = time.perf_counter(), _wanted_by_thread()
        most = max((seconds - self._wanted.get(thread, 0.0) for thread, seconds in wanted.items()), default=0.0)
        share = most / max(wall - self._wall, 1e-3)
        self._wall, self._wanted = wall, wanted
        return min(share, 1.0)


def _wanted_by_thread() -> dict[str, float]:
    """Return the seconds that each thread ran or waited to run (only ran, if Linux reports no waiting)."""
    found = {}
    for file in Path("/proc/self/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, ValueError):  # a thread may end meanwhile
            ran, waited, _ = map(int, file.read_text().split())
            found[file.parent.name] = (ran + waited) / 1e9
    return found or {"": time.process_time()}


def by_load(context: Any) -> tuple[int, dict[str, Any]]:
    """Return (replicas, state to keep) for Serve's `AutoscalingContext`."""
    now = max(1, context.target_num_replicas)
    shares = list((context.aggregated_metrics.get(BUSY) or {}).values())
    if not shares:
        return now, {}
    work = sum(shares) / len(shares) * max(1, context.current_num_replicas)
    wanted = max(1, math.ceil(work / TARGET))
    if wanted < now and work / wanted > ENOUGH:
        wanted = min(now, wanted + 1)
    return min(max(wanted, context.capacity_adjusted_min_replicas), context.capacity_adjusted_max_replicas), {}
