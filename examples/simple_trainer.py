"""Train any RLlib algorithm on any Gymnasium environment, on a laptop, a cluster or a Slurm allocation.

    python examples/simple_trainer.py --run PPO --name-env CartPole-v1 --stop-reward 450
    python examples/simple_trainer.py --run PPO --name-env CartPole-v1 --num-cpus 35 --num-gpus 1
    python examples/simple_trainer.py --sweep lr=1e-4,3e-4,1e-3 --scheduler asha --stop-timesteps 50000
    python examples/simple_trainer.py --resume runs/PPO-CartPole-v1-20260101-120000

`--num-cpus N` is N cores for env runners, one each, and one more core for the driver, which holds the learner: on a
node of 36 cores, `--num-cpus 35`. If the machine has just N cores, the driver shares them (it waits while the others
sample). `--num-cpus 0` samples in the driver. The run ends in a bundle that `rlservo serve` can serve.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import shared.episode_traces as episode_traces
import shared.resources as resources
import shared.search_space as search_space
import shared.training_run as training_run
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from ray import tune
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.env_to_module import FlattenObservations, MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.models.utils import get_filter_config
from ray.tune.schedulers import ASHAScheduler, FIFOScheduler, MedianStoppingRule
from shared.help_text import DefaultsFormatter
from shared.resources import Room
from shared.training_run import RETURN, STEPS, Run

from rlservo import errors
from rlservo.bundle.environment_id import importing_id
from rlservo.drive.make_environment import make_env
from rlservo.export.rllib.batched_connectors import supports, use_batched_connectors

ONLINE = ("PPO", "APPO", "IMPALA", "DQN", "SAC")
ACTIONS: dict[str, tuple[type, ...]] = {"DQN": (Discrete,), "SAC": (Box, Discrete)}
GONE = {
    **dict.fromkeys(("A2C", "A3C", "PG", "ES", "ARS", "DDPPO", "PPOTF"), "PPO"),
    **dict.fromkeys(("DDPG", "TD3", "APEX_DDPG", "APEXDDPG", "CRR"), "SAC"),
    **dict.fromkeys(("APEX", "APEX_DQN", "R2D2", "SIMPLEQ", "SIMPLE_Q", "RAINBOW"), "DQN"),
}
OFFLINE = ("BC", "MARWIL", "CQL", "IQL")
OLD_ARGUMENTS = {
    "--num-workers": "--num-cpus",
    "--num-rollout-workers": "--num-cpus",
    "--num-envs-per-worker": "--num-envs-per-env-runner",
    "--num-gpus-per-worker": "--num-gpus-per-env-runner",
    "--num-gpus-per-trainer": "--num-gpus-per-learner",
    "--env": "--name-env",
    "--ip-head": "--address",
    "--ip_head": "--address",
    "--ray-address": "--address",
    "--redis-password": "RAY_AUTH_MODE=token and RAY_AUTH_TOKEN in the environment",
    "--redis_password": "RAY_AUTH_MODE=token and RAY_AUTH_TOKEN in the environment",
    "--ignore-worker-failures": "--ignore-env-runner-failures",
    "--recreate-failed-workers": "--restart-failed-env-runners",
    "--recreate-failed-env-runners": "--restart-failed-env-runners",
    "--local-mode": "--num-cpus 0, which samples in the driver",
    "--checkpoint-freq": "--checkpoint-frequency",
    "--local-dir": "--storage",
    "--restore": "--resume",
}
AFTER_RESUME = ("resume", "address")  # allowed with --resume; everything else is the saved run's


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser, its arguments grouped by purpose."""
    parser = argparse.ArgumentParser(
        description="Train any RLlib algorithm on any Gymnasium environment and export a policy bundle.",
        usage="%(prog)s [--run PPO] [--name-env CartPole-v1] [--num-cpus N] ...  (--help lists all)",
        formatter_class=DefaultsFormatter,
        allow_abbrev=False,
    )
    what = parser.add_argument_group("what is trained")
    what.add_argument("--run", default="PPO", help=f"RLlib algorithm: {', '.join(ONLINE)}")
    what.add_argument("--name-env", default="CartPole-v1", help="Gymnasium id; 'module:Id' imports the module first")
    what.add_argument("--env-arg", action="append", default=[], metavar="NAME=VALUE", help="environment argument")
    what.add_argument("--app-dir", type=Path, default=Path(), help="folder of your own modules")
    what.add_argument("--framework", default="torch", help="torch; RLlib's new API stack has no other")
    what.add_argument("--hidden", default="256,256", help="sizes of the hidden layers")
    what.add_argument("--use-lstm", action="store_true", help="a recurrent network")
    what.add_argument(
        "--observation-filter", choices=["NoFilter", "MeanStdFilter"], default="NoFilter", help="normalise observations"
    )
    what.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="any setting of the algorithm")
    what.add_argument("--seed", type=int, default=0, help="seed of training; later episodes use 10000 and up")

    where = parser.add_argument_group("on what")
    where.add_argument(
        "--num-cpus", type=int, default=1, help="cores for env runners, one each; the driver takes one more"
    )
    where.add_argument("--num-gpus", type=float, default=0.0, help="GPUs for learning, divided among the learners")
    where.add_argument("--num-envs-per-env-runner", type=int, default=1, help="environments in each env runner")
    where.add_argument("--num-learners", type=int, default=0, help="learner processes; 0 learns in the driver")
    where.add_argument("--num-gpus-per-learner", type=float, help="instead of --num-gpus")
    where.add_argument("--num-gpus-per-env-runner", type=float, default=0.0, help="GPUs of each, for slow networks")
    where.add_argument("--address", help="address of a Ray cluster ('auto' finds it); default: a private one")

    until = parser.add_argument_group("until when")
    until.add_argument("--stop-iters", type=int, default=200, help="training iterations at most")
    until.add_argument("--stop-timesteps", type=int, default=10_000_000, help="environment steps at most")
    until.add_argument("--stop-reward", type=float, default=float("inf"), help="mean return at which to stop")
    until.add_argument("--resume", type=Path, metavar="RUN", help="resume a stopped run with its own settings")

    faults = parser.add_argument_group("when something fails")
    bool_flag = argparse.BooleanOptionalAction
    faults.add_argument(
        "--restart-failed-env-runners", action=bool_flag, default=True, help="restart a lost env runner"
    )
    faults.add_argument(
        "--ignore-env-runner-failures", action=bool_flag, default=False, help="continue with the others"
    )
    faults.add_argument(
        "--restart-failed-sub-environments", action=bool_flag, default=False, help="recreate a crashed environment"
    )
    faults.add_argument("--max-num-env-runner-restarts", type=int, default=1000, help="failures that end the training")
    faults.add_argument("--max-failures", type=int, default=0, help="how often a trial continues from its checkpoint")

    group = parser.add_argument_group("what is written")
    group.add_argument("--storage", type=Path, default=Path("runs"), help="folder for results and checkpoints")
    group.add_argument("--checkpoint-frequency", type=int, default=5, help="iterations between checkpoints")
    group.add_argument("--evaluation-interval", type=int, default=0, help="iterations between evaluations; 0 is none")
    group.add_argument("--evaluation-duration", type=int, default=10, help="episodes of an evaluation")
    group.add_argument(
        "--evaluation-num-env-runners", type=int, default=0, help="extra cores for evaluation; 0: the driver's"
    )
    group.add_argument(
        "--log-level", choices=["DEBUG", "INFO", "WARN", "ERROR"], default="ERROR", help="log level of RLlib and Ray"
    )
    group.add_argument("--output", type=Path, help="folder for episode traces: observations, actions, rewards")
    group.add_argument("--export", type=Path, help="folder for the best checkpoint's bundle; default: STORAGE/policies")
    group.add_argument("--no-export", action="store_true", help="do not export a bundle")
    group.add_argument("--episodes", type=int, default=10, help="episodes with the bundle afterwards")

    sweep = parser.add_argument_group("hyper-parameter sweep")
    sweep.add_argument("--sweep", action="append", default=[], metavar="NAME=V1,V2,...", help="try each value")
    sweep.add_argument("--search-space", type=Path, metavar="YAML", help="values and ranges (see search_space.py)")
    sweep.add_argument("--num-samples", type=int, default=1, help="number of samples from the space")
    sweep.add_argument("--scheduler", choices=["fifo", "asha", "median"], default="fifo", help="stops bad trials early")
    sweep.add_argument("--max-concurrent-trials", type=int, help="trials at once; default: as many as fit")
    sweep.add_argument("--metric", default=RETURN, help="metric that picks the best checkpoint")
    sweep.add_argument("--mode", choices=["max", "min"], default="max", help="pick its smallest value")
    for old in OLD_ARGUMENTS:
        parser.add_argument(old, nargs="?", action=_NewName, help=argparse.SUPPRESS, default=argparse.SUPPRESS)
    return parser


class _NewName(argparse.Action):
    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        parser.error(f"{option_string} is obsolete: use {OLD_ARGUMENTS[str(option_string)]}")


def check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse what cannot work before anything is started, naming what can."""
    if args.framework != "torch":
        parser.error(
            f"--framework {args.framework}: RLlib's new API stack is PyTorch only (TensorFlow belongs to the old "
            "stack); use --framework torch"
        )
    if args.run not in ONLINE:
        near = next((name for name in ONLINE if name == args.run.upper()), None)
        hint = (
            f"did you mean {near}?" if near
            else f"RLlib no longer has it; use {GONE[args.run.upper()]}" if args.run.upper() in GONE
            else "it learns from recorded episodes, not from an environment" if args.run in OFFLINE
            else f"expected one of {', '.join(ONLINE)}"
        )  # fmt: skip
        parser.error(f"--run {args.run}: {hint}")
    at_least = {
        0: ("num_cpus", "num_gpus", "num_learners", "num_gpus_per_env_runner", "evaluation_interval", "max_failures",
            "evaluation_num_env_runners", "episodes", "seed", "max_num_env_runner_restarts"),
        1: ("num_envs_per_env_runner", "stop_iters", "stop_timesteps", "checkpoint_frequency", "evaluation_duration",
            "num_samples"),
    }  # fmt: skip
    for least, names in at_least.items():
        for name in names:
            if getattr(args, name) < least:
                parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}: expected {least} or more")
    for name in ("num_gpus_per_learner", "max_concurrent_trials"):
        if getattr(args, name) is not None and getattr(args, name) < (name != "num_gpus_per_learner"):
            parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}: expected more")
    if args.run == "SAC" and args.use_lstm:
        parser.error("--use-lstm: RLlib's SAC fails with a recurrent network (ray 2.60); use PPO, APPO, IMPALA or DQN")
    if args.num_gpus and args.num_gpus_per_learner is not None:
        parser.error("give either --num-gpus (for all learners) or --num-gpus-per-learner")
    if args.restart_failed_env_runners and args.ignore_env_runner_failures:
        parser.error(
            "--ignore-env-runner-failures and --restart-failed-env-runners exclude each other: add "
            "--no-restart-failed-env-runners"
        )
    if not args.app_dir.is_dir():
        parser.error(f"--app-dir {args.app_dir}: is not a folder")
    if "episode_reward_mean" in args.metric:
        parser.error(f"--metric {args.metric}: RLlib calls it {RETURN} now")
    if args.metric.startswith("evaluation/") and not args.evaluation_interval:
        parser.error(f"--metric {args.metric} needs --evaluation-interval")
    sizes = args.hidden.split(",")
    if not all(size.isdigit() and int(size) for size in sizes):
        parser.error(f"--hidden {args.hidden}: expected sizes with commas, as in 256,256")


def cores_needed(args: argparse.Namespace) -> int:
    """Return the cores of one trial: the env runners', the learners', the evaluation's and the driver's."""
    return int(1 + args.num_cpus + args.num_learners + args.evaluation_num_env_runners)


def gpus_needed(args: argparse.Namespace) -> float:
    per_learner = gpus_per_learner(args)
    return float(per_learner * max(1, args.num_learners) + args.num_gpus_per_env_runner * args.num_cpus)


def gpus_per_learner(args: argparse.Namespace) -> float:
    """Return `--num-gpus-per-learner`, or the share of `--num-gpus`."""
    if args.num_gpus_per_learner is not None:
        return float(args.num_gpus_per_learner)
    return float(args.num_gpus / max(1, args.num_learners))


def check_machine(run: Run, config: AlgorithmConfig | None = None, concurrent: int | None = None) -> None:
    """Raise UsageError if this machine has too little for the run, before Ray starts.

    The driver may share the last core. A Ray of our own is started with as many.
    """
    gpus = training_run.local_gpus() if run.num_gpus else 0.0
    first, *others = run.request
    driver = {**first, "CPU": max(0.0, first.get("CPU", 0.0) - 1.0)}
    request = [bundle for bundle in (driver, *others) if any(bundle.values())]
    machine = Room("this machine", ({"CPU": os.cpu_count() or 1, "GPU": gpus},))
    resources.check_room(request, machine, config=config)
    ray_has = Room("this machine", ({"CPU": ray_cores(run), "GPU": math.ceil(run.num_gpus)},))
    resources.check_room(run.request, ray_has, config=config, concurrent=concurrent)


def ray_cores(run: Run) -> int:
    """Return the cores for a private Ray: for as many trials at once as the machine holds."""
    return run.num_cpus * max(1, (os.cpu_count() or 1) // run.num_cpus)


def algorithm_config(
    args: argparse.Namespace, spaces: tuple[Any, Any], env_config: Mapping[str, Any]
) -> AlgorithmConfig:
    """Return the RLlib configuration for these arguments and the environment's spaces (observation, action)."""
    config = training_run.default_config(args.run, args.log_level)
    config.environment(importing_id(args.name_env), env_config=dict(env_config))
    config.framework("torch")
    config.env_runners(
        num_env_runners=args.num_cpus,
        num_envs_per_env_runner=args.num_envs_per_env_runner,
        num_gpus_per_env_runner=args.num_gpus_per_env_runner,
        # RLlib's annotation here is narrower than what it takes: the connector's three-argument form.
        env_to_module_connector=cast(Any, observation_steps(spaces[0], args.observation_filter)),
    )
    if supports(*spaces) and not (is_flattened(spaces[0]) or args.use_lstm):  # the same numbers, sooner
        use_batched_connectors(config, observation_filter=args.observation_filter == "MeanStdFilter")
    config.learners(num_learners=args.num_learners, num_gpus_per_learner=gpus_per_learner(args))
    config.rl_module(
        model_config=DefaultModelConfig(
            fcnet_hiddens=[int(size) for size in args.hidden.split(",")], use_lstm=args.use_lstm, max_seq_len=20
        )
    )
    config.fault_tolerance(
        restart_failed_env_runners=args.restart_failed_env_runners,
        ignore_env_runner_failures=args.ignore_env_runner_failures,
        restart_failed_sub_environments=args.restart_failed_sub_environments,
        max_num_env_runner_restarts=args.max_num_env_runner_restarts,
    )
    if args.evaluation_interval:
        config.evaluation(
            evaluation_interval=args.evaluation_interval,
            evaluation_duration=args.evaluation_duration,
            evaluation_num_env_runners=args.evaluation_num_env_runners,
            evaluation_config={"explore": False},
        )
    if args.run in ("DQN", "SAC"):
        # By default a result comes every second, however slow the machine: then --stop-iters means nothing.
        config.reporting(min_time_s_per_iteration=0, min_sample_timesteps_per_iteration=1000)
    if args.run == "DQN" and args.use_lstm:
        cast(Any, config).training(
            replay_buffer_config={"type": "EpisodeReplayBuffer"}
        )  # the prioritised one has no sequences
    config.callbacks(
        on_episode_end=training_run.SuccessLog(),
        on_train_result=training_run.fill_return(args.metric, args.mode),
    )
    if args.output:
        config.callbacks(on_sample_end=episode_traces.trace_writer(args.output.resolve()))
    config.debugging(seed=args.seed, log_level=args.log_level)
    return config


def observation_steps(space: Any, kind: str) -> Any:
    """Return RLlib's connectors between environment and network, or None if it needs none.

    What is flattened is made one vector: choices one-hot, Dict and Tuple in the space's order, images pixel by pixel.
    uint8 is not scaled.
    """
    flatten = is_flattened(space)
    has_filter = kind == "MeanStdFilter"
    if has_filter and (not isinstance(space, Box) or np.dtype(space.dtype).kind != "f"):
        raise errors.UsageError(
            f"--observation-filter MeanStdFilter needs a Box of floating-point numbers, got {space}"
        )
    if not (flatten or has_filter):
        return None

    def build(env: Any, spaces: Any, device: Any) -> list[Any]:
        return ([FlattenObservations()] if flatten else []) + ([MeanStdFilter()] if has_filter else [])

    return build


def is_flattened(space: Any) -> bool:
    """Whether the network sees a vector: all but a vector, and an image of a size RLlib has convolutions for."""
    return not (isinstance(space, Box) and (len(space.shape) == 1 or _is_known_image(space)))


def _is_known_image(space: Box) -> bool:
    if len(space.shape) != 3:
        return False
    try:
        get_filter_config(space.shape)
    except ValueError:
        return False
    return True


def inspect_environment(args: argparse.Namespace, env_config: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the environment's spaces, after checking that the algorithm can act in it.

    Raises UsageError for an environment that cannot be made and for actions that do not fit.
    """
    env = make_env(args.name_env, env_config, render=False)
    try:
        spaces = env.observation_space, env.action_space
    finally:
        env.close()
    kinds = ACTIONS.get(args.run)
    if kinds and not isinstance(spaces[1], kinds):
        fit = "PPO, APPO, IMPALA or SAC" if isinstance(spaces[1], Box) else "PPO, APPO or IMPALA"
        raise errors.UsageError(
            f"--run {args.run}: it needs {' or '.join(kind.__name__ for kind in kinds)} actions, {args.name_env} takes "
            f"{spaces[1]}; use --run {fit}"
        )
    if isinstance(spaces[0], Box) and len(spaces[0].shape) > 1 and not _is_known_image(spaces[0]):
        print(f"note: RLlib has no convolutions for observations of shape {spaces[0].shape}; they are flattened")
    if not isinstance(spaces[0], Box | Discrete | MultiDiscrete):
        print(f"note: the network sees {type(spaces[0]).__name__} observations as one vector, images pixel by pixel")
    return spaces


def set_up(args: argparse.Namespace) -> tuple[AlgorithmConfig, Run, list[str]]:
    """Return the configuration, the run's description, and the swept settings' names.

    Raises UsageError for an environment, a setting or a range that cannot be used.
    """
    env_config = {name: value[0] for name, value in search_space.parse_settings(args.env_arg, "--env-arg").items()}
    config = algorithm_config(args, inspect_environment(args, env_config), env_config)
    constants = search_space.parse_settings(args.set, "--set")
    if several := [name for name, values in constants.items() if len(values) > 1]:
        raise errors.UsageError(f"--set {several[0]}: expected one value; --sweep {several[0]}=... tries several")
    search_space.apply(config, {name: values[0] for name, values in constants.items()}, "--set")
    search_space.validate(config)
    grid = {
        name: tune.grid_search(values) for name, values in search_space.parse_settings(args.sweep, "--sweep").items()
    }
    space = search_space.load_search_space(args.search_space) if args.search_space else {}
    if twice := sorted((set(grid) | set(space)) & set(constants)) or sorted(set(grid) & set(space)):
        raise errors.UsageError(f"{twice[0]} is given twice, by --set, --sweep or --search-space: once is enough")
    search_space.apply(config, grid, "--sweep")
    search_space.apply(config, space, "--search-space")
    combinations = search_space.check_combinations(config, grid | space) or [config]
    request = max(map(resources.request_of, combinations), key=resources.size)
    cpus, gpus = resources.size(request)
    run = Run(
        args.run,
        args.name_env,
        env_config,
        max(cores_needed(args), math.ceil(cpus)),
        max(gpus_needed(args), gpus),
        args.metric,
        args.mode,
        rest={
            "episodes": args.episodes,
            "export": None if args.no_export else str((args.export or args.storage / "policies").resolve()),
            "app_dir": str(args.app_dir.resolve()),
            "log_level": args.log_level,
        },
        request=request,
    )
    return config, run, [*grid, *space]


def scheduler(args: argparse.Namespace) -> Any:
    """Return Tune's scheduler: either every trial runs to the end, or those far behind are stopped early."""
    if args.scheduler == "asha":
        return ASHAScheduler(
            time_attr="training_iteration", max_t=args.stop_iters, grace_period=max(1, min(5, args.stop_iters // 4))
        )
    if args.scheduler == "median":
        return MedianStoppingRule(
            time_attr="training_iteration", grace_period=max(1, min(5, args.stop_iters // 4)), min_samples_required=2
        )
    return FIFOScheduler()


def explicit(arguments: Sequence[str]) -> set[str]:
    """Return the names of the arguments that are on the command line."""
    parser = argument_parser()
    for action in parser._actions:
        action.default = argparse.SUPPRESS
    return set(vars(parser.parse_args(arguments)))


def main() -> None:
    parser = argument_parser()
    args = parser.parse_args()
    check_arguments(parser, args)
    where = "this machine" if args.address is None else f"the cluster at {args.address}"
    training_run.pickle_by_value(sys.modules[__name__], episode_traces)
    if args.resume:
        if more := sorted(explicit(sys.argv[1:]) - set(AFTER_RESUME)):
            raise errors.UsageError(f"--resume uses the run's own settings: leave --{more[0].replace('_', '-')} out")
        run, _ = training_run.load_run(args.resume)
        if args.address is None and run.request:  # older runs have none
            check_machine(run)
        with training_run.ray_session(
            num_cpus=ray_cores(run),
            num_gpus=run.num_gpus,
            address=args.address,
            log_level=run.rest["log_level"],
            app_dir=Path(run.rest["app_dir"]),
        ):
            outcome = training_run.resume(args.resume, where=where)
    else:
        sys.path.insert(0, str(args.app_dir.resolve()))
        training_run.check_storage(args.storage)
        config, run, swept = set_up(args)
        if args.address is None:
            check_machine(run, config, args.max_concurrent_trials)
        with training_run.ray_session(
            num_cpus=ray_cores(run),
            num_gpus=run.num_gpus,
            address=args.address,
            log_level=args.log_level,
            app_dir=args.app_dir,
        ):
            print(
                f"{args.run} on {args.name_env}: {args.num_cpus} env runners with {args.num_envs_per_env_runner} "
                f"environments each, {args.num_learners or 'the driver as'} learner, {run.num_cpus} cores"
            )
            outcome = training_run.train(
                config,
                run,
                storage=args.storage,
                stop={"training_iteration": args.stop_iters, STEPS: args.stop_timesteps, args.metric: args.stop_reward}
                if args.mode == "max"
                else {"training_iteration": args.stop_iters, STEPS: args.stop_timesteps},
                checkpoint_frequency=args.checkpoint_frequency,
                num_samples=args.num_samples,
                scheduler=scheduler(args),
                max_concurrent=args.max_concurrent_trials,
                max_failures=args.max_failures,
                swept=swept,
                where=where,
            )
    training_run.report(outcome, run)
    checkpoint = training_run.best_checkpoint_of(outcome)
    print(f"best checkpoint: {checkpoint}")
    if run.rest["export"] is not None:
        training_run.export_and_run(
            checkpoint,
            Path(run.rest["export"]),
            env_id=run.env_id,
            env_config=run.env_config,
            episodes=run.rest["episodes"],
            app_dir=Path(run.rest["app_dir"]),
        )


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
