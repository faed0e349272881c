"""Every query of the dashboard and every alert, run by a real Prometheus that scrapes a running server."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import time
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from bundles import write_box_policy
from rlservo.bundle import bundle as bundle_files
from rlservo.bundle.contract import BakedStep
from rlservo.client.stream_client import StreamClient
from rlservo.errors import RlservoError
from rlservo.policy.drift import EVERY
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from servers import ROOT, LiveServer, ask, free_ports, launched, over_uvicorn
from stores import control_of, load_store

pytestmark = [pytest.mark.serve, pytest.mark.slow]

DEPLOY = ROOT / "deploy"
RULES = yaml.safe_load((DEPLOY / "alerts.yaml").read_text())["groups"][0]["rules"]
QUERIES = [
    target["expr"]
    for panel in json.loads((DEPLOY / "grafana.json").read_text())["panels"]
    for target in panel["targets"]
]
CASES = Path(__file__).with_name("alerts.yaml")
THRESHOLD = re.compile(r"\s*(>|==)\s*[\d.]+\s*$")  # of an alert; what stands before it is drawn all the time
WINDOW = "30s"
PATIENCE_S = 120


@pytest.fixture(scope="module")
def promtool() -> str:
    found = shutil.which("promtool")
    if found is None or shutil.which("prometheus") is None:
        pytest.skip("there is no Prometheus here (Debian: apt-get install prometheus)")
    return found


def test_the_rules_are_well_formed_and_fire_when_they_should(promtool: str) -> None:
    for words in (
        ["check", "rules", DEPLOY / "alerts.yaml"],
        ["test", "rules", Path(__file__).with_name("alerts.yaml")],
    ):
        done = subprocess.run([promtool, *map(str, words)], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
    tested = yaml.safe_load(CASES.read_text())["tests"]
    fired = {case["alertname"] for test in tested for case in test["alert_rule_test"] if case.get("exp_alerts")}
    assert fired == {rule["alert"] for rule in RULES}


def test_every_panel_shows_the_servers_that_are_chosen() -> None:
    series = [named for query in QUERIES for named in re.findall(r"rlservo_\w+(\{[^}]*\})?", query)]
    assert len(series) >= len(QUERIES) and all('instance=~"$instance"' in labels for labels in series)


def test_the_rules_name_codes_that_there_are() -> None:
    named = {
        code for rule in RULES for codes in re.findall(r'code=~"([^"]*)"', rule["expr"]) for code in codes.split("|")
    }
    kinds: list[type[RlservoError]] = [RlservoError]
    known = set()
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        known.add(kind.code)
    assert named and named <= known


@pytest.fixture(scope="module")
def drifting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a server in this process, whose policy was asked for what it was not trained on."""
    folder = write_box_policy(tmp_path_factory.mktemp("filtered"))
    contract = bundle_files.read_contract(folder)
    still = {"count": 9000, "mean": [0.0] * 27, "std": [1.0] * 27, "clip": None, "demean": True, "destd": True}
    steps = (BakedStep(step="mean_std_filter", values=still), *contract.baked_in[1:])
    bundle_files.write_contract(folder, contract.model_copy(update={"baked_in": steps}))
    store = load_store(folder)
    with over_uvicorn(create_app(control_of(store), ServerSettings(), replica="drifting")) as port:
        for _ in range(3 * EVERY):
            assert ask(port, "POST", "/v1/policies/ur5/act", {"obs": [4.0] * 27})[0] == 200
        yield port


class Prometheus:
    """A Prometheus of our own, with the configuration that compose uses."""

    def __init__(self, port: int, process: subprocess.Popen[bytes]) -> None:
        self.port, self.process = port, process

    def ask(self, path: str, **parameters: str) -> Any:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.request("GET", f"{path}?{urllib.parse.urlencode(parameters)}")
            document = json.loads(connection.getresponse().read())
        finally:
            connection.close()
        assert document["status"] == "success", document
        return document["data"]

    def query(self, expression: str) -> list[Any]:
        return self.ask("/api/v1/query", query=expression)["result"]  # type: ignore[no-any-return]

    def wait_for(self, expression: str) -> list[Any]:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            assert self.process.poll() is None
            try:
                if found := self.query(expression):
                    return found
            except (OSError, http.client.HTTPException, ValueError):
                pass  # not up yet
            time.sleep(0.1)
        raise AssertionError(f"no series of {expression}")


@pytest.fixture(scope="module")
def prometheus(
    promtool: str, live_server: LiveServer, drifting: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Prometheus]:
    folder = tmp_path_factory.mktemp("prometheus")
    with scraping(folder, live_server.key, live_server.port, drifting) as running:
        yield running


@contextmanager
def scraping(folder: Path, key: str, *ports: int) -> Iterator[Prometheus]:
    """Run a Prometheus with the configuration that compose uses, for these ports of this machine."""
    (folder / "key").write_text(key)
    configuration = yaml.safe_load((DEPLOY / "compose" / "prometheus.yaml").read_text())
    (job,) = configuration["scrape_configs"]
    assert configuration["rule_files"] and job["authorization"]["credentials_file"] and job["static_configs"]
    configuration["global"] = {"scrape_interval": "250ms", "evaluation_interval": "250ms", "scrape_timeout": "250ms"}
    configuration["rule_files"] = [str(DEPLOY / "alerts.yaml")]
    job["authorization"]["credentials_file"] = str(folder / "key")
    job["static_configs"] = [{"targets": [f"127.0.0.1:{each}" for each in ports]}]
    job["scrape_timeout"] = job["scrape_interval"] = "2s"  # a busy machine
    (folder / "prometheus.yaml").write_text(yaml.safe_dump(configuration))
    (port,) = free_ports(1)
    process = subprocess.Popen(
        ["prometheus", f"--config.file={folder / 'prometheus.yaml'}", f"--storage.tsdb.path={folder / 'data'}",
         f"--web.listen-address=127.0.0.1:{port}", "--log.level=error"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder,
    )  # fmt: skip
    try:
        yield Prometheus(port, process)
    finally:
        process.terminate()
        process.wait(30)


@pytest.fixture(scope="module")
def scraped(prometheus: Prometheus, live_server: LiveServer) -> Iterator[Prometheus]:
    """Prometheus, after it has seen every kind of request before and after."""
    port, key = live_server.port, live_server.key
    obs = np.zeros(3, np.float32)
    with StreamClient(f"http://127.0.0.1:{port}", "lstm_box", api_key=key) as stream:
        stream.act(obs)  # a session on a stream, and a stream

        def everything(turn: int) -> None:
            fields = {"obs": [0.0] * 27}
            assert ask(port, "POST", "/v1/policies/ur5/act", fields, key)[0] == 200
            assert ask(port, "POST", "/v1/policies/ur5/act", {"obs": [0.0]}, key)[0] == 422
            assert ask(port, "POST", "/v1/policies/ur5/act", {**fields, "deadline_ms": 0}, key)[0] == 408
            session = {"obs": [0.0] * 3, "session_id": f"prometheus-{turn}", "reset": True}
            assert ask(port, "POST", "/v1/policies/lstm_box/act", session, key)[0] == 200
            end = {**session, "reset": False, "end": True, "final_status": "success"}
            assert ask(port, "POST", "/v1/policies/lstm_box/act", end, key)[0] == 200

        everything(0)
        replica = 'rlservo_requests_total{policy="lstm_box",protocol="json",code="ok"}'
        (seen,) = prometheus.wait_for(replica)
        everything(1)
        prometheus.wait_for(f"{replica} > {seen['value'][1]}")
        yield prometheus


@pytest.mark.parametrize("expression", QUERIES)
def test_every_query_of_the_dashboard_has_series(scraped: Prometheus, expression: str) -> None:
    asked = expression.replace("$__rate_interval", WINDOW).replace('"$policy"', '".*"').replace('"$instance"', '".*"')
    assert "$" not in asked
    assert scraped.query(asked), asked


ONE_OF_OURS = 'last_over_time(rlservo_uptime_seconds{replica=~"[0-9]*"}[1w])'


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_every_alert_looks_at_series_that_are_there(scraped: Prometheus, rule: dict[str, Any]) -> None:
    expression = rule["expr"]
    if (absent := re.fullmatch(r"absent\((.*)\)", expression)) is not None:
        assert scraped.query(expression) == [] and scraped.query(absent[1])
        return
    if rule["alert"] == "RlservoServerDown":
        assert scraped.query(expression) == []
        assert scraped.query(f"up == 1 and on (job, instance) {ONE_OF_OURS}") and ONE_OF_OURS in expression
        return
    if rule["alert"] == "RlservoWorkersDie":
        return  # this server has one process; that of two below has the series
    drawn = THRESHOLD.sub("", expression)
    assert drawn != expression
    drawn = drawn.replace('{code="over-capacity"}', "")  # no request was turned away here
    assert scraped.query(drawn), drawn


def test_prometheus_took_the_rules_and_only_what_is_so_is_pending_or_fires(scraped: Prometheus) -> None:
    (group,) = scraped.ask("/api/v1/rules")["groups"]
    assert [rule["name"] for rule in group["rules"]] == [rule["alert"] for rule in RULES]
    assert all(rule["lastError"] == "" if "lastError" in rule else True for rule in group["rules"])
    scraped.wait_for('ALERTS{alertname="RlservoObservationsFarFromTraining"}')
    about = {each["metric"]["alertname"] for each in scraped.query("ALERTS")}
    assert not about & {"RlservoNoReplica", "RlservoKeyFileUnusable"}


def test_two_embedded_servers_are_two_and_the_one_that_dies_is_named(
    promtool: str, policies: Path, tmp_path: Path
) -> None:
    (unrelated,) = free_ports(1)
    with launched(policies) as first, launched(policies, workers=2) as second:
        for run in (first, second):
            run.wait_until_ready()
        with scraping(tmp_path, "", first.port, second.port, unrelated) as prometheus:
            one, other = (f"127.0.0.1:{run.port}" for run in (first, second))
            prometheus.wait_for("count(group by (instance) (rlservo_uptime_seconds)) == 2")
            (keys,) = [rule["expr"] for rule in RULES if rule["alert"] == "RlservoKeyFileUnusable"]
            shown = prometheus.query(keys.replace("== 0", ">= 0"))
            assert sorted(each["metric"]["instance"] for each in shown) == sorted([one, other, other])
            assert prometheus.query('ALERTS{alertname="RlservoServerDown"}') == []
            assert {each["metric"]["instance"] for each in prometheus.query("rlservo_workers_lost_total")} == {other}
            (worker, *_) = second.processes("spawn_main")
            os.kill(worker, signal.SIGKILL)
            died = prometheus.wait_for('ALERTS{alertname="RlservoWorkersDie"}')
            assert [each["metric"]["instance"] for each in died] == [other]
            first.process.kill()
            down = prometheus.wait_for('ALERTS{alertname="RlservoServerDown"}')
            assert [each["metric"]["instance"] for each in down] == [one]
            assert prometheus.query(f'up{{instance="127.0.0.1:{unrelated}"}}')[0]["value"][1] == "0"
