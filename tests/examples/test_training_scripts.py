"""The training scripts as a user starts them: a short real run, and what they refuse."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPTS = ("training_inference_ur.py", "training_inference_mir.py")


def run_script(script: str, *arguments: str, home: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "HOME": str(home)}  # a local Ray writes its token into the home folder
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment, cwd=home)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_short_run_trains_exports_and_runs_episodes(script: str, tmp_path: Path) -> None:
    done = run_script(
        script, "--stop-iters", "1", "--num-episodes-during-inference", "2", "--storage", "runs", home=tmp_path
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"iteration +1  steps +8,\d\d\d .* return +-?\d", done.stdout)
    assert "best checkpoint: " in done.stdout
    bundles = list((tmp_path / "runs" / "policies").glob("*/1/contract.json"))
    assert len(bundles) == 1
    assert "success" in done.stdout


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--framework", "tf"), "PyTorch only .* use --framework torch"),
        (("--run", "A3C"), "--run A3C: expected one of PPO"),
        (("--stop-iters", "0"), "--stop-iters is 0: expected at least 1"),
        (("--num-cpus", "-1"), "--num-cpus is -1: expected 0 or more"),
    ],
)
def test_wrong_argument_is_refused_in_a_sentence(
    script: str, arguments: tuple[str, str], sentence: str, tmp_path: Path
) -> None:
    done = run_script(script, *arguments, home=tmp_path)
    assert done.returncode == 2
    assert re.search(sentence, done.stderr)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_lists_robo_gyms_arguments(script: str, tmp_path: Path) -> None:
    done = run_script(script, "--help", home=tmp_path)
    for argument in (
        "--run", "--num-cpus", "--framework", "--stop-iters", "--stop-timesteps", "--stop-reward",
        "--explore-during-inference", "--num-episodes-during-inference",
    ):  # fmt: skip
        assert argument in done.stdout
