"""Train a policy with RLlib and Tune, keep checkpoints, then run episodes with the best one.

What `training_inference_ur.py` and `training_inference_mir.py` share: the command line of robo-gym's RLlib scripts on
today's RLlib (new API stack), a progress line, and the inference phase.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

# Said before Ray is imported, so that it holds for every process of the cluster that is started here.
os.environ.setdefault("RAY_AUTH_MODE", "token")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")

import ray
from ray import cloudpickle, tune
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune.registry import get_trainable_cls

SUPPORTED = ("PPO", "APPO", "IMPALA", "SAC")
MILESTONE, MILESTONE_EPISODES = 0.95, 20  # the success rate whose time is printed, in an iteration with enough episodes


@dataclass(frozen=True)
class Task:
    """What one of the two scripts trains, and the settings that were found to work."""

    env_id: str
    env_config: dict[str, Any]
    stop_timesteps: int
    stop_reward: float
    gamma: float
    inference_config: dict[str, Any] = field(default_factory=dict)  # the environment's, for the episodes afterwards
    training: dict[str, Any] = field(default_factory=dict)


def argument_parser(task: Task, description: str) -> argparse.ArgumentParser:
    """Return the parser with the arguments robo-gym's scripts have, and a few of our own."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--run", default="PPO", help=f"RLlib algorithm: {', '.join(SUPPORTED)}")
    parser.add_argument("--num-cpus", type=int, default=0, help="cores for Ray; 0 is all of the machine's")
    parser.add_argument("--framework", default="torch", help="torch; RLlib's new API stack has no other")
    parser.add_argument("--stop-iters", type=int, default=100_000, help="training iterations at most")
    parser.add_argument("--stop-timesteps", type=int, default=task.stop_timesteps, help="environment steps at most")
    parser.add_argument("--stop-reward", type=float, default=task.stop_reward, help="mean return at which to stop")
    parser.add_argument("--explore-during-inference", action="store_true", help="sample actions after training too")
    parser.add_argument("--num-episodes-during-inference", type=int, default=100, help="episodes after training")
    parser.add_argument("--seed", type=int, default=0, help="of training; inference episodes use seed 10000 and up")
    parser.add_argument("--num-envs-per-env-runner", type=int, default=8, help="simulators in each sampling process")
    parser.add_argument("--checkpoint-frequency", type=int, default=20, help="iterations between checkpoints")
    parser.add_argument("--storage", type=Path, default=Path("runs"), help="folder for results and checkpoints")
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
    for name in ("num_cpus", "num_episodes_during_inference"):
        if getattr(args, name) < 0:
            parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}: expected 0 or more")


def algorithm_config(task: Task, args: argparse.Namespace, cpus: int) -> AlgorithmConfig:
    """Return the RLlib configuration: one core for the driver and learner, the others (at least two) sample."""
    gpus = float(os.environ.get("RLLIB_NUM_GPUS", "0"))
    config: AlgorithmConfig = get_trainable_cls(args.run).get_default_config()
    config.environment(task.env_id, env_config=task.env_config, clip_rewards=False)
    config.framework("torch")
    config.env_runners(
        num_env_runners=max(2, cpus - 1),
        # Sampling and learning take turns, so on a small machine they may share cores. (RLlib's annotations here are
        # narrower than what it takes: a fraction of a core, and the connector's three-argument form.)
        num_cpus_per_env_runner=cast(Any, 0.5 if cpus < 3 else 1),
        num_envs_per_env_runner=args.num_envs_per_env_runner,
        env_to_module_connector=cast(Any, _mean_std_filter),
    )
    config.learners(num_learners=0, num_gpus_per_learner=gpus)
    config.rl_module(
        model_config=DefaultModelConfig(
            fcnet_hiddens=[256, 256], fcnet_activation="tanh", vf_share_layers=False, max_seq_len=20
        )
    )
    config.training(gamma=task.gamma)
    if args.run == "PPO":
        config.training(**task.training)
    config.callbacks(on_episode_end=_log_success)
    config.debugging(seed=args.seed, log_level="ERROR")
    return config


def _mean_std_filter(env: Any, spaces: Any, device: Any) -> MeanStdFilter:
    return MeanStdFilter()


def _log_success(*, episode: Any, metrics_logger: Any, **_: Any) -> None:
    info = episode.get_infos(-1) or {}
    if "is_success" in info:
        metrics_logger.log_value("success_rate", float(info["is_success"]), reduce="mean", window=100)


class ProgressLine(tune.Callback):
    """Prints one line per training iteration."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self._started = time.monotonic()
        self._milestone_reached = False

    def on_trial_result(self, iteration: int, trials: Any, trial: Any, result: dict[str, Any], **info: Any) -> None:
        runners: Mapping[str, Any] = result.get("env_runners", {})
        steps = result.get("num_env_steps_sampled_lifetime", 0)
        elapsed = time.monotonic() - self._started
        print(
            f"iteration {result['training_iteration']:4d}  steps {steps:>10,.0f} of {self._args.stop_timesteps:,}  "
            f"return {runners.get('episode_return_mean', float('nan')):8.3f}  "
            f"length {runners.get('episode_len_mean', float('nan')):6.1f}  "
            f"success {runners.get('success_rate', float('nan')):6.1%}  "
            f"{steps / max(elapsed, 1e-9):6,.0f} steps/s  {int(elapsed) // 60:3d}:{int(elapsed) % 60:02d}",
            flush=True,
        )
        if (
            not self._milestone_reached
            and runners.get("success_rate", 0.0) >= MILESTONE
            and runners.get("num_episodes", 0) >= MILESTONE_EPISODES
        ):
            self._milestone_reached = True
            print(f"{MILESTONE:.0%} success first reached after {steps:,.0f} steps, {elapsed:.0f} s", flush=True)


def train(task: Task, args: argparse.Namespace) -> Path:
    """Train until one of the stop criteria holds; return the folder of the best checkpoint (by mean return)."""
    # Checkpoints hold the two functions above. Pickled by value, they load where this file does not exist.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    ray.init(num_cpus=args.num_cpus or None, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        cpus = int(ray.cluster_resources()["CPU"])
        config = algorithm_config(task, args, cpus)
        print(
            f"{args.run} on {task.env_id}: {config.num_env_runners} sampling processes with "
            f"{args.num_envs_per_env_runner} simulators each, {cpus} cores; Ctrl-C stops and keeps the checkpoints"
        )
        tuner = tune.Tuner(
            args.run,
            param_space=cast(Any, config),  # Tune takes an AlgorithmConfig, its annotation says dict
            run_config=tune.RunConfig(
                name=f"{args.run}-{task.env_id.split('/')[-1]}",
                storage_path=str(args.storage.resolve()),
                stop={
                    "training_iteration": args.stop_iters,
                    "num_env_steps_sampled_lifetime": args.stop_timesteps,
                    "env_runners/episode_return_mean": args.stop_reward,
                },
                checkpoint_config=tune.CheckpointConfig(
                    num_to_keep=3,
                    checkpoint_score_attribute="env_runners/episode_return_mean",
                    checkpoint_frequency=args.checkpoint_frequency,
                    checkpoint_at_end=True,
                ),
                callbacks=[ProgressLine(args)],
                verbose=0,
            ),
        )
        results = tuner.fit()
        if results.errors:
            raise SystemExit(f"training failed: {results.errors[0]}")
        best = results.get_best_result("env_runners/episode_return_mean", "max")
        checkpoint = best.get_best_checkpoint("env_runners/episode_return_mean", "max") or best.checkpoint
        if checkpoint is None:
            raise SystemExit("training ended before the first checkpoint")
        return Path(checkpoint.path)
    finally:
        ray.shutdown()


def infer(task: Task, args: argparse.Namespace, checkpoint: Path) -> None:
    """Export the checkpoint and run episodes with the bundle, which acts as RLlib would: that is what export proves."""
    from rich.console import Console

    from rlservo.export.exporter import export_checkpoint
    from rlservo.serve_app.policy import Policy
    from rlservo.serve_app.rollout import rollout
    from rlservo.serve_app.rollout_report import render_report

    exported = export_checkpoint(checkpoint, args.storage / "policies", notify=print)
    print(f"bundle: {exported.path}")
    with Policy.load(exported.path) as policy:
        report = rollout(
            policy,
            task.env_id,
            episodes=args.num_episodes_during_inference,
            seed=10_000,
            explore=args.explore_during_inference,
            env_kwargs=task.inference_config,
        )
    Console().print(render_report(report))


def run(task: Task, parser: argparse.ArgumentParser) -> None:
    """Parse the command line, train, and run inference episodes with the best checkpoint."""
    args = parser.parse_args()
    check_arguments(parser, args)
    checkpoint = train(task, args)
    print(f"best checkpoint: {checkpoint}")
    if args.num_episodes_during_inference:
        infer(task, args, checkpoint)
