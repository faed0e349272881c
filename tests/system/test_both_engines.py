"""Contract of the server, held by the embedded engine and by Ray Serve alike."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest

from bundles import write_slow_policy
from clusters import KEY, Cluster
from loads import Load, busiest
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import ObservationError, UnauthenticatedError
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from servers import LiveServer
from waiting import wait_for

pytestmark = [pytest.mark.serve, pytest.mark.slow]

OBS = np.linspace(-0.5, 0.5, 27, dtype=np.float32)


@dataclass(frozen=True)
class Engine:
    """A running server and the policy that answers for ur5."""

    port: int
    grpc_port: int
    key: str
    policy: Policy

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            every = {"authorization": f"Bearer {self.key}", "content-type": "application/json", **(headers or {})}
            connection.request(method, path, body, {name: value for name, value in every.items() if value})
            reply = connection.getresponse()
            return reply.status, reply.headers, reply.read()
        finally:
            connection.close()


@pytest.fixture(params=["embedded", "ray serve"], scope="module")
def engine(request: pytest.FixtureRequest, policies: Path) -> Engine:
    if request.param == "embedded":
        server: LiveServer = request.getfixturevalue("live_server")
        return Engine(server.port, server.grpc_port, server.key, Policy.load(policies / "ur5"))
    cluster: Cluster = request.getfixturevalue("cluster")
    return Engine(cluster.port, cluster.grpc_port, KEY, Policy.load(cluster.repository / "ur5" / "1"))


Act = Callable[[Engine], Any]


def over_json(engine: Engine) -> Any:
    with PolicyClient(engine.url, "ur5", api_key=engine.key, timeout_s=30) as policy:
        return policy.act(OBS)


def over_a_websocket(engine: Engine) -> Any:
    with StreamClient(engine.url, "ur5", api_key=engine.key, timeout_s=30) as policy:
        return policy.act(OBS)


def over_oip(engine: Engine) -> Any:
    _, _, content = engine.ask("GET", "/v2/models/ur5")
    name = json.loads(content)["inputs"][0]["name"]
    tensor = {"name": name, "shape": [1, 27], "datatype": "FP32", "data": OBS.tolist()}
    status, _, content = engine.ask("POST", "/v2/models/ur5/infer", json.dumps({"inputs": [tensor]}).encode())
    assert status == 200, content
    return json.loads(content)["outputs"][0]["data"]


def over_grpc(engine: Engine) -> Any:
    metadata = (("authorization", f"Bearer {engine.key}"), ("application", "rlservo"))
    with grpc.insecure_channel(f"127.0.0.1:{engine.grpc_port}") as channel:

        def call(method: str, request: Any, reply: Any) -> Any:
            multicall = channel.unary_unary(f"/inference.GRPCInferenceService/{method}")
            content = multicall(request.SerializeToString(), metadata=metadata, timeout=30, wait_for_ready=True)
            return reply.FromString(content)

        described = call("ModelMetadata", messages.ModelMetadataRequest(name="ur5"), messages.ModelMetadataResponse)
        request = messages.ModelInferRequest(model_name="ur5", raw_input_contents=[OBS.tobytes()])
        request.inputs.add(name=described.inputs[0].name, datatype="FP32", shape=[1, 27])
        reply = call("ModelInfer", request, messages.ModelInferResponse)
    return np.frombuffer(reply.raw_output_contents[0], np.float32)


@pytest.mark.parametrize("act", [over_json, over_a_websocket, over_oip, over_grpc])
def test_every_protocol_gives_the_policys_action(engine: Engine, act: Act) -> None:
    expected = np.asarray(engine.policy.act(OBS), np.float64).ravel()
    np.testing.assert_allclose(np.asarray(act(engine), np.float64).ravel(), expected, rtol=1e-6, atol=1e-7)


def test_an_observation_of_the_wrong_length_is_refused_by_its_element(engine: Engine) -> None:
    with PolicyClient(engine.url, "ur5", api_key=engine.key, timeout_s=30) as policy:
        with pytest.raises(ObservationError, match="27"):
            policy.act(OBS[:-1])
        broken = OBS.copy()
        broken[3] = np.nan
        with pytest.raises(ObservationError):
            policy.act(broken)


def test_without_a_key_nothing_of_the_policies_is_told(engine: Engine) -> None:
    with PolicyClient(engine.url, "ur5", timeout_s=30) as policy, pytest.raises(UnauthenticatedError):
        policy.act(OBS)
    for path in ("/v1/policies", "/metrics", "/v2/models/ur5"):
        assert engine.ask("GET", path, headers={"authorization": ""})[0] == 401
    assert engine.ask("GET", "/v2/health/ready", headers={"authorization": ""})[0] == 200


def test_replies_carry_the_requests_id_once(engine: Engine) -> None:
    body = json.dumps({"obs": OBS.tolist()}).encode()
    trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
    given = {"x-request-id": "robot-7-41", "traceparent": trace}
    status, headers, _ = engine.ask("POST", "/v1/policies/ur5/act", body, given)
    assert status == 200 and headers.get_all("x-request-id") == ["robot-7-41"]
    assert headers.get_all("traceparent") == [trace]
    _, headers, _ = engine.ask("POST", "/v1/policies/ur5/act", body)
    (made,) = headers.get_all("x-request-id") or ()
    assert made and headers.get_all("traceparent") is None


def test_a_key_in_a_trailer_is_no_key(engine: Engine) -> None:
    body = json.dumps({"obs": OBS.tolist()}).encode()
    connection = http.client.HTTPConnection("127.0.0.1", engine.port, timeout=30)
    connection.putrequest("POST", "/v1/policies/ur5/act")
    connection.putheader("content-type", "application/json")
    connection.putheader("transfer-encoding", "chunked")
    connection.endheaders()
    trailer = f"authorization: Bearer {engine.key}\r\n"
    connection.send(b"%x\r\n%s\r\n0\r\n%s\r\n" % (len(body), body, trailer.encode()))
    status = connection.getresponse().status
    connection.close()
    assert status in (400, 401)  # behind Ray Serve a chunked body is refused altogether


def test_another_hosts_request_and_another_pages_are_refused(engine: Engine) -> None:
    body = json.dumps({"obs": OBS.tolist()}).encode()
    assert engine.ask("POST", "/v1/policies/ur5/act", body, {"host": "evil.example"})[0] == 403
    assert engine.ask("POST", "/v1/policies/ur5/act", body, {"origin": "http://evil.example"})[0] == 403


def test_every_replica_of_a_cluster_follows_the_plan_of_the_repository(cluster: Cluster) -> None:
    headers = {"authorization": f"Bearer {KEY}"}

    def candidates() -> dict[str, str | None]:
        """The version that the alias points to by each replica, by its name."""
        found: dict[str, str | None] = {}
        deadline = time.monotonic() + 60
        while len(found) < 2:
            connection = http.client.HTTPConnection("127.0.0.1", cluster.port, timeout=30)
            connection.request("GET", "/v1/policies", headers=headers)
            listing = json.loads(connection.getresponse().read())
            connection.close()
            (ur5,) = (policy for policy in listing["policies"] if policy["name"] == "ur5")
            found[listing["replica"]] = ur5["aliases"].get("candidate")
            assert time.monotonic() < deadline, found
        return found

    def follow(version: str | None) -> None:
        deadline = time.monotonic() + 30
        while set(candidates().values()) != {version}:
            assert time.monotonic() < deadline

    with cluster.admin() as admin:
        admin.load("ur5", "2")
        admin.alias("ur5", "candidate", "2")
    follow("2")
    done = cluster.run("rlservo.deploy.cli", "policy", "alias", "ur5", "candidate=", "--repository", cluster.repository)
    assert done.returncode == 0 and "loaded 1, 2;" in done.stdout, done.stdout + done.stderr
    follow(None)
    with cluster.admin() as admin:
        admin.unload("ur5", "2")


def test_metrics_and_the_status_page_are_served(engine: Engine) -> None:
    over_json(engine)
    status, _, text = engine.ask("GET", "/metrics")
    assert status == 200 and b"rlservo_requests_total" in text
    status, _, page = engine.ask("GET", "/", headers={"accept": "text/html"})
    assert status == 200 and b"<html" in page.lower()


@pytest.fixture
def load(cluster: Cluster) -> Load:
    versions = [Policy.load(cluster.repository / "ur5" / version).act(OBS) for version in ("1", "2")]
    return Load(cluster.port, "ur5", OBS.tolist(), [np.asarray(action) for action in versions], api_key=KEY)


def test_no_request_fails_while_the_production_version_changes_on_a_cluster(cluster: Cluster, load: Load) -> None:
    url = f"http://127.0.0.1:{cluster.port}"
    with cluster.admin() as admin, PolicyClient(url, "ur5", api_key=KEY, timeout_s=30) as policy:
        admin.load("ur5", "2")
        with load.run():
            for version, right in zip(("2", "1"), load.expected[::-1], strict=True):
                admin.alias("ur5", "production", version)
                deadline = time.monotonic() + 30
                in_a_row = 0
                while in_a_row < 20:  # both replicas follow
                    in_a_row = in_a_row + 1 if np.allclose(policy.act(OBS), right, rtol=1e-6) else 0
                    assert time.monotonic() < deadline
        plan = admin.unload("ur5", "2")["generation"]
    assert load.asked > 50 and (load.wrong, load.failures) == (0, [])
    following: dict[str, int] = {}
    deadline = time.monotonic() + 30
    while [*following.values()] != [plan, plan]:  # by a connection for each look
        assert time.monotonic() < deadline, following
        with cluster.admin() as admin:
            shown = admin.listing()
        following[shown["replica"]] = shown["generation"]


def test_what_answers_on_a_cluster_does_not_give_way_to_other_programs(cluster: Cluster) -> None:
    answering = {"ServeReplica", "HAProxyManager", "haproxy"}
    found: dict[str, set[int]] = {}
    for process in cluster.root.children(recursive=True):
        for name in answering:
            if name in process.name() or any(name in word for word in process.cmdline()[:1]):
                found.setdefault(name, set()).add(process.nice())
    assert found == {name: {cluster.root.nice()} for name in answering}


def test_a_replica_that_is_killed_is_replaced_and_its_clients_ask_another(cluster: Cluster, load: Load) -> None:
    before = cluster.replica_pids()
    assert len(before) == 2
    with load.run():
        time.sleep(1)
        os.kill(before[0], signal.SIGKILL)
        deadline = time.monotonic() + 120
        while before[0] in (now := cluster.replica_pids()) or len(now) != 2:
            assert time.monotonic() < deadline, now
            time.sleep(0.5)
        time.sleep(2)
    cluster.wait_for_status("RUNNING")
    assert load.asked > 50 and (load.wrong, load.failures) == (0, [])


def test_a_replica_that_dies_is_logged_by_its_successor_with_the_version_it_was_computing(cluster: Cluster) -> None:
    action = Policy.load(write_slow_policy(cluster.repository, version="9")).act(OBS)
    load = Load(cluster.port, "ur5", OBS.tolist(), [np.asarray(action)], api_key=KEY, pause_s=0.0, version="9")

    def logged() -> set[str]:
        files = list(cluster.folder.rglob("worker-*.err"))
        return {line for file in files for line in file.read_text(errors="replace").splitlines() if "died" in line}

    with cluster.admin() as admin:
        admin.load("ur5", "9")
    loaded: dict[str, bool] = {}

    def is_loaded() -> bool:
        """Return whether both replicas have it, by a connection for each look."""
        with cluster.admin() as admin:
            listing = admin.listing()
        (ur5,) = [each for each in listing["policies"] if each["name"] == "ur5"]
        loaded[listing["replica"]] = "9" in ur5["versions"]
        return [*loaded.values()] == [True, True]

    wait_for(is_loaded)
    with load.run():
        time.sleep(2)
        killed = busiest(cluster.replica_pids())
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda: killed not in (now := cluster.replica_pids()) and len(now) == 2)
        wait_for(lambda: any(f"process {killed}) died" in line for line in logged()))
    cluster.wait_for_status("RUNNING")
    assert any("died while computing version 9 of policy 'ur5'" in line for line in logged())
    with cluster.admin() as admin:
        admin.unload("ur5", "9")
    shutil.rmtree(cluster.repository / "ur5" / "9")
