"""Recurrent state behind the real thing: Ray Serve, HAProxy, Triton's clients, and a replica that is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rlservo.export.contract.errors import DeadlineError, SessionLostError, UnavailableError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.recording.episodes import Episode, episodes
from rlservo.serve_app.recording.reader import Recording
from rlservo.serve_app.runtime.policy import Policy
from servers import LiveServer

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


def recorded_episodes(recording: Recording) -> list[Episode]:
    """Return the episodes of three clients before a kill; the state that is carried may go on for a step after it."""
    return [
        one
        for one in episodes(recording)
        if one.begins
        and len(one) in (3, 4)
        and one.policy.contract.name == MODEL
        and np.array_equal(one.obs["obs"][:3], SEEN[:3])
    ]


def test_a_killed_replica_takes_its_memories_along_and_its_clients_learn_of_it(
    live_server: LiveServer, expected: list[np.ndarray]
) -> None:
    url, key = f"http://127.0.0.1:{live_server.port}", live_server.key
    (replica,) = live_server.run.processes("ServeReplica")
    with (
        PolicyClient(url, MODEL, api_key=key, deadline_ms=500) as carrying,
        PolicyClient(url, MODEL, api_key=key, server_state=True, deadline_ms=500) as held,
        StreamClient(url, MODEL, api_key=key, server_state=True, deadline_ms=500) as streaming,
    ):
        clients: list[PolicyClient | StreamClient] = [carrying, held, streaming]
        for step in range(3):
            for client in clients:
                np.testing.assert_allclose(client.act(SEEN[step]), expected[step], rtol=1e-4, atol=1e-5)
        # A killed replica's recording lacks the last second, or more where its writer had to wait for a processor.
        deadline = time.monotonic() + 60
        while len(recorded_episodes(Recording(live_server.recorded))) < 3:
            assert time.monotonic() < deadline
            time.sleep(0.2)
        os.kill(replica, signal.SIGKILL)
        for client in (held, streaming):
            deadline = time.monotonic() + 60
            while True:  # nothing but errors until the loss is told: never an action from a memory begun anew
                assert time.monotonic() < deadline
                with pytest.raises((SessionLostError, UnavailableError, DeadlineError)) as caught:
                    client.act(SEEN[3])
                if caught.errisinstance(SessionLostError):
                    break
                time.sleep(0.05)
        np.testing.assert_allclose(carrying.act(SEEN[3]), expected[3], rtol=1e-4, atol=1e-5)
        for client in (held, streaming):
            client.reset()
            np.testing.assert_allclose(client.act(SEEN[0]), expected[0], rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(client.act(SEEN[1]), expected[1], rtol=1e-4, atol=1e-5)
    recording = Recording(live_server.recorded)
    assert len(recorded_episodes(recording)) >= 3  # of before the kill
    assert any(not facts.whole and facts.damage is None for facts in recording.files)
