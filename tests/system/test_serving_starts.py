"""Servers that are started here because starting and ending them is what is tested, and what they leave behind.

The ways to end a running one are those of the servers that other tests use: SIGINT and SIGTERM in servers.py, SIGKILL
in test_serving_replicas.py, Ctrl-C twice in test_remote_repository.py.
"""

from __future__ import annotations

import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from rlservo.export.contract.errors import BundleError, UsageError
from rlservo.serve_app.ray_serve.environment import cluster_environment, proxy_files, proxy_ports
from rlservo.serve_app.ray_serve.launcher import serve_policies
from rlservo.serve_app.ray_serve.ports import free_ports
from servers import ask, launched, running, wait_until_served

pytestmark = [pytest.mark.serve, pytest.mark.slow]

ROOT = Path(__file__).resolve().parents[2]
OBS = [round(0.01 * i, 2) for i in range(27)]


def test_importing_the_application_pulls_in_no_training_code() -> None:
    heavy = ["torch", "ray.rllib", "ray.tune", "gymnasium", "mujoco", "onnx"]
    code = f"import sys, rlservo.serve_app.ray_serve.app; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "[]"


def test_arguments_and_bundles_are_checked_before_anything_starts(policies: Path, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    with pytest.raises(BundleError, match="does not exist"):
        serve_policies([tmp_path / "nowhere"], port=port)
    with pytest.raises(UsageError, match="replicas must be 1 or more"):
        serve_policies([policies], port=port, replicas=0)
    with pytest.raises(UsageError, match="threads"):
        serve_policies([policies], port=port, settings={"threads": -1})


@pytest.mark.parametrize(
    ("number", "after_s"),
    [(signal.SIGINT, 2.0), (signal.SIGTERM, 4.5), (signal.SIGKILL, 3.5)],
    ids=["SIGINT", "SIGTERM", "SIGKILL"],
)
def test_a_server_ended_while_it_starts_leaves_nothing(policies: Path, number: signal.Signals, after_s: float) -> None:
    with launched(policies, with_admin_key=True) as run:
        deadline = time.monotonic() + 60
        while not run.left() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(after_s)
        code = run.end(number)
        if number == signal.SIGKILL:  # it could not remove its folder; the cluster's process must
            assert code == -signal.SIGKILL


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serve_run_with_the_shipped_configuration_answers_and_ends_clean(
    policies: Path, tmp_path: Path, number: signal.Signals
) -> None:
    for _ in range(3):
        ray_folder = Path(tempfile.mkdtemp(prefix="r"))
        try:
            serve_run(policies, tmp_path / "serve.yaml", ray_folder, number)
            return
        except AssertionError:
            if not raylet_gave_up(ray_folder):
                raise
        finally:
            shutil.rmtree(ray_folder, ignore_errors=True)
    pytest.fail("Ray's agents have not chosen their ports within 15 s, three times")


def raylet_gave_up(ray_folder: Path) -> bool:
    """Whether the machine was too busy for Ray's own command (docs/operations.md, "On a slow or busy machine")."""
    logs = ray_folder.glob("ray/session_2*/logs/raylet.*")
    return any("Timed out waiting for file" in log.read_text(errors="replace") for log in logs)


def serve_run(policies: Path, file: Path, ray_folder: Path, number: signal.Signals) -> None:
    import grpc
    import yaml

    port, grpc_port = free_ports(2)
    configuration = yaml.safe_load((ROOT / "deploy" / "serve.yaml").read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    configuration["applications"][0]["args"]["policies"] = [str(policies)]
    file.write_text(yaml.safe_dump(configuration))
    environment = {
        **cluster_environment(ray_folder),
        **proxy_ports(),
        **proxy_files(ray_folder),
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_TMPDIR": str(ray_folder),
        "RAY_enable_worker_prestart": "0",  # a process for each core, beside those that Serve starts
    }
    program = str(Path(sys.executable).with_name("serve"))
    with running([program, "run", str(file)], port, **environment) as run:
        output: list[str] = []
        assert run.process.stdout is not None
        # Read on, so that the pipe never fills.
        drain = threading.Thread(target=output.extend, args=(run.process.stdout,), daemon=True)
        drain.start()
        wait_until_served(run, output)
        status, reply = ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})
        assert status == 200, "".join(output)
        assert len(reply["action"]) == 6
        with grpc.insecure_channel(f"127.0.0.1:{grpc_port}") as channel:
            live = channel.unary_unary("/inference.GRPCInferenceService/ServerLive")
            assert live(b"", timeout=20, wait_for_ready=True) == b"\x08\x01"  # field 1, true
        run.end(number, folders=False)  # Ray's dashboard leaves an empty one
        drain.join()
