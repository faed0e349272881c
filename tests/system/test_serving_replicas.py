"""Two replicas behind the proxy: what one of them knows and the other does not, and what both have to follow."""

from __future__ import annotations

import http.client
import json
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import grpc
import numpy as np
import pytest

from rlservo.export.contract.errors import SessionError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.protocols.oip_messages import messages
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import new_key
from servers import Run, launched

pytestmark = [pytest.mark.serve, pytest.mark.slow]

OLD, OLD_LINE = new_key("cell-7")
NEW, NEW_LINE = new_key("cell-8")
OBS = [0.1] * 27
MODEL = "lstm_box"
SEEN = [np.random.default_rng(i).uniform(-1, 1, 3).astype(np.float32) for i in range(40)]


@pytest.fixture(scope="module")
def key_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of keys that the replicas follow."""
    file = tmp_path_factory.mktemp("keys") / "keys"
    file.write_text(OLD_LINE + "\n")
    return file


@pytest.fixture(scope="module")
def server(policies: Path, recurrent: Path, key_file: Path) -> Iterator[Run]:
    """A server of two replicas; SIGKILL ends its launcher, and nothing is left then."""
    settings = {"api_keys_file": str(key_file)}
    with launched(policies, recurrent, replicas=2, with_grpc=True, settings=settings) as run:
        run.wait_until_ready()
        yield run
        run.end(signal.SIGKILL)


def status(port: int, key: str) -> int:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        headers = {"content-type": "application/json", "authorization": f"Bearer {key}"}
        connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS}), headers)
        reply = connection.getresponse()
        reply.read()
        return reply.status


def wait_until_followed(port: int, statuses: dict[str, int]) -> None:
    """Wait until either replica answers each key so."""
    deadline = time.monotonic() + 30
    for key, expected in statuses.items():
        while {status(port, key) for _ in range(20)} != {expected}:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def test_states_and_streams_keep_an_episode_and_ids_are_refused(server: Run, recurrent: Path, key_file: Path) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(server.port, {OLD: 200})
    assert len(server.processes("ServeReplica")) == 2
    with Policy.load(recurrent / MODEL) as policy:
        expected = [policy.act(obs) for obs in SEEN]
    url = f"http://127.0.0.1:{server.port}"
    with (
        PolicyClient(url, MODEL, api_key=OLD) as carrying,
        StreamClient(url, MODEL, api_key=OLD, server_state=True) as streaming,
        PolicyClient(url, MODEL, api_key=OLD, server_state=True) as refused,
    ):
        for obs, action in zip(SEEN, expected, strict=True):
            np.testing.assert_allclose(carrying.act(obs), action, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(streaming.act(obs), action, rtol=1e-4, atol=1e-5)
        with pytest.raises(SessionError, match="several replicas"):
            refused.act(SEEN[0])


def test_both_follow_the_file_of_keys_and_end_grpc_streams(server: Run, key_file: Path) -> None:
    key_file.write_text(OLD_LINE + "\n")
    wait_until_followed(server.port, {OLD: 200})
    request = messages.ModelInferRequest(model_name="ur5")
    tensor = request.inputs.add(name="obs", datatype="FP32", shape=[1, 27])
    tensor.contents.fp32_contents.extend(OBS)
    go_on, stop = threading.Semaphore(1), threading.Event()

    def requests() -> Iterator[bytes]:
        while not stop.is_set():
            if go_on.acquire(timeout=1):
                yield request.SerializeToString()

    try:
        with grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel:
            stream = channel.stream_stream("/inference.GRPCInferenceService/ModelStreamInfer")(
                requests(), metadata=[("application", "rlservo"), ("authorization", f"Bearer {OLD}")]
            )
            assert not messages.ModelStreamInferResponse.FromString(next(stream)).error_message
            key_file.write_text(NEW_LINE)
            wait_until_followed(server.port, {OLD: 401, NEW: 200})
            go_on.release()
            with pytest.raises(grpc.RpcError) as caught:
                next(stream)
            assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
    finally:
        stop.set()
