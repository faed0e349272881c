"""The embedded server on a machine with a full disk, a clock set back, a proxy, or no loopback interface."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import pytest

from namespaces import in_own_namespace
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from servers import ROOT, launched

pytestmark = pytest.mark.serve

OBS = [round(0.01 * i, 2) for i in range(27)]
PATIENCE_S = 120  # [s] on a busy machine
PROXY = "http://127.0.0.1:9"  # nothing is there

# As `ntpdate` does it: the time of day jumps when the file appears.
CLOCK = """
import os, time
real, real_ns = time.time, time.time_ns
def set_back(): return 3600 if os.path.exists(os.environ["CLOCK_SET_BACK"]) else 0
time.time = lambda: real() - set_back()
time.time_ns = lambda: real_ns() - set_back() * 10**9
"""
ASK_MANAGER = """
import sys
sys.path.insert(0, "examples")
from robo_gym_client import VERIFY, answers
print(answers("127.0.0.1", int(sys.argv[1]), VERIFY))
"""


def test_a_full_disk_ends_the_recording_and_nothing_else(policies: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    script = f'mount -t tmpfs -o size=64k tmpfs "{disk}" && exec "$@"'
    prefix = (*in_own_namespace("--mount"), "sh", "-c", script, "sh")
    with launched(policies, settings={"record": str(disk)}, prefix=prefix) as run:
        run.wait_until_ready()
        deadline = time.monotonic() + PATIENCE_S
        asked = 0
        with PolicyClient(f"http://127.0.0.1:{run.port}", "ur5", timeout_s=30) as policy:
            while not any("No space left" in line for line in run.output):
                policy.act(OBS)
                asked += 1
                assert time.monotonic() < deadline, asked
            for _ in range(10):
                policy.act(OBS)
        assert run.end(signal.SIGTERM) == 0
    (said,) = [line for line in run.output if "No space left" in line]
    assert "Traceback" not in said


def test_a_clock_that_is_set_back_stops_neither_sessions_nor_streams(
    policies: Path, recurrent: Path, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(CLOCK)
    jump = tmp_path / "jump"
    variables = {"PYTHONPATH": str(tmp_path), "CLOCK_SET_BACK": str(jump)}
    record = {"record": str(tmp_path / "recorded")}
    with launched(policies, recurrent, settings=record, **variables) as run:
        run.wait_until_ready()
        url = f"http://127.0.0.1:{run.port}"
        with (
            PolicyClient(url, "ur5", timeout_s=30, retries=0) as kept,
            StreamClient(url, "ur5", timeout_s=30) as stream,
            PolicyClient(url, "lstm_box", timeout_s=30, server_state=True) as session,
        ):
            obs = session.contract.observation_space
            zeros = [0.0] * obs.shape[0]
            for client, given in ((kept, OBS), (stream, OBS), (session, zeros)):
                client.act(given)
            jump.touch()
            for _ in range(5):
                for client, given in ((kept, OBS), (stream, OBS), (session, zeros)):
                    client.act(given)
            assert stream.reconnects == 0
        assert run.end(signal.SIGTERM) == 0
    assert not [line for line in run.output if '"error"' in line or "Traceback" in line]


def test_clients_ask_this_machine_directly_whatever_http_proxy_says(
    policies: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "all_proxy", "grpc_proxy"):
        monkeypatch.setenv(name, PROXY)
    for name in ("no_proxy", "NO_PROXY", "no_grpc_proxy"):
        monkeypatch.delenv(name, raising=False)
    with launched(policies) as run:
        run.wait_until_ready()
        for client in (PolicyClient, StreamClient):
            with client(f"http://127.0.0.1:{run.port}", "ur5", timeout_s=30) as policy:
                policy.act(OBS)
    # A server manager, as robo-gym's client looks for one; in a process whose gRPC has read no variables yet.
    server = grpc.server(ThreadPoolExecutor(1))
    handler = grpc.unary_unary_rpc_method_handler(lambda _request, _context: b"")
    manager = "robo_gym_server_manager.grpc_msgs.server_manager.ServerManager"
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(manager, {"VerifyConnection": handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        done = subprocess.run(
            [sys.executable, "-c", ASK_MANAGER, str(port)], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S
        )
    finally:
        server.stop(None)
    assert done.stdout == "True\n", done.stderr


def test_without_a_loopback_interface_the_command_ends_with_a_sentence(
    policies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RLSERVO_PLAN", str(tmp_path))
    command = [*in_own_namespace("--net"), sys.executable, "-m", "rlservo.deploy.cli", "serve", str(policies)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr
        == "rlservo: 127.0.0.1 cannot be reached from this machine: is its interface up? (ip link set lo up)\n"
    )
