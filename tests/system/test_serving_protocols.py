"""Every protocol of the embedded server, with keys on."""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import InvalidStatus

from rlservo.policy.policy import Policy
from servers import LiveServer, ask, exchange

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


def test_a_stream_is_answered(live_server: LiveServer, ur5: Path) -> None:
    url = f"ws://127.0.0.1:{live_server.port}/"
    with (
        Policy.load(ur5) as policy,
        websockets.sync.client.connect(
            url, additional_headers={"authorization": f"Api-Key {live_server.key}"}
        ) as stream,
    ):
        assert msgpack.unpackb(stream.recv())["policy"] == "ur5"
        for seq in range(200):
            obs = BATCH[seq]
            packed = {b"__ndarray__": True, b"data": obs.tobytes(), b"dtype": "<f4", b"shape": [27]}
            stream.send(msgpack.packb({"obs": packed, "seq": seq}))
            reply = msgpack.unpackb(stream.recv())
            action = np.frombuffer(reply["actions"][b"data"], reply["actions"][b"dtype"])
            assert reply["seq"] == seq
            np.testing.assert_allclose(action, policy.act(obs), rtol=1e-5, atol=1e-6)
        stream.send("text")
        assert json.loads(stream.recv())["code"] == "bad-request"


def test_without_a_key_nothing_gets_through(live_server: LiveServer) -> None:
    for method, path in (("GET", "/v1/policies"), ("POST", "/v1/policies/ur5/act"), ("POST", "/v2/models/ur5/infer")):
        status, reply = ask(live_server.port, method, path, {}, "nobody")
        assert (status, reply["code"]) == (401, "unauthenticated")
    with pytest.raises(InvalidStatus) as caught:
        websockets.sync.client.connect(f"ws://127.0.0.1:{live_server.port}/").__enter__()
    assert caught.value.response.status_code == 401
    assert json.loads(caught.value.response.body or b"")["code"] == "unauthenticated"


def test_prometheus_reads_what_the_replica_answered(live_server: LiveServer) -> None:
    ask(live_server.port, "POST", "/v1/policies/ur5/act", {"obs": BATCH[0].tolist()}, live_server.key)
    status, headers, text = exchange(live_server.port, "GET", "/metrics", authorization=live_server.bearer)
    assert status == 200 and headers["content-type"].startswith("text/plain")
    assert b'rlservo_requests_total{code="ok",policy="ur5",protocol="json",replica="' in text
