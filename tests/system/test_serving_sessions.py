"""Recurrent state behind a real server: Triton's clients, and workers that are killed."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import DeadlineError, SessionLostError, UnavailableError
from rlservo.policy.policy import Policy
from servers import LiveServer, launched
from storages import RedisServer

pytestmark = [pytest.mark.serve, pytest.mark.slow]

CLIENT = Path(__file__).resolve().parents[1] / "clients" / "triton_sequences.py"
TRITON = ("tritonclient[http,grpc]==2.71.0",)
MODEL = "lstm_box"
SEEN = [np.random.default_rng(i).uniform(-1, 1, 3).astype(np.float32) for i in range(40)]


@pytest.fixture(scope="module")
def expected(recurrent: Path) -> list[np.ndarray]:
    with Policy.load(recurrent / MODEL) as policy:
        return [policy.act(obs) for obs in SEEN]


def test_tritons_clients_keep_sequences_over_every_way_they_have(
    live_server: LiveServer, recurrent: Path, client_environment: Callable[..., Path]
) -> None:
    addresses = [f"127.0.0.1:{port}" for port in (live_server.port, live_server.grpc_port)]
    seen = np.stack(SEEN[:12])
    done = subprocess.run(
        [str(client_environment(*TRITON)), str(CLIENT), *addresses, MODEL, live_server.key],
        input=json.dumps({"obs": seen.tolist()}),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    got = json.loads(done.stdout)
    refusals = got.pop("refusals")
    assert set(got) == {"http", "http async", "http aio", "grpc", "grpc async", "grpc aio", "stream"}
    with Policy.load(recurrent / MODEL) as policy:
        for order in (seen, seen[::-1]):
            policy.reset()
            expected = [policy.act(obs) for obs in order]
            for way, actions in got.items():
                np.testing.assert_allclose(
                    actions[0 if order is seen else 1], expected, rtol=1e-4, atol=1e-5, err_msg=way
                )
    assert len(refusals) == 4 and all("begin" in refusal for refusal in refusals), refusals


def test_when_workers_are_killed_streams_learn_of_it_and_sessions_in_redis_go_on(
    redis_server: RedisServer, recurrent: Path, expected: list[np.ndarray]
) -> None:
    with (
        launched(recurrent, workers=2, settings={"session_store": redis_server.url}) as run,
        contextlib.ExitStack() as stack,
    ):
        run.wait_until_ready()
        url = f"http://127.0.0.1:{run.port}"
        carrying = stack.enter_context(PolicyClient(url, MODEL, deadline_ms=5000))
        held = stack.enter_context(PolicyClient(url, MODEL, server_state=True, deadline_ms=5000))
        streaming = stack.enter_context(StreamClient(url, MODEL, server_state=True, deadline_ms=5000))
        for step in range(3):
            for client in (carrying, held, streaming):
                np.testing.assert_array_equal(client.act(SEEN[step]), expected[step])
        for worker in run.processes("spawn_main"):
            os.kill(worker, signal.SIGKILL)
        for client in (carrying, held):
            np.testing.assert_array_equal(until_answered(client, SEEN[3]), expected[3])
        with pytest.raises(SessionLostError):
            until_answered(streaming, SEEN[3])
        streaming.reset()
        for step in range(2):
            np.testing.assert_array_equal(until_answered(streaming, SEEN[step]), expected[step])


def until_answered(client: PolicyClient | StreamClient, obs: np.ndarray) -> np.ndarray:
    """Ask until there is a server again."""
    deadline = time.monotonic() + 60
    while True:
        try:
            return np.asarray(client.act(obs))
        except (UnavailableError, DeadlineError):
            assert time.monotonic() < deadline
            time.sleep(0.05)
