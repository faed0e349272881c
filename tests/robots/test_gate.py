"""The evaluation that a real arm requires is one of this arm: both values are named where they differ."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from arms import LIMITS, RunningArm
from rlservo.bundle.bundle import load_bundle
from rlservo.bundle.contract import Evaluation
from rlservo.drive.disturbance_table import evaluations_of, measure_disturbances
from rlservo.drive.real_robot_gate import check_proven
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy

pytest.importorskip("rtde_control")

SIMULATED, REAL = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/EndEffectorPositioningURRob-v0"


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def evaluations(shipped: Path) -> dict[str, dict[str, Any]]:
    """Evaluations as `rlservo verify --disturb --write` makes them, by the arm's model."""
    found = {}
    with Policy.load(shipped / "ur5" / "1") as policy:
        for model in ("ur5", "ur3"):
            table = measure_disturbances(
                policy, SIMULATED, ["latency=1,noise=real"], episodes=16, env_kwargs={"ur_model": model},
                progress=lambda _: None,
            )  # fmt: skip
            found[model] = evaluations_of(table, "2026-11-28")[1].model_dump()
    return found


def test_evaluation_of_another_arm_does_not_let_a_policy_drive_this_one(
    arm: RunningArm, shipped: Path, state: Path, evaluations: dict[str, dict[str, Any]]
) -> None:
    contract = load_bundle(shipped / "ur5" / "1").contract
    env = gym.make(
        REAL, robot=f"rtde://{arm.host}", ur_model="ur5", confirm=False, limits=LIMITS, disable_env_checker=True
    )

    def check(model: str, **changes: Any) -> None:
        good = {"success_interval": (0.9, 1.0), "success_rate_bundle": 1.0, "endings": {"success": 16}}
        evaluation = Evaluation(**{**evaluations[model], **good, **changes})
        check_proven(contract.model_copy(update={"evaluations": (evaluation,)}), env)

    try:
        with pytest.raises(UsageError, match=r"has 1 cycles of latency, but the robot's was never measured"):
            check("ur5")
        with pytest.raises(UsageError, match=r"has ur_model ur3, but the robot has ur5"):
            check("ur3")
        with pytest.raises(UsageError, match=r"has ur_model unknown, but the robot has ur5"):
            check("ur5", robot={})
        with pytest.raises(
            UsageError, match=r"is of rlservo/EmptyEnvironmentURSim-v0, but the robot's is rlservo/EndEff"
        ):
            check("ur5", env_id="rlservo/EmptyEnvironmentURSim-v0")
        with pytest.raises(UsageError, match=r"has 2 collisions in 16 episodes, but a real robot allows 5%"):
            check("ur5", endings={"success": 14, "collision": 2})
    finally:
        env.close()

    words = ["robot-latency", f"rtde://{arm.host}", "--ur-model", "ur5", "--steps", "5", "--yes", "--json"]
    arm.server.link.latency_s = 0.08  # there and back, with servoj's lag: more than 2 cycles of 0.1 s
    measured = subprocess.run(
        [sys.executable, "-m", "rlservo.deploy.cli", *words, "--limit", "watchdog_hz=1"], capture_output=True,
        text=True, check=False, env=os.environ | {"XDG_STATE_HOME": str(state)},
    )  # fmt: skip
    assert measured.returncode == 0, measured.stderr
    cycles = json.loads(measured.stdout)["cycles"]
    assert cycles > 2
    with pytest.raises(UsageError, match=rf"has 1 cycles of latency, but the robot has up to {cycles} "):
        check("ur5")
    check("ur5", disturbance=f"latency={cycles},noise=real")
