"""The Stable-Baselines3 script as a user starts it, shortened; its bundle is served and drives the arm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rlservo.client.policy_client import PolicyClient
from rlservo.drive.control_loop import rollout
from rlservo.policy.policy import Policy
from servers import launched

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

UR5 = "rlservo/EndEffectorPositioningURSim-v0"


@pytest.mark.serve
@pytest.mark.slow
def test_a_short_training_is_exported_served_and_driven_with(run_here: Callable[..., Any], tmp_path: Path) -> None:
    arguments = ("--stop-timesteps", "1", "--num-episodes-during-inference", "1")
    done = run_here("training_inference_ur_sb3.py", *arguments, home=tmp_path)
    assert done.code == 0, done.err
    model = tmp_path / "runs" / "ur5-sb3"
    assert {file.name for file in model.iterdir()} == {"model.zip", "vecnormalize.pkl"}
    assert f"VecNormalize is the one of {Path('runs')}" in done.out.replace(f"{tmp_path}/", "")
    folder = tmp_path / "runs" / "policies"
    with Policy.load(folder / "ur5-sb3") as policy:
        assert policy.contract.provenance.source == "sb3" and policy.contract.provenance.env_steps == 8192
        assert policy.contract.baked_in[0].values["count"] > 8000
        local = rollout(policy, UR5, episodes=1, seed=3)
    with launched(folder) as run:
        run.wait_until_ready()
        with PolicyClient(f"http://127.0.0.1:{run.port}", "ur5-sb3") as client:
            served = rollout(client, UR5, episodes=1, seed=3)
    assert served.episodes[0].episode_return == local.episodes[0].episode_return
    assert served.episodes[0].steps == local.episodes[0].steps


def test_wrong_arguments_are_refused_in_a_sentence(run_here: Callable[..., Any], tmp_path: Path) -> None:
    done = run_here("training_inference_ur_sb3.py", "--stop-timesteps", "0", home=tmp_path)
    assert done.code == 2 and "--stop-timesteps must be at least 1" in done.err
