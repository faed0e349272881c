"""Metrics of `rlservo serve --workers 2`: any worker answers for both, also while workers die and are replaced."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from bundles import write_box_policy
from servers import Run, ask, free_ports, running, wait_until_served

pytestmark = [pytest.mark.serve, pytest.mark.slow]

PATIENCE_S = 60


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Two workers; at the end nothing is left of them, no file either."""
    folder = tmp_path_factory.mktemp("policies")
    write_box_policy(folder)
    (port,) = free_ports(1)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(folder), "--workers", "2", "--port", str(port)]
    runtime = tmp_path_factory.mktemp("runtime")
    with running(command, port, XDG_RUNTIME_DIR=str(runtime)) as run:
        assert run.process.stdout is not None
        threading.Thread(target=list, args=(run.process.stdout,), daemon=True).start()  # so that the pipe never fills
        wait_until_served(run)
        yield run
        assert run.end(signal.SIGTERM) == 0


def by_replica(run: Run, name: str, **wanted: str) -> dict[str, float]:
    """Return a metric's values, summed for each worker."""
    status, text = ask(run.port, "GET", "/metrics")
    assert status == 200
    found: Counter[str] = Counter()
    for family in text_string_to_metric_families(text.decode() if isinstance(text, bytes) else text):
        for sample in family.samples:
            if sample.name == name and wanted.items() <= sample.labels.items():
                found[sample.labels["replica"]] += sample.value
    return dict(found)


def wait_for(look: Callable[[], Any], is_so: Callable[[Any], bool]) -> Any:
    deadline = time.monotonic() + PATIENCE_S
    while not is_so(seen := look()):
        assert time.monotonic() < deadline, seen
        time.sleep(0.1)
    return seen


def act(run: Run, count: int) -> None:
    for _ in range(count):
        assert ask(run.port, "POST", "/v1/policies/ur5/act", {"obs": [0.1] * 27})[0] == 200


def workers(run: Run) -> dict[str, float]:
    """Return the plan that each worker follows."""
    return by_replica(run, "rlservo_plan_generation")


def test_any_worker_answers_for_both(server: Run) -> None:
    wait_for(lambda: workers(server), lambda seen: len(seen) == 2)
    asked = sum(by_replica(server, "rlservo_requests_total", code="ok").values())
    counted: dict[str, float] = {}
    while len(counted) < 2:  # of 60 connections each takes some, unless the machine is busy
        assert asked < 3000, counted
        act(server, 60)
        asked += 60
        counted = wait_for(
            lambda: by_replica(server, "rlservo_requests_total", code="ok"),
            lambda seen, asked=asked: sum(seen.values()) == asked,
        )
    assert by_replica(server, "rlservo_request_seconds_count") == counted
    assert by_replica(server, "rlservo_request_seconds_bucket", le="+Inf") == counted
    assert len(set(workers(server).values())) == 1 and workers(server).keys() == counted.keys()
    assert by_replica(server, "rlservo_policy_loaded", policy="ur5") == dict.fromkeys(counted, 1.0)


def test_counts_of_a_worker_that_dies_stay_and_its_death_is_counted(server: Run) -> None:
    act(server, 60)
    killed, _ = wait_for(lambda: workers(server), lambda seen: len(seen) == 2)
    answered = by_replica(server, "rlservo_request_seconds_count")
    assert max(by_replica(server, "rlservo_workers_lost_total").values()) == 0
    os.kill(int(killed), signal.SIGFPE)
    wait_for(lambda: workers(server), lambda seen: killed not in seen and len(seen) == 2)
    left = by_replica(server, "rlservo_request_seconds_count")
    assert all(left[worker] >= count for worker, count in answered.items())
    assert max(by_replica(server, "rlservo_workers_lost_total").values()) == 1
    names = [path.name for path in server.folder.rglob("*.db")]
    assert names and not any(name.startswith("gauge") and killed in name for name in names)


def test_workers_that_are_replaced_one_by_one_are_all_seen(server: Run) -> None:
    before = wait_for(lambda: workers(server), lambda seen: len(seen) == 2)
    answered_before = sum(by_replica(server, "rlservo_requests_total", code="ok").values())
    lost = by_replica(server, "rlservo_workers_lost_total")
    server.process.send_signal(signal.SIGHUP)
    after = wait_for(lambda: workers(server), lambda seen: len(seen) == 2 and not seen.keys() & before.keys())
    act(server, 40)
    answered = wait_for(
        lambda: by_replica(server, "rlservo_requests_total", code="ok"),
        lambda seen: sum(seen.values()) == answered_before + 40,
    )
    assert sum(count for worker, count in answered.items() if worker in after) == 40
    now = by_replica(server, "rlservo_workers_lost_total")
    assert max(now.values()) == max(lost.values())  # an orderly end is none
