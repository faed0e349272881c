"""The real thing, with Ray and HAProxy: what it answers, what it loads and where it listens."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.engines.local import serve_policies
from rlservo.serve_app.runtime.policy import Policy
from servers import LiveServer, ask

pytestmark = [pytest.mark.serve, pytest.mark.slow]

ROOT = Path(__file__).resolve().parents[2]
OBS = [round(0.01 * i, 2) for i in range(27)]


def test_the_served_action_is_the_policys_own(live_server: LiveServer, policies: Path) -> None:
    status, reply = ask(live_server.port, "POST", "/v1/policies/ur5/act", {"obs": OBS, "seq": 3}, key=live_server.key)
    assert (status, reply["version"], reply["seq"]) == (200, "10", 3)
    np.testing.assert_allclose(reply["action"], Policy.load(policies / "ur5" / "10").act(OBS), rtol=1e-6)
    assert ask(live_server.port, "POST", "/v1/policies/gridworld/act", {"obs": 1}, key=live_server.key)[0] == 200


def test_errors_pass_the_proxy_unchanged_and_the_server_goes_on(live_server: LiveServer) -> None:
    cases = [
        ("/v1/policies/ur5/act", {"obs": OBS[:26]}, 422, "bad-observation"),
        ("/v1/policies/ur5/act", b'{"obs": [NaN]}', 422, "bad-observation"),
        ("/v1/policies/ur5/act", b"{", 400, "bad-request"),
        ("/v1/policies/ur6/act", {"obs": OBS}, 404, "unknown-policy"),
        ("/v1/policies/ur5/act", {"obs": OBS, "deadline_ms": 0}, 408, "deadline-passed"),
    ]
    for path, body, status, code in cases * 5:
        got, reply = ask(live_server.port, "POST", path, body, key=live_server.key)
        assert (got, reply["code"]) == (status, code)
    assert ask(live_server.port, "POST", "/v1/policies/ur5/act", {"obs": OBS}, key=live_server.key)[0] == 200


def test_health_and_documentation_are_served(live_server: LiveServer) -> None:
    assert ask(live_server.port, "GET", "/v2/health/ready") == (200, {"ready": True})
    assert ask(live_server.port, "GET", "/healthz") == (200, b"OK")
    assert ask(live_server.port, "GET", "/openapi.json", key=live_server.key)[1]["openapi"] == "3.0.3"
    assert b"swagger-ui-bundle.js" in ask(live_server.port, "GET", "/docs", key=live_server.key)[1]


def test_a_replica_loads_no_torch_and_nothing_else_it_does_not_need(live_server: LiveServer) -> None:
    replicas = live_server.run.processes("ServeReplica")
    assert len(replicas) == 1
    maps = Path(f"/proc/{replicas[0]}/maps").read_text()
    assert "onnxruntime" in maps  # the right process is looked at
    for library in ("/torch/", "/mujoco/", "/onnx/"):
        assert library not in maps, library


def test_no_process_of_the_server_loads_pandas(live_server: LiveServer) -> None:
    """Serve imports it for data frames, in each process."""
    pythons = [pid for name in ("ray::", "cluster_process") for pid in live_server.run.processes(name)]
    maps = [Path(f"/proc/{pid}/maps").read_text() for pid in pythons]
    assert sum("/ray/_raylet.so" in text for text in maps) >= 5  # cluster, controller, two of the proxy, replica
    assert not any("/pandas/" in text for text in maps)


def test_only_the_asked_for_address_serves_http(live_server: LiveServer) -> None:
    """Replicas, statistics and metrics of HAProxy listen on loopback; 0100007F is 127.0.0.1 as /proc writes it."""
    ours = set()
    for pid in live_server.run.processes("haproxy"):
        with contextlib.suppress(OSError):
            for link in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    ours.add(str(link.readlink()))
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = [row[1].split(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in ours]
    assert len(listening) >= 3 and set(listening) == {"0100007F"}


def test_a_second_server_on_the_port_is_refused_before_anything_starts(live_server: LiveServer, policies: Path) -> None:
    before = set(live_server.run.processes())
    held = rf"port {live_server.port} on 127.0.0.1 is in use by 'haproxy' .*running server: stop that server"
    with pytest.raises(UsageError, match=held):
        serve_policies([policies], port=live_server.port)
    assert set(live_server.run.processes()) == before
