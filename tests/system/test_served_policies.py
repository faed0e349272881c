"""Shipped policies over HTTP do what the project promises, with seeds that training never saw."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rlservo.export.commands.verify import verify_bundle
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.rollout.control_loop import rollout
from servers import ShippedServer

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINTS = ROOT / "examples" / "checkpoints"
UR5, MIR100 = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/NoObstacleNavigationMir100Sim-v0"

pytestmark = [pytest.mark.serve, pytest.mark.slow]


def test_the_operator_administers_with_the_key_that_serve_wrote(shipped_server: ShippedServer) -> None:
    url, runtime = shipped_server.url, shipped_server.runtime
    (key,) = (runtime / "rlservo").iterdir()
    assert key.stat().st_mode & 0o777 == 0o600
    done = subprocess.run(
        [sys.executable, "-m", "rlservo.deploy.cli", "policy", "alias", "ur5", "production=1", "--url", url],
        capture_output=True, text=True, timeout=120, env={**os.environ, "XDG_RUNTIME_DIR": str(runtime)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ur5: default 1, loaded 1; aliases production=1" in done.stdout


def test_ur5_reaches_95_percent_of_random_targets(shipped_server: ShippedServer) -> None:
    with PolicyClient(shipped_server.url, "ur5") as policy:
        report = rollout(policy, UR5, episodes=200, seed=31_000)
    assert report.success_rate is not None
    assert report.success_rate >= 0.95, report.final_status


def test_mir100_reaches_98_percent_of_random_targets(shipped_server: ShippedServer) -> None:
    with PolicyClient(shipped_server.url, "mir100") as policy:
        report = rollout(policy, MIR100, episodes=200, seed=32_000)
    assert report.success_rate is not None
    assert report.success_rate >= 0.98, report.final_status


@pytest.mark.parametrize(("name", "checkpoint", "env_id"), [
    ("ur5", "ur5_positioning", UR5), ("mir100", "mir100_navigation", MIR100),
])  # fmt: skip
def test_returns_are_the_rllib_checkpoints_own(shipped: Path, name: str, checkpoint: str, env_id: str) -> None:
    result = verify_bundle(
        shipped / name, CHECKPOINTS / checkpoint, env_id=env_id, episodes=10, first_seed=33_000,
        notify=lambda line: None,
    )  # fmt: skip
    found = result.evaluation
    assert found is not None
    assert found.success_rate_bundle == found.success_rate_checkpoint
    assert found.return_bundle == pytest.approx(found.return_checkpoint, rel=1e-2)
