"""Train a robot's policy with RLlib and Tune, keep checkpoints, then run episodes with the best one.

Shared by `training_inference_ur.py` and `training_inference_mir.py`: the command line of robo-gym's RLlib scripts on
today's RLlib (new API stack). The run itself is in `training_run.py`.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import shared.training_run as training_run  # before Ray  # isort: skip
import yaml
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

import shared.resources as resources
from rlservo.export.rllib.batched_connectors import use_batched_connectors
from shared.help_text import DefaultsFormatter
from shared.resources import Room
from shared.training_run import RETURN, STEPS, Run

SHIPPED = Path(__file__).resolve().parents[1] / "checkpoints"
SUPPORTED = ("PPO", "APPO", "IMPALA", "SAC")


@dataclass(frozen=True)
class Task:
    """Task of one of the two scripts, with settings that were found to work."""

    env_id: str
    env_config: dict[str, Any]
    stop_timesteps: int
    stop_reward: float
    gamma: float  # every algorithm's
    training: dict[str, Any]  # PPO's
    model: dict[str, Any]
    inference_config: dict[str, Any] = field(default_factory=dict)  # the environment's, for the episodes afterwards


def shipped_task(name: str) -> Task:
    """Return the task of a policy that ships, with the settings of `examples/checkpoints/NAME/training.yaml`.

    Processes and environments in each are the command line's, not the file's: it describes one process.
    """
    settings = yaml.safe_load((SHIPPED / name / "training.yaml").read_text(encoding="utf-8"))
    training = dict(settings["training"])
    return Task(
        env_id=settings["env"],
        env_config=settings["env_config"],
        stop_timesteps=settings["stop"]["env_steps"],
        stop_reward=settings["stop"]["value"],
        gamma=training.pop("gamma"),
        training=training,
        model=settings["model"],
    )


def argument_parser(task: Task, description: str) -> argparse.ArgumentParser:
    """Return the parser with the arguments robo-gym's scripts have, and a few of our own."""
    parser = argparse.ArgumentParser(
        description=description,
        usage="%(prog)s [--run PPO] [--stop-timesteps N] ...  (--help lists all)",
        formatter_class=DefaultsFormatter,
    )
    parser.add_argument("--run", default="PPO", help=f"RLlib algorithm: {', '.join(SUPPORTED)}")
    parser.add_argument("--num-cpus", type=int, default=0, help="cores for Ray; 0 is all of the machine's")
    parser.add_argument("--framework", default="torch", help="torch; RLlib's new API stack has no other")
    parser.add_argument("--stop-iters", type=int, default=100_000, help="training iterations at most")
    parser.add_argument("--stop-timesteps", type=int, default=task.stop_timesteps, help="environment steps at most")
    parser.add_argument("--stop-reward", type=float, default=task.stop_reward, help="mean return at which to stop")
    parser.add_argument("--explore-during-inference", action="store_true", help="sample actions after training too")
    parser.add_argument("--num-episodes-during-inference", type=int, default=100, help="episodes after training")
    parser.add_argument("--seed", type=int, default=0, help="seed of training; inference episodes use 10000 and up")
    parser.add_argument("--num-envs-per-env-runner", type=int, default=8, help="simulators in each sampling process")
    parser.add_argument("--checkpoint-frequency", type=int, default=20, help="iterations between checkpoints")
    parser.add_argument("--storage", type=Path, default=Path("runs"), help="folder for results and checkpoints")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="resume a stopped run with its own settings")
    return parser


def check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse what today's RLlib cannot do, naming the modern way."""
    if args.framework != "torch":
        parser.error(
            f"--framework {args.framework}: RLlib's new API stack, which these scripts use, is PyTorch only "
            "(TensorFlow belongs to the old stack); use --framework torch"
        )
    if args.run not in SUPPORTED:
        parser.error(f"--run {args.run}: expected one of {', '.join(SUPPORTED)}")
    for name in ("stop_iters", "stop_timesteps", "num_envs_per_env_runner", "checkpoint_frequency"):
        if getattr(args, name) < 1:
            parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}: expected at least 1")
    for name in ("num_cpus", "num_episodes_during_inference", "seed"):
        if getattr(args, name) < 0:
            parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}: expected 0 or more")
    if args.num_cpus > max(2, cores := os.cpu_count() or 1):
        parser.error(f"--num-cpus is {args.num_cpus}: this machine has {cores}; 0 is all of them")
    if (gpus := gpus_asked_for(parser)) > 0 and gpus > training_run.local_gpus():
        parser.error(
            f"RLLIB_NUM_GPUS is {gpus:g}: this machine has {training_run.local_gpus():g} GPUs that torch can use; "
            "unset it to learn on the CPU"
        )


def gpus_asked_for(parser: argparse.ArgumentParser) -> float:
    """Return RLLIB_NUM_GPUS, the variable robo-gym's scripts read."""
    text = os.environ.get("RLLIB_NUM_GPUS", "0")
    try:
        gpus = float(text)
    except ValueError:
        gpus = -1.0
    if gpus < 0:
        parser.error(f"RLLIB_NUM_GPUS is {text!r}: expected the number of GPUs for the learner, 0 or more")
    return gpus


def algorithm_config(task: Task, args: argparse.Namespace, cpus: int, gpus: float = 0.0) -> AlgorithmConfig:
    """Return the RLlib configuration: one core for the driver and learner, the others (at least two) for sampling.

    Sampling and learning alternate, so on one or two cores the processes share them and request no more together.
    """
    config = training_run.default_config(args.run)
    config.environment(task.env_id, env_config=task.env_config, clip_rewards=False)
    config.framework("torch")
    config.env_runners(
        num_env_runners=max(2, cpus - 1),
        # RLlib's annotation here is narrower than what it takes: a fraction of a core.
        num_cpus_per_env_runner=cast(Any, 0.5 if cpus == 2 else 0.25 if cpus < 2 else 1),
        num_envs_per_env_runner=args.num_envs_per_env_runner,
    )
    use_batched_connectors(config, observation_filter=True)
    config.resources(num_cpus_for_main_process=cast(Any, 1 if cpus >= 2 else 0.5))
    # RLlib takes the larger of this and the main process's; left alone it is a whole core.
    config.learners(num_learners=0, num_gpus_per_learner=gpus, num_cpus_per_learner=cast(Any, 1 if cpus >= 2 else 0.5))
    config.rl_module(model_config=DefaultModelConfig(**task.model, max_seq_len=20))
    config.training(gamma=task.gamma)
    if args.run == "PPO":
        config.training(**task.training)
    config.callbacks(on_episode_end=training_run.SuccessLog(), on_train_result=training_run.fill_return(RETURN, "max"))
    config.debugging(seed=args.seed, log_level="ERROR")
    return config


def run(task: Task, parser: argparse.ArgumentParser) -> None:
    """Parse the command line, train (or resume), and run inference episodes with the best checkpoint."""
    args = parser.parse_args()
    check_arguments(parser, args)
    gpus = gpus_asked_for(parser)
    training_run.pickle_by_value(sys.modules[__name__])
    if args.resume:
        run, _ = training_run.load_run(args.resume)
        there = {"CPU": run.num_cpus or os.cpu_count() or 1, "GPU": training_run.local_gpus()}
        resources.check_room(run.request, Room("this machine", (there,)))
        with training_run.ray_session(num_cpus=run.num_cpus, num_gpus=run.num_gpus):
            outcome = training_run.resume(args.resume)
    else:
        training_run.check_storage(args.storage)
        run = Run(
            args.run,
            task.env_id,
            task.env_config,
            args.num_cpus,
            gpus,
            rest={
                "inference_config": task.inference_config,
                "episodes": args.num_episodes_during_inference,
                "explore": args.explore_during_inference,
            },
        )
        with training_run.ray_session(num_cpus=args.num_cpus, num_gpus=gpus):
            cpus = training_run.cores()
            config = algorithm_config(task, args, cpus, gpus)
            print(
                f"{args.run} on {task.env_id}: {config.num_env_runners} sampling processes with "
                f"{args.num_envs_per_env_runner} simulators each, {cpus} cores"
            )
            outcome = training_run.train(
                config,
                run,
                storage=args.storage,
                stop={
                    "training_iteration": args.stop_iters,
                    STEPS: args.stop_timesteps,
                    RETURN: args.stop_reward,
                },
                checkpoint_frequency=args.checkpoint_frequency,
            )
    training_run.report(outcome, run)
    checkpoint = training_run.best_checkpoint_of(outcome)
    print(f"best checkpoint: {checkpoint}")
    training_run.export_and_run(
        checkpoint,
        outcome.folder.parent / "policies",
        env_id=run.env_id,
        env_config=run.rest["inference_config"],
        episodes=run.rest["episodes"],
        explore=run.rest["explore"],
    )
