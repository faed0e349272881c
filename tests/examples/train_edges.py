"""Train briefly on unusual environments, as the trainer would, and write the outcomes to edges.json.

Runs in a folder of its own and in a Ray of one core: `trainings.py`. If an environment is not unusual for Tune, its
algorithm trains in this process: a trial's own process takes longer to start than to train.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import time
from pathlib import Path
from typing import Any

import shared.episode_traces as episode_traces
import shared.training_run as training_run
import simple_trainer

from rlservo import errors
from trainings import ON_ONE_CORE

EVERY_300_STEPS = ("--set", "min_sample_timesteps_per_iteration=300")  # a result, where no batch is one
RUNS = {
    "Float64": ["--set", "vf_clip_param=100.0", "--observation-filter", "MeanStdFilter"],
    "Promises32": [
        "--run", "DQN", "--stop-timesteps", "300", *EVERY_300_STEPS,
        "--set", "num_steps_sampled_before_learning_starts=200",
    ],
    "Camera": [],
    "Endless": [],
    "Crashing": ["--restart-failed-sub-environments", "--set", "rollout_fragment_length=25"],
    "Crashing runner": [
        "--num-cpus", "1", *ON_ONE_CORE, "--set", "rollout_fragment_length=25", "--env-arg", "crashes=1",
        "--stop-iters", "100000", "--stop-timesteps", "300",
    ],
    "Crashing for good": ["--stop-iters", "50"],
    "Failing": ["--num-cpus", "1", *ON_ONE_CORE],
    "Failing remade": ["--restart-failed-sub-environments"],
    "Failing unmade": ["--num-cpus", "1", *ON_ONE_CORE, "--env-arg", f"only_in={os.getpid()}"],
    "Failing evaluation": [
        "--env-arg", "fails=false", "--evaluation-interval", "1", "--evaluation-num-env-runners", "1", *ON_ONE_CORE,
    ],
    "Float64 unlearned": ["--run", "SAC", "--stop-timesteps", "300", *EVERY_300_STEPS],
}  # fmt: skip


# What Tune makes of no return, of a trial that fails, and of nothing learned.
TUNED = (
    "Endless", "Crashing for good", "Failing", "Failing remade", "Failing unmade", "Failing evaluation",
    "Float64 unlearned",
)  # fmt: skip


def main() -> None:
    folder = Path.cwd()  # an absolute path: Tune's workers run in the trial's folder
    training_run.pickle_by_value(simple_trainer, episode_traces)
    found = {}
    for name, more in RUNS.items():
        env = f"edge_environments:edge/{name.split()[0]}-v0"
        common = ["--num-cpus", "0", "--name-env", env, "--stop-iters", "2", "--hidden", "16"]
        if name.startswith("Crashing"):
            common += ["--env-arg", f"log={folder / name.replace(' ', '_')}.txt"]
        own = more if "--run" in more else [*more, "--set", "train_batch_size_per_learner=300", "--set", "num_epochs=2"]
        parser = simple_trainer.argument_parser()
        args = parser.parse_args([*common, *own])
        simple_trainer.check_arguments(parser, args)
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            try:
                config, run, _ = simple_trainer.set_up(args)
                if name == "Failing evaluation":
                    config.evaluation(evaluation_config={"env_config": {"fails": True}})
                stop = {"training_iteration": args.stop_iters, training_run.STEPS: args.stop_timesteps}
                train = train_with_tune if name in TUNED else train_here
                checkpoint, steps = train(config, run, folder / "runs" / name, stop)
                bundle = training_run.export_and_run(
                    checkpoint,
                    folder / "policies" / name.replace(" ", "-"),
                    env_id=run.env_id,
                    env_config=run.env_config,
                    episodes=0 if name.startswith(("Endless", "Crashing")) else 1,
                )
                found[name] = {"bundle": str(bundle), "steps": steps}
            except errors.RlservoError as error:
                found[name] = {"error": error.message}
        found[name]["said"] = said.getvalue()
    Path("edges.json").write_text(json.dumps(found))


def train_with_tune(config: Any, run: Any, storage: Path, stop: dict[str, float]) -> tuple[Path, int]:
    outcome = training_run.train(config, run, storage=storage, stop=stop, checkpoint_frequency=1)
    training_run.report(outcome, run)
    return training_run.best_checkpoint_of(outcome), outcome.best.env_steps


def train_here(config: Any, run: Any, storage: Path, stop: dict[str, float]) -> tuple[Path, int]:
    with training_run.stopping(training_run.build(config)) as algorithm:
        result = algorithm.train()
        while all(result[name] < limit for name, limit in stop.items()):
            before, result = result, algorithm.train()
            if result[training_run.STEPS] == before[training_run.STEPS]:  # the only runner is being made again
                time.sleep(0.2)
        return Path(algorithm.save_to_path(str(storage))), int(result[training_run.STEPS])


if __name__ == "__main__":
    main()
