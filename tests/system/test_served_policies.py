"""Shipped policies over HTTP do what the project promises, with seeds that training never saw."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bundles import SHIPPED
from command_line import rlservo_here
from rlservo.client.policy_client import PolicyClient
from rlservo.drive.control_loop import rollout
from rlservo.policy.policy import Policy
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


@pytest.mark.parametrize(("name", "env_id", "seed"), [("ur5", UR5, 31_000), ("mir100", MIR100, 32_000)])
def test_random_targets_are_reached_over_http_as_in_process(
    shipped_server: ShippedServer, shipped: Path, name: str, env_id: str, seed: int
) -> None:
    with Policy.load(shipped / name) as policy, PolicyClient(shipped_server.url, name) as client:
        local, served = (rollout(acting, env_id, episodes=20, seed=seed) for acting in (policy, client))
    assert local.successes is not None and local.successes >= 15  # the rate itself: test_shipped_policies.py
    for over_http, in_process in zip(served.episodes, local.episodes, strict=True):
        assert (over_http.seed, over_http.steps) == (in_process.seed, in_process.steps)
        assert (over_http.success, over_http.final_status) == (in_process.success, in_process.final_status)
        assert over_http.episode_return == pytest.approx(in_process.episode_return, rel=1e-6)


@pytest.mark.parametrize(("name", "checkpoint", "env_id"), [
    ("ur5", SHIPPED["ur5"], UR5), ("mir100", SHIPPED["mir100"], MIR100),
])  # fmt: skip
def test_returns_are_the_rllib_checkpoints_own(
    shipped: Path, tmp_path: Path, name: str, checkpoint: str, env_id: str
) -> None:
    bundle = shutil.copytree(shipped / name, tmp_path / name)  # the evaluation is written into it
    done = rlservo_here(
        "verify", bundle, "--checkpoint", CHECKPOINTS / checkpoint, "--env", env_id, "--episodes", 4,
        "--seed", 33_000, "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["evaluation"]
    assert found["success_rate_bundle"] == found["success_rate_checkpoint"]
    assert found["return_bundle"] == pytest.approx(found["return_checkpoint"], rel=1e-2)
