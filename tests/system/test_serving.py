"""The embedded server in a process of its own: a large request, and the modules it loads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rlservo.policy.policy import Policy
from servers import LiveServer, exchange

pytestmark = [pytest.mark.serve, pytest.mark.slow]

BATCH = np.random.default_rng(3).standard_normal((1024, 27)).astype(np.float32)


def test_a_batch_of_1024_goes_through_as_binary_tensors(live_server: LiveServer, ur5: Path) -> None:
    tensor = {"name": "obs", "shape": [1024, 27], "datatype": "FP32", "parameters": {"binary_data_size": BATCH.nbytes}}
    header = json.dumps({"inputs": [tensor], "parameters": {"binary_data_output": True}}).encode()
    status, headers, reply = exchange(
        live_server.port, "POST", "/v2/models/ur5/infer", header + BATCH.tobytes(),
        authorization=live_server.bearer, content_type="application/octet-stream",
        inference_header_content_length=str(len(header)),
    )  # fmt: skip
    assert status == 200
    action = np.frombuffer(reply[int(headers["inference-header-content-length"]) :], "<f4").reshape(1024, 6)
    with Policy.load(ur5) as policy:
        np.testing.assert_allclose(action, policy.act(BATCH), rtol=1e-6)


def test_the_server_loads_nothing_that_it_does_not_need(live_server: LiveServer) -> None:
    maps = Path(f"/proc/{live_server.run.process.pid}/maps").read_text()
    assert "onnxruntime" in maps  # the right process is looked at
    for library in ("/torch/", "/mujoco/", "/onnx/", "/ray/", "/pandas/"):
        assert library not in maps, library
