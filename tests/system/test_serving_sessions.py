"""Memories behind the real thing: Ray Serve, HAProxy, several replicas, and a replica that is killed."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rlservo.export.contract.errors import DeadlineError, SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.stream_client import StreamClient
from rlservo.serve_app.ray_serve.launcher import serve_policies
from rlservo.serve_app.ray_serve.processes import free_ports
from rlservo.serve_app.runtime.policy import Policy

pytestmark = [pytest.mark.serve, pytest.mark.slow]

CLIENT = Path(__file__).resolve().parents[1] / "clients" / "triton_sequences.py"
TRITON = ("tritonclient[http,grpc]==2.71.0",)
MODEL = "lstm_box"
SPOOR = "RLSERVO_TEST_SESSIONS"
SEEN = [np.random.default_rng(i).uniform(-1, 1, 3).astype(np.float32) for i in range(40)]


@contextlib.contextmanager
def serving(policies: Path, replicas: int, grpc_port: int | None = None) -> Iterator[tuple[str, str]]:
    """Serve; give (address, mark of its processes)."""
    (port,) = free_ports(1)
    mark = os.environ[SPOOR] = secrets.token_hex(8)
    ready, stop = threading.Event(), threading.Event()
    failures: list[Exception] = []

    def serve() -> None:
        try:
            serve_policies(
                [policies], port=port, grpc_port=grpc_port, replicas=replicas, on_ready=lambda _: ready.set(), stop=stop
            )
        except Exception as error:
            failures.append(error)
            ready.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert ready.wait(120) and not failures, failures
        yield f"http://127.0.0.1:{port}", mark
    finally:
        del os.environ[SPOOR]
        stop.set()
        thread.join(60)
    assert not thread.is_alive()


def replicas_of(mark: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                ours = f"{SPOOR}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0")
                if ours and b"ServeReplica" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
    return found


@pytest.fixture(scope="module")
def expected(recurrent: Path) -> list[np.ndarray]:
    with Policy.load(recurrent / "lstm_box") as policy:
        return [policy.act(obs) for obs in SEEN]


def test_with_two_replicas_states_and_streams_keep_an_episode_and_ids_are_refused(
    recurrent: Path, expected: list[np.ndarray]
) -> None:
    with serving(recurrent, 2) as (url, mark):
        assert len(replicas_of(mark)) == 2
        with (
            PolicyClient(url, "lstm_box") as carrying,
            StreamClient(url, "lstm_box", server_state=True) as streaming,
            PolicyClient(url, "lstm_box", server_state=True) as refused,
        ):
            for obs, action in zip(SEEN, expected, strict=True):
                np.testing.assert_allclose(carrying.act(obs), action, rtol=1e-4, atol=1e-5)
                np.testing.assert_allclose(streaming.act(obs), action, rtol=1e-4, atol=1e-5)
            with pytest.raises(SessionError, match="several replicas"):
                refused.act(SEEN[0])


@pytest.fixture(scope="module")
def alone(recurrent: Path) -> Iterator[tuple[str, str, int]]:
    """One replica: (address, mark of its processes, gRPC port)."""
    (grpc_port,) = free_ports(1)
    with serving(recurrent, 1, grpc_port) as (url, mark):
        yield url, mark, grpc_port


def test_tritons_clients_keep_sequences_over_every_way_they_have(
    alone: tuple[str, str, int], recurrent: Path, client_environment: Callable[..., Path]
) -> None:
    url, _, grpc_port = alone
    seen = np.stack(SEEN[:12])
    done = subprocess.run(
        [str(client_environment(*TRITON)), str(CLIENT), url.removeprefix("http://"), f"127.0.0.1:{grpc_port}", MODEL],
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


def test_a_killed_replica_takes_its_memories_along_and_its_clients_learn_of_it(
    alone: tuple[str, str, int], expected: list[np.ndarray]
) -> None:
    url, mark, _ = alone
    (replica,) = replicas_of(mark)
    with (
        PolicyClient(url, "lstm_box", deadline_ms=500) as carrying,
        PolicyClient(url, "lstm_box", server_state=True, deadline_ms=500) as held,
        StreamClient(url, "lstm_box", server_state=True, deadline_ms=500) as streaming,
    ):
        clients: list[PolicyClient | StreamClient] = [carrying, held, streaming]
        for step in range(3):
            for client in clients:
                np.testing.assert_allclose(client.act(SEEN[step]), expected[step], rtol=1e-4, atol=1e-5)
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
