"""Requests for more resources than exist: refused in a sentence, or reported while a run waits."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def scripts() -> Any:
    """The scripts as modules."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        names = ("shared.resources", "shared.training_inference", "training_inference_ur")
        yield SimpleNamespace(**{name.rpartition(".")[2]: importlib.import_module(name) for name in names})


@pytest.mark.parametrize("algorithm", ["PPO", "APPO", "IMPALA", "SAC"])
@pytest.mark.parametrize("gpus", [0.0, 1.0])
def test_robo_gyms_scripts_ask_for_no_more_cores_than_there_are(scripts: Any, algorithm: str, gpus: float) -> None:
    arguments = SimpleNamespace(run=algorithm, num_envs_per_env_runner=8, seed=0)
    for cores in range(1, 9):
        task = scripts.training_inference_ur.TASK
        config = scripts.training_inference.algorithm_config(task, arguments, cores, gpus)
        asked, _ = scripts.resources.size(scripts.resources.request_of(config))
        assert asked == cores
        assert config.num_env_runners == max(2, cores - 1)


def node(cpus: float, gpus: float = 0.0) -> dict[str, float]:
    return {"CPU": cpus, "GPU": gpus}


def test_a_process_must_fit_one_machine(scripts: Any) -> None:
    room, check = scripts.resources.Room, scripts.resources.check_room
    check([node(1)] * 5, room("the cluster", (node(2), node(3))))
    check([node(0.5)] * 2 + [node(1)], room("the cluster", (node(2),)))
    with pytest.raises(
        Exception, match=r"6 CPUs asked for \(6 processes with 1 CPU each\); the cluster has 5 CPUs: resume on"
    ):
        check([node(1)] * 6, room("the cluster", (node(2), node(3))))
    with pytest.raises(
        Exception, match=r"1 process with 4 CPUs asked for, each on one machine; .* have 2 CPUs, 3 CPUs: ask for"
    ):
        check([node(4)], room("the cluster", (node(2), node(3))))
    with pytest.raises(Exception, match=r"1 GPU asked for \(1 process with 1 CPU and 1 GPU, 2 with 1 CPU each\)"):
        check([node(1, 1), node(1), node(1)], room("the cluster", (node(4),)))


def test_trials_at_once_must_fit_and_a_growing_cluster_is_not_judged(scripts: Any) -> None:
    room, check = scripts.resources.Room, scripts.resources.check_room
    check([node(2)], room("the cluster", (node(3), node(3))), concurrent=2)
    with pytest.raises(Exception, match=r"3 trials at once asked for, .* the cluster has room for 2: leave --max-conc"):
        check([node(2)], room("the cluster", (node(3), node(3))), concurrent=3)
    check([node(200)], room("the cluster", (node(3),), grows=True), concurrent=3)


@pytest.mark.slow
@pytest.mark.parametrize("script", ["simple_trainer", "training_inference_mir"])
def test_run_that_needs_more_than_this_machine_has_is_not_resumed(script: str, run_here: Any, tmp_path: Path) -> None:
    run = {"algorithm": "PPO", "env_id": "CartPole-v1", "env_config": {}, "num_cpus": 401, "swept": []}
    run |= {"num_cpus": 0} if script != "simple_trainer" else {}
    rest = {"log_level": "ERROR", "app_dir": "."}
    (tmp_path / "run.json").write_text(json.dumps(run | {"request": [{"CPU": 1.0}] * 401, "rest": rest}))
    ended = run_here(f"{script}.py", "--resume", str(tmp_path), home=tmp_path)
    assert ended.code == 2
    assert re.search(
        r"40\d CPUs asked for .*; this machine has \d+ CPUs?: resume on a machine that has as many", ended.err
    )
