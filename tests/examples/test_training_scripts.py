"""The training scripts as a user starts them: short real runs and refusals."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPTS = ("training_inference_ur.py", "training_inference_mir.py")


@pytest.mark.slow
def test_short_run_trains_exports_and_runs_episodes(trained: Any) -> None:
    run = trained("mir")
    done = run.ended
    assert done.code == 0, done.out + done.err
    # One core is enough: RLlib's two sampling processes share it.
    assert "2 sampling processes with 8 simulators each, 1 cores" in done.out
    assert "waiting for" not in done.err
    assert re.search(r"^\w+_00000 +1 +8,\d\d\d +-?\d", done.out, re.MULTILINE)
    assert "best checkpoint: " in done.out
    bundles = list((run.folder / "runs" / "policies").glob("*/1/contract.json"))
    assert len(bundles) == 1
    assert "success" in done.out.split("bundle: ")[1]
    assert {path.name for path in run.folder.iterdir()} == {"runs"}
    assert run.home <= {".cache", ".config"}


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_wrong_arguments_are_refused_in_a_sentence(script: str, run_here: Any, tmp_path: Path) -> None:
    wrong = {
        "--framework tf": "PyTorch only .* use --framework torch",
        "--run A3C": "--run A3C: expected one of PPO",
        "--stop-iters 0": "--stop-iters is 0: expected at least 1",
        "--num-cpus -1": "--num-cpus is -1: expected 0 or more",
        "--num-cpus 3500": "--num-cpus is 3500: this machine has .*; 0 is all of them",
        "--seed -1": "--seed is -1: expected 0 or more",
        "--storage /dev/null/runs": "--storage /dev/null/runs: cannot be written: Not a directory",
        "--resume .": "not the folder of a run",
    }
    for arguments, sentence in wrong.items():
        ended = run_here(script, *arguments.split(), home=tmp_path)
        assert ended.code == 2
        assert re.search(sentence, ended.err.strip().splitlines()[-1])
        assert "Traceback" not in ended.err


@pytest.mark.slow
def test_more_gpus_than_there_are_are_refused_before_anything_starts(
    run_here: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RLLIB_NUM_GPUS", "64")
    ended = run_here("training_inference_ur.py", home=tmp_path)
    assert ended.code == 2
    assert re.search(r"RLLIB_NUM_GPUS is 64: this machine has \d+ GPUs", ended.err.strip().splitlines()[-1])


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_lists_robo_gyms_arguments(script: str, run_here: Any, tmp_path: Path) -> None:
    done = run_here(script, "--help", home=tmp_path)
    assert done.code == 0
    for argument in (
        "--run", "--num-cpus", "--framework", "--stop-iters", "--stop-timesteps", "--stop-reward",
        "--explore-during-inference", "--num-episodes-during-inference",
    ):  # fmt: skip
        assert argument in done.out
    assert "default: PPO" in done.out and "None" not in done.out


@pytest.mark.parametrize(
    ("script", "task", "policy"),
    [
        ("training_inference_ur", "TASK", "ur5_positioning"),
        ("training_inference_mir", "NAVIGATION", "mir100_navigation"),
    ],
)
def test_scripts_train_with_the_settings_beside_the_policy_that_ships(
    script: str, task: str, policy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    common = importlib.import_module("shared.training_inference")
    chosen = getattr(importlib.import_module(script), task)
    args = common.argument_parser(chosen, "").parse_args([])
    settings = yaml.safe_load((EXAMPLES / "checkpoints" / policy / "training.yaml").read_text())
    config = common.algorithm_config(chosen, args, 2)
    assert (config.env, config.env_config, config.seed) == (settings["env"], settings["env_config"], settings["seed"])
    assert {name: getattr(config, name) for name in settings["training"]} == settings["training"]
    assert {name: config.model_config[name] for name in settings["model"]} == settings["model"]
    assert (args.stop_timesteps, args.stop_reward) == (settings["stop"]["env_steps"], settings["stop"]["value"])
