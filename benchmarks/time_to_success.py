"""Training time until 95 of the last 100 episodes succeed, compared with Stable-Baselines3's PPO.

    python benchmarks/time_to_success.py                          # both, UR5, ten to twenty minutes on two cores
    python benchmarks/time_to_success.py --seeds 0 1 2 --only rllib
    python benchmarks/time_to_success.py --set training.lr=0.0005 --only rllib
    python benchmarks/time_to_success.py --variants quick         # with settings of variants/ur5_positioning.yaml

Task and settings are those of a policy that ships (`examples/checkpoints/NAME/training.yaml`), or variants of them;
RLlib samples with one process per core. Stable-Baselines3 (`pip install stable-baselines3`) gets the same environment,
network, batches, rates and weight of the value's loss, its own VecNormalize, torch's threads, and all environments in
one process or one each; it lacks RLlib's KL term and bound of the value's loss, and its first weights and single
standard deviation are always those of `quick`. Success is measured in training, with exploration; RLlib's last episodes
are those of whole iterations, so slightly more than 100. The curves are written to `bench/time_to_success.json`.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import contextlib
import functools
import importlib.util
import itertools
import os
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import shared.training_run as training_run  # before Ray  # isort: skip
import evaluate_shipped
import gymnasium
import numpy as np
import torch
import train_shipped
from measuring import parser, write
from sweep import variants_of

WINDOW = 100  # episodes
SUCCESS = 0.95


@dataclass
class Run:
    """One training; a point of the curve is (environment steps, seconds, success of the last episodes)."""

    trainer: str
    seed: int
    curve: list[tuple[int, float, float]] = field(default_factory=list)

    @property
    def reached(self) -> tuple[int, float] | None:
        """Steps and seconds until enough of the last episodes succeeded; None if they never did."""
        return next(((steps, seconds) for steps, seconds, success in self.curve if success >= SUCCESS), None)


Points = Generator[tuple[int, float, float], None, None]


def rllib(settings: dict[str, Any], seed: int) -> Points:
    config = train_shipped.algorithm_config(settings, seed)
    runners = sampling_processes(settings["envs"])
    config.env_runners(num_env_runners=runners, num_envs_per_env_runner=settings["envs"] // runners)
    torch.set_num_threads(1)
    with training_run.ray_session(num_cpus=runners + 1), training_run.stopping(config.build_algo()) as algorithm:
        for row in train_shipped.iterations(algorithm, WINDOW):
            yield row.env_steps, row.wall_s, row.success if row.episodes >= WINDOW else 0.0


def sampling_processes(envs: int) -> int:
    """Return the number of sampling processes: at most one per core, each with as many environments."""
    return max(count for count in range(1, (os.cpu_count() or 1) + 1) if envs % count == 0)


def stable_baselines(settings: dict[str, Any], seed: int, *, processes: bool) -> Points:
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
    from training_inference_ur_sb3 import make_env, make_ppo, rate_after

    batch = settings["training"]["train_batch_size_per_learner"]
    environments: list[Callable[[], gymnasium.Env[Any, Any]]] = [functools.partial(make_env, settings)] * settings[
        "envs"
    ]
    normalised = VecNormalize(
        SubprocVecEnv(environments) if processes else DummyVecEnv(environments), norm_reward=False
    )
    done = 0
    torch.set_num_threads(os.cpu_count() or 1)
    algorithm = make_ppo(settings, normalised, seed, lambda _: rate_after(settings, done))
    began = time.monotonic()
    try:
        while True:
            algorithm.learn(batch, reset_num_timesteps=False)
            done = algorithm.num_timesteps
            successes = algorithm.ep_success_buffer or ()
            success = float(np.mean(successes)) if len(successes) == WINDOW else 0.0
            yield done, time.monotonic() - began, success
    finally:
        normalised.close()


TRAINERS: dict[str, Callable[[dict[str, Any], int], Points]] = {
    "rllib": rllib,
    "sb3": lambda settings, seed: stable_baselines(settings, seed, processes=False),
    "sb3-processes": lambda settings, seed: stable_baselines(settings, seed, processes=True),
}


def comparable() -> list[str]:
    """Return the policies that both can train: by PPO, from the beginning, without a memory."""
    every = {name: evaluate_shipped.load_settings(name) for name in evaluate_shipped.shipped_names()}
    return [
        name
        for name, settings in every.items()
        if settings["algorithm"] == "PPO"
        and not settings.keys() & {"begin", "imitate"}
        and not settings["model"].get("use_lstm")
    ]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("name", nargs="?", default="ur5_positioning", choices=comparable())
    options.add_argument("--seeds", type=int, nargs="+", default=[0])
    options.add_argument("--only", choices=TRAINERS, nargs="+", default=list(TRAINERS))
    options.add_argument("--variants", nargs="+", default=[], metavar="NAME", help="of variants/NAME.yaml, or all")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as train_shipped.py's")
    args = options.parse_args()
    try:
        variants = variants_of(args.name, args.variants)
        for settings in variants.values():
            train_shipped.change_settings(settings, args.set)
    except ValueError as error:
        options.error(str(error))
    trainers = list(args.only)
    if importlib.util.find_spec("stable_baselines3") is None:
        print("Stable-Baselines3 is not installed (pip install stable-baselines3): RLlib alone")
        trainers = [name for name in trainers if name == "rllib"]
    os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's 15 would measure the machine's other work
    training_run.pickle_by_value(train_shipped)  # its callback, in processes that do not find it
    runs: list[Run] = []
    for seed, (variant, chosen), trainer in itertools.product(args.seeds, variants.items(), trainers):
        run = Run(" ".join(filter(None, (trainer, variant))), seed)
        runs.append(run)
        with contextlib.closing(TRAINERS[trainer](chosen, seed)) as points:
            for steps, seconds, success in points:
                run.curve.append((steps, seconds, success))
                print(f"{run.trainer}, seed {seed}: {steps:>10,} steps {seconds:6.0f} s {success:6.1%}", flush=True)
                if success >= SUCCESS or steps >= chosen["stop"]["env_steps"]:
                    break
        write(args.out, "time_to_success", [asdict(each) for each in runs])
    for run in runs:
        steps, seconds = run.reached or run.curve[-1][:2]
        said = f"{SUCCESS:.0%} after" if run.reached else f"{run.curve[-1][2]:.0%} in the end,"
        print(
            f"{run.trainer}, seed {run.seed}: {said} {steps:,} steps, {seconds:.0f} s ({steps / seconds:,.0f} steps/s)"
        )


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
