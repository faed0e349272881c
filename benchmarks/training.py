"""Measure training speed and its parts, by number of env runners and environments in each.

    python benchmarks/training.py            # 1 and 2 runners, 1, 4 and 16 environments, UR5; ten minutes or so
    python benchmarks/training.py --quick    # the same with small batches, at most 3 minutes
    python benchmarks/training.py --env CartPole-v1 --iterations 5

PPO as the UR5 script trains it: a batch of `--batch` steps, 4 epochs. A row is the median of `--iterations` iterations
after one of warm-up. `--minutes` are divided among the configurations: one whose time is up keeps the iterations it has
finished, or is recorded as failed, and the next one is measured. `bench/training.json` is written after each row.
`vectorisation.py` compares ways to step several simulators in one process.
"""

from __future__ import annotations

import itertools
import os
import signal
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import shared.training_run as training_run
from measuring import parser, write

from rlservo.errors import RlservoError
from rlservo.export.rllib.batched_connectors import use_batched_connectors

UR5 = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
MINIBATCH = 512


@dataclass(frozen=True)
class Iteration:
    """One iteration. Shares refer to a runner's own time, by RLlib's timers, which are smoothed."""

    steps_per_s: float
    steps_per_cpu_s: float  # of the driver's and the runners' processor time, which stays comparable on a busy machine
    iteration_s: float
    sample_s: float  # waiting for the runners
    learn_s: float
    rest_s: float  # sending weights, results, evaluation
    env_step_share: float  # of a runner's sampling: the simulators
    inference_share: float  # the network
    connectors_share: float  # the pipelines before and after the network


@dataclass(frozen=True)
class Row(Iteration):
    """A configuration's medians over its iterations."""

    runners: int
    envs: int
    iterations: int


@dataclass(frozen=True)
class Failed:
    """A configuration that gave no figures."""

    runners: int
    envs: int
    reason: str


class TimeUp(Exception):
    """A configuration exceeded its time."""


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--env", default=UR5)
    options.add_argument("--runners", type=int, nargs="+", default=[1, 2])
    options.add_argument("--envs", type=int, nargs="+", default=[1, 4, 16])
    options.add_argument("--iterations", type=int, help="default: 3; with --quick 2")
    options.add_argument("--batch", type=int, help="environment steps an iteration; default: 4096; with --quick 1024")
    options.add_argument("--minutes", type=float, help="for all of it; default: 15; with --quick 3")
    options.add_argument("--rllib-connectors", action="store_true", help="RLlib's own, to compare")
    options.add_argument("--quick", action="store_true", help="small batches")
    args = options.parse_args()
    for name, default, quick in (("iterations", 3, 2), ("batch", 4096, 1024), ("minutes", 15.0, 3.0)):
        if getattr(args, name) is None:
            setattr(args, name, quick if args.quick else default)
    if min(*args.runners, *args.envs, args.iterations, args.minutes) <= 0 or args.batch < MINIBATCH:
        options.error(f"expected positive numbers, and a --batch of at least {MINIBATCH}")
    os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's 15 would measure the machine's other work
    rows: list[Row | Failed] = []
    print(f"PPO on {args.env}, {args.batch:,} steps an iteration, median of {args.iterations}\n{HEADER}", flush=True)
    until = time.monotonic() + 60.0 * args.minutes
    with training_run.ray_session(num_cpus=max(args.runners) + 1):
        warm_up()
        configurations = list(itertools.product(args.runners, args.envs))
        for done, (runners, envs) in enumerate(configurations):
            limit = max(1.0, (until - time.monotonic()) / (len(configurations) - done))
            rllibs = args.rllib_connectors
            rows.append(measure(args.env, runners, envs, args.iterations, args.batch, limit, rllib_connectors=rllibs))
            print(line(rows[-1]), flush=True)
            write(args.out, "training", document(rows, args.env, args.batch))
    if all(isinstance(row, Failed) for row in rows):
        raise RlservoError("no configuration finished an iteration in time: give more with --minutes")


def warm_up() -> None:
    """Train once: an import on first use that the time limit cut off would break everything after it."""
    config = configuration("CartPole-v1", 0, 1, MINIBATCH)
    with training_run.stopping(config.build_algo()) as algorithm:
        algorithm.train()


class TimeLimit:
    """Raises TimeUp in the block when the time is up: Ray's calls handle signals while they wait."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.up = False

    def __enter__(self) -> TimeLimit:
        self._before = signal.signal(signal.SIGALRM, self._on_alarm)
        signal.setitimer(signal.ITIMER_REAL, self.seconds)
        return self

    def _on_alarm(self, *_: Any) -> None:
        self.up = True
        raise TimeUp

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, self._before)


COLUMNS = ("runners x envs", "steps/s", "per CPU s", "iteration", "sampling", "learning", "rest")
HEADER = " ".join(f"{column:>14}" for column in COLUMNS) + "   of sampling: env, network, connectors"


def line(row: Row | Failed) -> str:
    name = f"{row.runners} x {row.envs}"
    if isinstance(row, Failed):
        return f"{name:>14} {row.reason}"
    seconds = (row.iteration_s, row.sample_s, row.learn_s, row.rest_s)
    cells = [name, f"{row.steps_per_s:,.0f}", f"{row.steps_per_cpu_s:,.0f}", *(f"{one:.2f} s" for one in seconds)]
    shares = f"{row.env_step_share:.0%}, {row.inference_share:.0%}, {row.connectors_share:.0%}"
    few = "" if row.iterations > 1 else "   (one iteration only)"
    return " ".join(f"{cell:>14}" for cell in cells) + f"   {shares}{few}"


def measure(
    env: str, runners: int, envs: int, iterations: int, batch: int, limit: float, *, rllib_connectors: bool = False
) -> Row | Failed:
    """Train a few iterations and return the medians of those that ended in time."""
    taken: list[Iteration] = []
    time_limit = TimeLimit(limit)
    config = configuration(env, runners, envs, batch, rllib_connectors=rllib_connectors)
    try:
        with time_limit, training_run.stopping(config.build_algo()) as algorithm:
            clock = Clock(algorithm)
            clock.iteration()  # the first one warms up
            for _ in range(iterations):
                one = clock.iteration()
                if time_limit.up:  # what caught TimeUp went on
                    break
                taken.append(one)
    except Exception as error:  # Ray's and the environment's own: the other configurations are still worth measuring
        if not time_limit.up:  # Ray's `wait` makes a SystemError of TimeUp
            return Failed(runners, envs, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
    if not taken:
        return Failed(runners, envs, f"no iteration ended within {limit:.3g} s")
    medians = {name: statistics.median(getattr(one, name) for one in taken) for name in Iteration.__dataclass_fields__}
    return Row(**medians, runners=runners, envs=envs, iterations=len(taken))


def configuration(env: str, runners: int, envs: int, batch: int, *, rllib_connectors: bool = False) -> Any:
    """Return PPO's configuration as the UR5 script trains it, the batch smaller."""
    from ray.rllib.algorithms.ppo import PPOConfig

    config = training_run.default_config("PPO")
    assert isinstance(config, PPOConfig)
    config.environment(env, env_config={"rs_state_to_info": False} if env.startswith("rlservo.envs:rlservo/") else {})
    config.env_runners(num_env_runners=runners, num_envs_per_env_runner=envs)
    if not rllib_connectors:
        use_batched_connectors(config, observation_filter=False)
    config.training(train_batch_size_per_learner=batch, minibatch_size=MINIBATCH, num_epochs=4)
    config.rl_module(model_config={"fcnet_hiddens": [256, 256], "fcnet_activation": "tanh", "vf_share_layers": False})
    config.fault_tolerance(restart_failed_env_runners=False)
    config.debugging(seed=0)
    return config


class Clock:
    """Times an algorithm's iterations, and in them sampling and learning: RLlib's own timers are smoothed over many."""

    def __init__(self, algorithm: Any) -> None:
        self._algorithm = algorithm
        self._seconds = {"sample": 0.0, "learn": 0.0}
        self._steps = 0.0
        group, learners = algorithm.env_runner_group, algorithm.learner_group
        group.foreach_env_runner = self._timed("sample", group.foreach_env_runner)
        learners.update = self._timed("learn", learners.update)

    def _timed(self, part: str, function: Any) -> Any:
        def timed(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self._seconds[part] += time.perf_counter() - began

        return timed

    def iteration(self) -> Iteration:
        cpu, steps = cpu_seconds(self._algorithm), self._steps
        self._seconds = {"sample": 0.0, "learn": 0.0}
        began = time.perf_counter()
        result = self._algorithm.train()
        wall = time.perf_counter() - began
        sample, learn = self._seconds.values()
        cpu = cpu_seconds(self._algorithm) - cpu
        self._steps = float(result[training_run.STEPS])
        steps = self._steps - steps
        return Iteration(steps / wall, steps / cpu, wall, sample, learn, wall - sample - learn, *parts(result))


def cpu_seconds(algorithm: Any) -> float:
    """Return the processor time of the driver, which learns, and of its env runners so far."""
    runners = algorithm.env_runner_group.foreach_env_runner(lambda _: time.process_time(), local_env_runner=False)
    return time.process_time() + float(sum(runners))


def parts(result: dict[str, Any]) -> tuple[float, float, float]:
    """Return the shares of a runner's own time: its simulators, network and pipelines."""
    runner = result["env_runners"]
    each = (
        float(runner["env_step_timer"]),
        float(runner["rlmodule_inference_timer"]),
        sum(
            float(runner[name]["connector_pipeline_timer"])
            for name in ("env_to_module_connector", "module_to_env_connector")
        ),
    )
    simulators, network, pipelines = (seconds / sum(each) for seconds in each)
    return simulators, network, pipelines


def document(rows: list[Row | Failed], env: str, batch: int) -> dict[str, Any]:
    """Return what has been measured so far."""
    return {"env": env, "batch": batch, "rows": [asdict(row) for row in rows]}


if __name__ == "__main__":
    training_run.main_with_sentences(main, __file__)
