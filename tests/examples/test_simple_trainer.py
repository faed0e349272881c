"""The generic trainer as a new user meets it: a sweep, Ctrl-C and resuming, wrong arguments, what is left behind."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo import errors
from rlservo.policy.policy import Policy

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run_folder(sweep: Any) -> Path:
    return next(path.parent for path in sweep.home.glob("runs/*/run.json"))


@pytest.mark.slow
def test_sweep_ends_in_a_table_a_plot_the_best_checkpoint_and_a_bundle(sweep: Any) -> None:
    assert sweep.ended.code == 0, sweep.ended.out + sweep.ended.err
    run = run_folder(sweep)
    with (run / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["lr"] for row in rows} == {"0.0001", "0.001"}
    assert [row["gamma"] for row in rows] == ["0.9", "0.9"]
    scores = [float(row["best"]) for row in rows]
    assert scores == sorted(scores, reverse=True)
    assert (run / "results.png").read_bytes().startswith(b"\x89PNG")
    best = re.search(r"best checkpoint: (.*)", sweep.ended.out)
    assert best and rows[0]["trial"] in best[1] and Path(best[1]).is_dir()
    with Policy.load(sweep.home / "runs" / "policies" / "cart-pole") as policy:
        assert policy.contract.provenance.env_id == "CartPole-v1"
        assert policy.act(np.zeros(4, np.float32)) in (0, 1)
    assert "episodes" in sweep.ended.out.split("bundle: ")[1]


@pytest.mark.slow
def test_progress_has_a_row_per_iteration_and_evaluation_in_it(sweep: Any) -> None:
    rows = re.findall(r"^\w+_0000(\d) +(\d) +([\d,]+) +([\d.]+) +[\d.]+ +- +([\d.]+|-) ", sweep.ended.out, re.MULTILINE)
    assert {(trial, iteration) for trial, iteration, *_ in rows} == {(t, i) for t in "01" for i in "12"}
    # An iteration in which no episode of the evaluation ended has none to show.
    evaluated = [(trial, float(mean)) for trial, *_, mean in rows if mean != "-"]
    assert {trial for trial, _ in evaluated} == set("01") and all(mean > 0 for _, mean in evaluated)


@pytest.mark.slow
def test_every_trial_has_logs_for_tensorboard(sweep: Any) -> None:
    assert len(list(run_folder(sweep).glob("trial_*/events.out.tfevents.*"))) == 2
    assert "tensorboard --logdir" in sweep.ended.out


@pytest.mark.slow
def test_traces_are_whole_episodes_of_what_was_sent_to_the_environment(
    sweep: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from shared.episode_traces import load_traces

    episodes = list(load_traces(sweep.checkout / "traces"))
    ended = [one for one in episodes if one.ended]
    assert len(ended) > 10
    for one in ended:
        assert len(one.observations) == len(one.actions) + 1 == len(one.rewards) + 1
        assert set(one.actions) <= {0, 1}
        assert sum(one.rewards) == len(one.actions)  # CartPole: one a step
    assert sum(len(one.actions) for one in episodes) >= 2 * 2 * 400


@pytest.mark.slow
def test_nothing_is_left_in_the_home_folder_or_beside_the_script(sweep: Any) -> None:
    assert {path.name for path in sweep.home.iterdir()} <= {"runs", ".cache", ".config"}
    assert {path.name for path in sweep.checkout.iterdir()} == {"deploy", "examples", "traces"}


@pytest.mark.slow
def test_ctrl_c_stops_everything_and_says_how_to_go_on(interrupted: Any) -> None:
    assert interrupted.stopped.code == 130, interrupted.stopped.err
    assert re.search(
        r"stopped; continue with: python .*simple_trainer.py --resume .*runs/PPO-", interrupted.stopped.out
    )
    assert "Traceback" not in interrupted.stopped.err
    assert interrupted.left == []


@pytest.mark.slow
def test_resumed_run_goes_on_where_it_stopped(interrupted: Any) -> None:
    assert interrupted.resumed.code == 0, interrupted.resumed.out + interrupted.resumed.err
    iterations = [int(n) for n in re.findall(r"^\w+_00000 +(\d+) ", interrupted.resumed.out, re.MULTILINE)]
    assert iterations[0] >= 2 and iterations[-1] == 6
    state = json.loads(next(interrupted.home.glob("runs/*/trial_*/result.json")).read_text().splitlines()[-1])
    assert state["num_env_steps_sampled_lifetime"] >= 6 * 400
    assert list(interrupted.home.glob("runs/policies/cart-pole/1/contract.json"))


WRONG: list[tuple[str, str]] = [
    ("--run ppo", "did you mean PPO"),
    ("--run A3C", "RLlib no longer has it; use PPO"),
    ("--run BC", "learns from recorded episodes"),
    ("--framework tf", "PyTorch only .* use --framework torch"),
    (
        "--num-cpus 350",
        r"350 CPUs asked for \(350 processes with 1 CPU each\); this machine has \d+ CPUs?: give --num-cpus",
    ),
    (
        "--num-cpus 2 --set num_cpus_per_env_runner=200",
        r"400 CPUs asked for \(2 processes with 200 CPUs .*--num-cpus 0$",
    ),
    ("--sweep num_cpus_per_env_runner=1,300", "300 CPUs asked for .*; this machine has"),
    ("--run IMPALA --num-learners 300", r"301 CPUs asked for .* ask for fewer learners or evaluation runners"),
    ("--evaluation-interval 1 --evaluation-num-env-runners 300", "301 CPUs asked for .* fewer learners or evaluation"),
    (
        "--num-cpus 1 --max-concurrent-trials 90 --sweep lr=1,2",
        "90 trials at once asked for, .* room for .* leave --max",
    ),
    ("--num-gpus 64", "64 GPUs asked for .*; this machine has .*: leave --num-gpus out"),
    ("--num-gpus-per-env-runner 64", "64 GPUs asked for .*; this machine has"),
    ("--set custom_resources_per_env_runner={arm:1}", "RLlib does not understand the requested resources"),
    ('--set custom_resources_per_env_runner={"arm":1}', "1 arm asked for .*; this machine has 0 arm: ask for"),
    ("--name-env CartPoole-v1", "not registered: did you mean CartPole-v1"),
    ("--env-arg colour=red", "cannot be made with .*colour"),
    ("--run DQN --name-env Pendulum-v1", "needs Discrete actions, Pendulum-v1 takes Box"),
    ("--observation-filter MeanStdFilter --name-env FrozenLake-v1", "needs a Box of floating-point numbers"),
    ("--set lrr=3", "no such setting: did you mean lr"),
    ("--set lr=1,2", "expected one value; --sweep lr="),
    ("--set lr=abc", "RLlib refuses this configuration: Invalid `lr`"),
    ("--sweep lr", "expected NAME=VALUE"),
    ("--sweep lr=1e-3,abc", "RLlib refuses lr=abc: Invalid `lr`"),
    (
        "--sweep minibatch_size=64,128 --sweep train_batch_size_per_learner=64,128",
        "RLlib refuses minibatch_size=128 train_batch_size_per_learner=64: ",
    ),
    ("--storage /dev/null/runs", "--storage /dev/null/runs: cannot be written: Not a directory"),
    ("--address 127.0.0.1:1", "no Ray cluster answers there .*Connection refused.* start one with 'ray start --head'"),
    (
        "--run SAC --use-lstm --name-env Pendulum-v1",
        "SAC fails with a recurrent network .* use PPO, APPO",
    ),
    ("--run foo", "--run foo: expected one of PPO, APPO"),
    ("--run DQN --name-env rlservo/NoObstacleNavigationMir100Sim-v0", "use --run PPO, APPO, IMPALA or SAC$"),
    ("--sweep num_workers=3", "use --num-cpus instead"),
    ("--sweep lr=1,2 --set lr=1", "lr is given twice"),
    ("--search-space nowhere.yaml", "cannot be read: No such file"),
    ("--num-workers 3", "is obsolete: use --num-cpus"),
    ("--redis-password x", "use RAY_AUTH_MODE=token"),
    ("--resume .", "not the folder of a run"),
    ("--resume . --run PPO", "leave --run out"),
    ("--ignore-env-runner-failures", "exclude each other"),
    ("--metric episode_reward_mean", "RLlib calls it env_runners/episode_return_mean"),
    ("--stop-iters 0", "--stop-iters is 0: expected 1 or more"),
    ("--hidden 64,x", "expected sizes with commas"),
]


@pytest.mark.slow
def test_wrong_arguments_are_refused_in_a_sentence_before_anything_starts(run_here: Any, tmp_path: Path) -> None:
    for arguments, sentence in WRONG:
        ended = run_here("simple_trainer.py", *arguments.split(), home=tmp_path)
        last = ended.err.strip().splitlines()[-1]
        assert ended.code == 2, f"{arguments}: {ended}"
        assert re.search(sentence, last), f"{arguments}: {last}"
        assert "Traceback" not in ended.err


@pytest.fixture(scope="module")
def trainer() -> Any:
    """The script as a module; its configuration is looked at without a Ray."""
    sys.path.insert(0, str(EXAMPLES))
    try:
        import simple_trainer

        yield simple_trainer
    finally:
        sys.path.remove(str(EXAMPLES))


def configured(trainer: Any, *arguments: str) -> Any:
    args = trainer.argument_parser().parse_args(list(arguments))
    return trainer.set_up(args)


def test_gpu_flags_become_rllibs(trainer: Any) -> None:
    config, run, _ = configured(trainer, "--num-cpus", "35", "--num-gpus", "1")
    assert (config.num_env_runners, config.num_learners, config.num_gpus_per_learner) == (35, 0, 1.0)
    assert (run.num_cpus, run.num_gpus) == (36, 1.0)
    config, run, _ = configured(trainer, "--num-gpus", "2", "--num-learners", "2", "--num-cpus", "4")
    assert (config.num_learners, config.num_gpus_per_learner, run.num_cpus) == (2, 1.0, 7)
    config, run, _ = configured(
        trainer, "--num-gpus-per-learner", "0.5", "--num-gpus-per-env-runner", "0.25", "--num-cpus", "2"
    )
    assert (config.num_gpus_per_learner, config.num_gpus_per_env_runner, run.num_gpus) == (0.5, 0.25, 1.0)


def test_fault_tolerance_and_evaluation_flags_become_rllibs(trainer: Any) -> None:
    config, _, _ = configured(
        trainer, "--no-restart-failed-env-runners", "--ignore-env-runner-failures", "--restart-failed-sub-environments",
        "--evaluation-interval", "3", "--evaluation-duration", "7", "--log-level", "INFO",
    )  # fmt: skip
    assert (config.restart_failed_env_runners, config.ignore_env_runner_failures) == (False, True)
    assert config.restart_failed_sub_environments
    assert (config.evaluation_interval, config.evaluation_duration, config.log_level) == (3, 7, "INFO")


def test_search_space_reads_values_and_ranges(trainer: Any, tmp_path: Path) -> None:
    import shared.search_space as search_space

    file = tmp_path / "space.yaml"
    file.write_text("lr: {loguniform: [1e-5, 1e-3]}\ngamma: [0.9, 0.99]\nminibatch_size: {choice: [64, 128]}\n")
    space = search_space.load_search_space(file)
    assert space["gamma"] == {"grid_search": [0.9, 0.99]}
    assert 1e-5 <= space["lr"].sample() <= 1e-3
    assert space["minibatch_size"].sample() in (64, 128)
    for wrong, sentence in (
        ("lr: {loguniform: [0, 1]}", "lr: loguniform .* needs low < high"),
        ("lr: {normal: [0, 1]}", "lr: expected a value, a list, or one of choice, uniform"),
        ("- lr", "expected a map"),
        ("lr: [", "cannot be read"),
    ):
        file.write_text(wrong)
        with pytest.raises(errors.UsageError, match=sentence):
            search_space.load_search_space(file)
