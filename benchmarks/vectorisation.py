"""Several UR5s in one process: environment steps per second by method and number of robots.

    python benchmarks/vectorisation.py            # 1, 4 and 16 robots; about a minute
    python benchmarks/vectorisation.py --quick    # about 15 s

Random actions, resets included: Gymnasium's SyncVectorEnv, which is RLlib's default; its AsyncVectorEnv, a process
each; a bare Python loop; and the loop's environments divided among threads (MuJoCo releases the interpreter's lock in
`mj_step`).

The methods alternate in each round, and each is compared with SyncVectorEnv in the same round: medians of wall clock
and of this process's CPU time, which stays comparable on a busy machine (but does not show the gain of two cores, nor
AsyncVectorEnv). Written to `bench/vectorisation.json` as it goes.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import statistics
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from measuring import CPU, WALL, alternate, column, median_ratio, parser, rate, show, write

UR5 = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
SYNC, ASYNC = "SyncVectorEnv", "AsyncVectorEnv, a process each"
THREADS = min(4, os.cpu_count() or 1)
Way = Callable[[], object]  # one step of all robots


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--robots", type=int, nargs="+", default=[1, 4, 16])
    options.add_argument("--quick", action="store_true", help="three rounds of 0.2 s, not five of 0.7 s")
    args = options.parse_args()
    if min(args.robots) < 1:
        options.error("--robots: expected positive numbers")
    measure(args.robots, *((3, 0.2) if args.quick else (5, 0.7)), out=args.out)


def measure(robots: Sequence[int], rounds: int, seconds: float, *, out: Path) -> dict[str, dict[str, Any]]:
    """Measure every method with each number of robots, write JSON after each number, and print the table."""
    results: dict[str, dict[str, Any]] = {}
    for count in robots:
        with contextlib.ExitStack() as stack:
            ways = {name: stack.enter_context(way) for name, way in ways_of(count).items()}
            found = alternate({name: partial(rate, way, seconds, each=count) for name, way in ways.items()}, rounds)
        for name, own in found.items():
            ratios = [median_ratio(column(own, clock), column(found[SYNC], clock)) for clock in (WALL, CPU)]
            results.setdefault(name, {})[str(count)] = {
                "steps_per_s": statistics.median(column(own, WALL)),
                "of_sync": ratios[WALL],
                "of_sync_per_cpu_s": None if name == ASYNC else ratios[CPU],
                "rounds": own,
            }
        write(out, "vectorisation", results)
    columns = ("steps/s (of SyncVectorEnv by wall clock, by CPU time)", *map(str, robots))
    show("UR5, by the number of robots", columns, [[name, *map(cell, own.values())] for name, own in results.items()])
    return results


def cell(figures: dict[str, Any]) -> str:
    cpu = figures["of_sync_per_cpu_s"]
    return f"{figures['steps_per_s']:,.0f} ({figures['of_sync']:.2f}, {'-' if cpu is None else f'{cpu:.2f}'})"


def ways_of(robots: int) -> dict[str, contextlib.AbstractContextManager[Way]]:
    return {
        SYNC: vector_env(SyncVectorEnv, robots),
        ASYNC: vector_env(AsyncVectorEnv, robots),
        "bare loop": environments(robots, threads=1),
        f"bare loop, divided among {THREADS} threads": environments(robots, threads=THREADS),
    }


def make() -> gym.Env[Any, Any]:
    return gym.make(UR5, disable_env_checker=True, rs_state_to_info=False)


def actions_of(space: Any, count: int = 1000) -> Iterator[Any]:
    space.seed(0)
    return itertools.cycle([space.sample() for _ in range(count)])


@contextlib.contextmanager
def vector_env(kind: type[SyncVectorEnv] | type[AsyncVectorEnv], robots: int) -> Iterator[Way]:
    """Gymnasium's own vector environments."""
    envs = kind([make] * robots)
    try:
        envs.reset(seed=0)
        actions = actions_of(envs.action_space)
        yield lambda: envs.step(next(actions))
    finally:
        envs.close()


@contextlib.contextmanager
def environments(robots: int, *, threads: int) -> Iterator[Way]:
    """Environments in one loop per thread; one is this thread."""
    envs = [make() for _ in range(robots)]
    for index, env in enumerate(envs):
        env.reset(seed=index)
    actions = actions_of(envs[0].action_space)

    def loop(chunk: Sequence[gym.Env[Any, Any]]) -> None:
        for env in chunk:
            _, _, terminated, truncated, _ = env.step(next(actions))
            if terminated or truncated:
                env.reset()

    chunks = [envs[start::threads] for start in range(threads) if envs[start::threads]]
    with ThreadPoolExecutor(threads) as pool:
        yield (lambda: list(pool.map(loop, chunks))) if threads > 1 else partial(loop, envs)
    for env in envs:
        env.close()


if __name__ == "__main__":
    main()
