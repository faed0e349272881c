"""The embedded server in a process of its own: replies and loaded modules."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rlservo.policy.policy import Policy
from servers import LiveServer, ask

pytestmark = [pytest.mark.serve, pytest.mark.slow]

ROOT = Path(__file__).resolve().parents[2]
OBS = [round(0.01 * i, 2) for i in range(27)]


def test_the_served_action_is_the_policys_own(live_server: LiveServer, policies: Path) -> None:
    status, reply = ask(live_server.port, "POST", "/v1/policies/ur5/act", {"obs": OBS, "seq": 3}, key=live_server.key)
    assert (status, reply["version"], reply["seq"]) == (200, "10", 3)
    np.testing.assert_allclose(reply["action"], Policy.load(policies / "ur5" / "10").act(OBS), rtol=1e-6)
    assert ask(live_server.port, "POST", "/v1/policies/gridworld/act", {"obs": 1}, key=live_server.key)[0] == 200


def test_errors_are_told_and_the_server_goes_on(live_server: LiveServer) -> None:
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


def test_health_is_served(live_server: LiveServer) -> None:
    assert ask(live_server.port, "GET", "/v2/health/ready") == (200, {"ready": True})
    assert ask(live_server.port, "GET", "/healthz") == (200, b"OK")


def test_the_server_loads_nothing_that_it_does_not_need(live_server: LiveServer) -> None:
    maps = Path(f"/proc/{live_server.run.process.pid}/maps").read_text()
    assert "onnxruntime" in maps  # the right process is looked at
    for library in ("/torch/", "/mujoco/", "/onnx/", "/ray/", "/pandas/"):
        assert library not in maps, library
