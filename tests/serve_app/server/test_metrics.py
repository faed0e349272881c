"""The metrics as Prometheus would parse them, after real requests over the three protocols."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from bundles import controlled, write_box_policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.server.metrics import Metrics
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.sampled_metrics import exposition
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_commands import Load, Unload
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.version_loader import VersionLoader
from servers import exchange, over_uvicorn
from stores import control_of, load_store
from streams import Stream

OBS = [0.1] * 27


def test_requests_are_counted_by_policy_version_protocol_and_outcome(policies: Path) -> None:
    store = load_store(policies)
    app = create_app(control_of(store), ServerSettings(default_policy="ur5"), replica="r1")
    with over_uvicorn(app) as port:

        def call(path: str, body: Any = None) -> tuple[int, bytes]:
            reply = exchange(port, "GET" if body is None else "POST", path, body)
            return reply.status, reply.content

        def scrape() -> dict[tuple[str, ...], float]:
            status, text = call("/metrics")
            assert status == 200
            found = {}
            for family in text_string_to_metric_families(text.decode()):
                for sample in family.samples:
                    labels = (value for key, value in sorted(sample.labels.items()) if key != "replica")
                    assert sample.labels["replica"] == "r1"
                    found[(sample.name, *labels)] = sample.value
            return found

        for _ in range(3):
            assert call("/v1/policies/ur5/act", {"obs": OBS})[0] == 200
        assert call("/v1/policies/ur5/versions/2/act", {"obs": [OBS] * 5})[0] == 200
        tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}
        assert call("/v2/models/ur5/infer", {"inputs": [tensor]})[0] == 200
        assert call("/v1/policies/ur5/act", {"obs": OBS[:3]})[0] == 422
        for name in ("made-up-1", "made-up-2"):
            assert call(f"/v1/policies/{name}/act", {"obs": OBS})[0] == 404
        assert call("/v1/policies/ur5/versions/77/act", {"obs": OBS})[0] == 404
        with Stream(port) as stream:
            stream.ask(obs=OBS)
            seen = scrape()
            assert seen["rlservo_streams", "ur5"] == 1
        # Labels in the order of their names: code, policy, protocol, version (le first in buckets).
        assert seen["rlservo_requests_total", "ok", "ur5", "json", "10"] == 3
        assert seen["rlservo_requests_total", "ok", "ur5", "json", "2"] == 1
        assert seen["rlservo_requests_total", "ok", "ur5", "oip", "10"] == 1
        assert seen["rlservo_requests_total", "ok", "ur5", "websocket", "10"] == 1
        assert seen["rlservo_requests_total", "bad-observation", "ur5", "json", "10"] == 1  # the default's
        assert seen["rlservo_requests_total", "unknown-policy", "", "json", ""] == 2  # one series for any made-up name
        assert seen["rlservo_requests_total", "unknown-version", "ur5", "json", ""] == 1
        assert seen["rlservo_batch_size_sum", "ur5", "json", "2"] == 5
        assert seen["rlservo_batch_size_bucket", "4.0", "ur5", "json", "2"] == 0
        assert seen["rlservo_batch_size_bucket", "8.0", "ur5", "json", "2"] == 1
        assert seen["rlservo_request_seconds_count", "ur5", "json", "10"] == 3
        latency, inference = (
            seen[f"rlservo_{name}_seconds_sum", "ur5", "json", "10"] for name in ("request", "inference")
        )
        assert 0 < inference < latency < 10
        assert seen["rlservo_request_seconds_bucket", "+Inf", "ur5", "json", "10"] == 3
        assert seen["rlservo_policy_loaded", "ur5", "10"] == 1 and seen["rlservo_policy_loaded", "ur5", "2"] == 0
        again = scrape()
        assert again["rlservo_streams", "ur5"] == 0
        for reading in (seen, again):
            del reading["rlservo_streams", "ur5"], reading["rlservo_uptime_seconds",]
        assert again == seen


def test_a_version_that_is_unloaded_disappears_and_the_plan_is_numbered(tmp_path: Path) -> None:
    for version in ("1", "2"):
        write_box_policy(tmp_path, version=version)
    with controlled(tmp_path, config={"policies": {"ur5": {"aliases": {"production": "1"}}}}) as control:
        handler = RequestHandler(control, ServerSettings(), replica="r")

        def loaded() -> dict[str, float]:
            text = asyncio.run(exposition(handler)).decode()
            families = {family.name: family for family in text_string_to_metric_families(text)}
            assert families["rlservo_plan_generation"].samples[0].value == control.plan.generation
            return {each.labels["version"]: each.value for each in families["rlservo_policy_loaded"].samples}

        assert loaded() == {"1": 1.0, "2": 0.0}
        asyncio.run(control.give(Unload(version="2"), "ur5"))
        assert loaded() == {"1": 1.0}
        asyncio.run(control.give(Load(version="2"), "ur5"))
        assert loaded() == {"1": 1.0, "2": 0.0}


def test_versions_that_a_process_could_not_load_are_counted(tmp_path: Path) -> None:
    for version in ("1", "2"):
        write_box_policy(tmp_path, version=version)
    config = {"policies": {"ur5": {"aliases": {"production": "1"}}}}
    with controlled(tmp_path, config=config) as control:
        for damaged in (0, 1):
            if damaged:  # another process begins, with the same plan
                (tmp_path / "ur5" / "2" / "policy.onnx").write_bytes(b"")
                control = PlanFollower(VersionLoader(Repository([tmp_path])), control.files)
                asyncio.run(control.configure(config))
            text = asyncio.run(exposition(RequestHandler(control, ServerSettings()))).decode()
            families = {family.name: family for family in text_string_to_metric_families(text)}
            assert families["rlservo_versions_missing"].samples[0].value == damaged
            assert len(families["rlservo_policy_loaded"].samples) == 2 - damaged


def test_a_counter_whose_source_begins_again_goes_on() -> None:
    metrics = Metrics("r")
    for total in (0, 3, 3, 5, 2, 4):
        metrics.counter("rlservo_looks", "Looks", total, policy="ur5")
    assert b'rlservo_looks_total{policy="ur5",replica="r"} 9.0' in metrics.text()
