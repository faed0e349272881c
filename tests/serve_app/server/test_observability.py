"""Drift, the queue, a JSON log without observations, and the dashboard, as operators see them."""

from __future__ import annotations

import contextlib
import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets.sync.client
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed, InvalidStatus

from bundles import write_box_policy
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.contract import BakedStep
from rlservo.bundle.spaces import BoxSpec
from rlservo.client.formats.msgpack_arrays import pack
from rlservo.policy.drift import EVERY, Drift
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.logs import LOGGER, configure
from rlservo.serve_app.server.settings import ServerSettings
from servers import exchange, over_uvicorn
from stores import control_of, load_store

MEAN, STD = np.linspace(-2, 2, 27), np.linspace(0.5, 3, 27)
DASHBOARD = Path(__file__).resolve().parents[3] / "deploy" / "grafana.json"
SECRET = 0.7316523


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ur5 whose contract says what its filter saw in training, as the exporter writes it."""
    folder = write_box_policy(tmp_path_factory.mktemp("filtered"))
    contract = bundle_files.read_contract(folder)
    values = {"count": 9000, "mean": MEAN.tolist(), "std": STD.tolist(), "clip": None, "demean": True, "destd": True}
    steps = (BakedStep(step="mean_std_filter", values=values), *contract.baked_in[1:])
    bundle_files.write_contract(folder, contract.model_copy(update={"baked_in": steps}))
    return folder


@pytest.fixture
def log_file(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "log.jsonl"
    for handler in list(logging.getLogger(LOGGER).handlers):
        logging.getLogger(LOGGER).removeHandler(handler)
        handler.close()
    logging.getLogger(LOGGER).propagate = True


def post(port: int, path: str, body: Any, **headers: str) -> tuple[int, bytes]:
    reply = exchange(port, "POST", path, body, **headers)
    return reply.status, reply.content


def scrape(port: int) -> dict[tuple[str, ...], float]:
    text = exchange(port, "GET", "/metrics").content.decode()
    return {
        (sample.name, *(value for key, value in sorted(sample.labels.items()) if key != "replica")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_observations_at_home_show_no_drift_and_those_that_moved_show_which_element_and_how_far(filtered: Path) -> None:
    drift = Drift.of(bundle_files.read_contract(filtered))
    assert drift is not None and drift.elements[:2] == ("element_0", "element_1")
    rng = np.random.default_rng(0)
    for _ in range(200):
        drift.add((MEAN + STD * rng.standard_normal((32, 27))).astype(np.float32))
    assert drift.looks == 200
    assert np.abs(drift.shift).max() < 0.1 and np.abs(drift.spread - 1).max() < 0.1
    moved = MEAN + 3 * STD * (np.arange(27) == 4)
    for _ in range(3000):
        drift.add((moved + STD * 2 * rng.standard_normal((4, 27))).astype(np.float32))
    assert drift.shift[4] == pytest.approx(3, abs=0.3)
    assert np.abs(np.delete(drift.shift, 4)).max() < 0.3
    assert drift.spread == pytest.approx(2, abs=0.3)


def test_an_element_that_never_moved_in_training_gives_a_finite_drift(filtered: Path) -> None:
    contract = bundle_files.read_contract(filtered)
    step = contract.baked_in[0]
    still = step.model_copy(update={"values": {**step.values, "std": [0.0] * 27}})
    drift = Drift.of(contract.model_copy(update={"baked_in": (still,)}))
    assert drift is not None
    drift.add(np.full((1, 27), 1e30, np.float32))
    assert np.isfinite(drift.shift).all() and np.isfinite(drift.spread).all()


def test_a_policy_without_a_filter_has_no_drift(ur5: Path, filtered: Path) -> None:
    assert Drift.of(bundle_files.read_contract(ur5)) is None
    contract = bundle_files.read_contract(filtered)
    other = BoxSpec(shape=(3,), dtype="float32", low=None, high=None)
    assert Drift.of(contract.model_copy(update={"observation_space": other})) is None


def test_drift_of_served_requests_is_a_metric_per_element(filtered: Path) -> None:
    store = load_store(filtered)
    with over_uvicorn(create_app(control_of(store), ServerSettings(), replica="r")) as port:
        obs = MEAN + 2 * STD * (np.arange(27) == 7)
        for _ in range(3 * EVERY):
            assert post(port, "/v1/policies/ur5/act", {"obs": obs.tolist()})[0] == 200
        seen = scrape(port)
        assert seen["rlservo_observation_looks_total", "ur5", "1"] == 3
        assert seen["rlservo_observation_shift", "element_7", "ur5", "1"] == pytest.approx(2, rel=1e-3)
        assert seen["rlservo_observation_shift", "element_6", "ur5", "1"] == pytest.approx(0, abs=1e-3)
        assert seen["rlservo_observation_spread", "element_7", "ur5", "1"] == pytest.approx(0, abs=1e-2)
        assert seen["rlservo_queue_longest",] >= 1 and seen["rlservo_requests_incoming",] == 0


@pytest.mark.parametrize("values", [False, True])
def test_the_log_says_what_happened_and_values_only_when_asked(ur5: Path, log_file: Path, values: bool) -> None:
    settings = ServerSettings(log_file=str(log_file), log_requests=True, log_values=values)
    store = load_store(ur5)
    configure(settings, replica="r9")
    with over_uvicorn(create_app(control_of(store), settings)) as port:
        obs = [SECRET] * 27
        assert post(port, "/v1/policies/ur5/act", {"obs": obs}, x_request_id="cell-7/1")[0] == 200
        assert post(port, "/v1/policies/ur5/act", {"obs": [f"{SECRET}"] * 27}, x_request_id='x"\\{}')[0] == 422
        assert post(port, "/v1/policies/nobody/act", {"obs": obs}, x_request_id="z" * 999)[0] == 404
        tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": obs}
        assert post(port, "/v2/models/ur5/infer", {"inputs": [tensor]}, x_request_id="oip-1")[0] == 200
    text = log_file.read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    assert [(line["protocol"], line["code"], line["request_id"][:8]) for line in lines] == [
        ("json", "ok", "cell-7/1"),
        ("json", "bad-observation", 'x"\\{}'),
        ("json", "unknown-policy", "z" * 8),
        ("oip", "ok", "oip-1"),
    ]
    assert all(line["replica"] == "r9" and re.fullmatch(r"\d{4}-.*\.\d{3}Z", line["time"]) for line in lines)
    assert (lines[0]["policy"], lines[0]["version"], lines[0]["batch"]) == ("ur5", "10", 1) and lines[0]["ms"] > 0
    assert len(lines[2]["request_id"]) == 128
    assert ("error" in lines[1]) is values
    assert str(SECRET)[:6] not in text or values


def test_requests_on_streams_are_logged_like_others(ur5: Path, log_file: Path) -> None:
    settings = ServerSettings(log_file=str(log_file), log_requests=True)
    store = load_store(ur5)
    configure(settings)
    with over_uvicorn(create_app(control_of(store), settings)) as port:
        address = f"ws://127.0.0.1:{port}/v1/policies/ur5"

        def connect(path: str) -> Any:
            headers = {"x-request-id": "cell-7"}
            return websockets.sync.client.connect(f"{address}{path}", additional_headers=headers)

        with connect("/stream?errors=keep") as stream:
            for request in (
                {"obs": [SECRET] * 27, "seq": 3},
                {"obs": [SECRET] * 26, "seq": 4},
                {"obs": [SECRET] * 27, "seq": 5, "deadline_ms": 0},
                {"obs": [SECRET] * 27},
            ):
                stream.send(pack(request))
            for _ in range(5):
                stream.recv()
        with connect("/stream") as stream, contextlib.suppress(ConnectionClosed):
            stream.send(b"\xc1")
            while True:
                stream.recv()
        with pytest.raises(InvalidStatus):
            connect("/versions/99/stream")
    lines = [json.loads(line) for line in log_file.read_text().splitlines()]
    assert [(line["code"], line.get("seq")) for line in lines] == [
        ("ok", 3), ("bad-observation", 4), ("deadline-passed", 5), ("ok", None),
        ("bad-request", None), ("unknown-version", None),
    ]  # fmt: skip
    assert {(line["protocol"], line["policy"], line["request_id"]) for line in lines} == {
        ("websocket", "ur5", "cell-7")
    }
    assert all(line["ms"] > 0 for line in lines[:5]) and lines[0]["version"] == "10"
    assert str(SECRET)[:6] not in log_file.read_text()


def test_the_dashboard_asks_for_metrics_that_exist(filtered: Path, tmp_path: Path) -> None:
    store = load_store(filtered)
    with over_uvicorn(create_app(control_of(store), ServerSettings(record=str(tmp_path)), replica="r")) as port:
        assert post(port, "/v1/policies/ur5/act", {"obs": [0.0] * 27})[0] == 200
        assert post(port, "/v1/policies/ur5/act", {"obs": [0.0]})[0] == 422
        assert post(port, "/v1/policies/ur5/act", {"obs": [0.0] * 27, "session_id": "s", "reset": True})[0] == 200
        end = {"obs": [0.0] * 27, "session_id": "s", "final_status": "success"}
        assert post(port, "/v1/policies/ur5/act", end)[0] == 200
        # These need a stream and an administered server.
        exposed = {name for name, *_ in scrape(port)} | {"rlservo_streams", "rlservo_plan_generation"}
        labels = set(re.findall(r"(\w+)=\"", exchange(port, "GET", "/metrics").content.decode()))
        labels.add("instance")  # Prometheus adds it
    dashboard = json.loads(DASHBOARD.read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    assert len(queries) >= 8
    queries += [variable["query"] for variable in dashboard["templating"]["list"] if variable["type"] == "query"]
    asked: set[str] = set()
    for query in queries:
        names = set(re.findall(r"rlservo_\w+", query))
        names = {name for name in names if not name.startswith("rlservo_sessions")}  # those need an LSTM
        assert names <= exposed, f"{query}: {names - exposed} is exposed by nothing"
        asked |= names
        for group in re.findall(r"by \(([^)]*)\)", query) + re.findall(r"\{([^}]*)\}", query):
            used = set(re.findall(r"(\w+)(?=\s*(?:=|!|,|$))", re.sub(r'"[^"]*"', '""', group)))
            assert used <= labels, f"{query}: no label {used - labels}"
    left_out = {name for name in exposed if not name.endswith(("_created", "_sum", "_count"))} - asked
    left_out -= {"rlservo_start_time_seconds"}  # by which a promotion sees that a process replaced another
    assert not left_out, f"no panel shows {left_out}"
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(set(ids)) == len(ids)
