"""Shipped policies over HTTP do what the project promises, with seeds that training never saw."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rlservo.export.commands.export import export_checkpoint
from rlservo.export.commands.verify import verify_bundle
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.ray_serve.processes import free_ports
from rlservo.serve_app.rollout.control_loop import rollout

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINTS = ROOT / "examples" / "checkpoints"
UR5, MIR100 = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/NoObstacleNavigationMir100Sim-v0"

pytestmark = [pytest.mark.serve, pytest.mark.slow]


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("served")
    for checkpoint, name in (("ur5_positioning", "ur5"), ("mir100_navigation", "mir100")):
        export_checkpoint(CHECKPOINTS / checkpoint, out, name=name, notify=lambda line: None)
    return out


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `rlservo serve` keeps its operator's key."""
    return tmp_path_factory.mktemp("runtime")


@pytest.fixture(scope="module")
def url(policies: Path, runtime: Path) -> Iterator[str]:
    """The two policies behind `rlservo serve`, as a user starts it."""
    (port,) = free_ports(1)
    server = subprocess.Popen(
        [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(policies), "--port", str(port)],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, "XDG_RUNTIME_DIR": str(runtime)},
    )
    try:
        with PolicyClient(f"http://127.0.0.1:{port}", "ur5") as probe_client:
            probe_client.wait_until_ready(120.0)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)
    assert list((runtime / "rlservo").iterdir()) == []  # the key went with the server


def test_the_operator_administers_with_the_key_that_serve_wrote(url: str, runtime: Path) -> None:
    (key,) = (runtime / "rlservo").iterdir()
    assert key.stat().st_mode & 0o777 == 0o600
    done = subprocess.run(
        [sys.executable, "-m", "rlservo.deploy.cli", "policy", "alias", "ur5", "production=1", "--url", url],
        capture_output=True, text=True, timeout=120, env={**os.environ, "XDG_RUNTIME_DIR": str(runtime)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ur5: default 1, loaded 1; aliases production=1" in done.stdout


def test_ur5_reaches_95_percent_of_random_targets(url: str) -> None:
    with PolicyClient(url, "ur5") as policy:
        report = rollout(policy, UR5, episodes=200, seed=31_000)
    assert report.success_rate is not None
    assert report.success_rate >= 0.95, report.final_status


def test_mir100_reaches_98_percent_of_random_targets(url: str) -> None:
    with PolicyClient(url, "mir100") as policy:
        report = rollout(policy, MIR100, episodes=200, seed=32_000)
    assert report.success_rate is not None
    assert report.success_rate >= 0.98, report.final_status


@pytest.mark.parametrize(("name", "checkpoint", "env_id"), [
    ("ur5", "ur5_positioning", UR5), ("mir100", "mir100_navigation", MIR100),
])  # fmt: skip
def test_returns_are_the_rllib_checkpoints_own(policies: Path, name: str, checkpoint: str, env_id: str) -> None:
    result = verify_bundle(
        policies / name, CHECKPOINTS / checkpoint, env_id=env_id, episodes=10, first_seed=33_000,
        notify=lambda line: None,
    )  # fmt: skip
    found = result.evaluation
    assert found is not None
    assert found.success_rate_bundle == found.success_rate_checkpoint
    assert found.return_bundle == pytest.approx(found.return_checkpoint, rel=1e-2)
