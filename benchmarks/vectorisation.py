"""Several UR5s in one process: environment steps per second by method and number of robots.

    python benchmarks/vectorisation.py            # 1, 4 and 16 robots; about a minute and a half
    python benchmarks/vectorisation.py --quick    # about 30 s

Whole environments (random actions, resets included): Gymnasium's SyncVectorEnv, which is RLlib's default; its
AsyncVectorEnv, a process each; a bare Python loop; and the loop's environments divided among threads (MuJoCo releases
the interpreter's lock in `mj_step`). Physics alone, the same substeps without observations, rewards and resets, is an
upper bound for any batching: substep by substep as our simulators do, a cycle in one call, the same in threads, and
`mujoco.rollout`.

The methods alternate in each round, and each is compared with SyncVectorEnv in the same round: medians of wall clock
and of this process's CPU time, which stays comparable on a busy machine (but does not show the gain of two cores, nor
AsyncVectorEnv). Written to `bench/vectorisation.json` and `.png` as it goes.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from mujoco import rollout

UR5 = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
SYNC, ASYNC = "SyncVectorEnv", "AsyncVectorEnv, a process each"
THREADS = min(4, os.cpu_count() or 1)
Way = Callable[[], None]  # one step of all robots
Rates = dict[str, dict[int, list[tuple[float, float]]]]  # by method and robots, per round: steps/s, steps per CPU s
WALL, CPU = 0, 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.7, help="per way, number of robots and round")
    parser.add_argument("--quick", action="store_true", help="three rounds of 0.2 s")
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    if min(args.robots) < 1 or args.rounds < 1 or args.seconds <= 0.0:
        parser.error("--robots, --rounds and --seconds: expected positive numbers")
    measure(args.robots, *((3, 0.2) if args.quick else (args.rounds, args.seconds)), out=args.out)


def measure(robots: Sequence[int], rounds: int, seconds: float, *, out: Path) -> Rates:
    """Measure every method with each number of robots, print the table, write JSON and plot after each number."""
    out.mkdir(parents=True, exist_ok=True)
    rates: Rates = {}
    print(
        "UR5, environment steps/s (of SyncVectorEnv by wall clock, by CPU time)\n"
        f"{'':46}" + "".join(f"{f'{n} robot' + 's' * (n > 1):>22}" for n in robots)
    )
    for count in robots:
        with contextlib.ExitStack() as stack:
            ways = {name: stack.enter_context(way) for name, way in ways_of(count).items()}
            for _ in range(rounds):
                for name, step in ways.items():
                    rates.setdefault(name, {}).setdefault(count, []).append(rate(step, count, seconds))
        write(rates, robots, out)
    for name in rates:
        print(f"{name:46}" + "".join(cell(rates, name, n) for n in robots))
    print(f"written: {out / 'vectorisation.json'}, {out / 'vectorisation.png'}", flush=True)
    return rates


def cell(rates: Rates, name: str, robots: int) -> str:
    cpu = "    -" if name == ASYNC else f"{ratio(rates, name, robots, CPU):5.2f}"
    return f"{median(rates, name, robots):>8,.0f} ({ratio(rates, name, robots, WALL):5.2f},{cpu})"


def rate(step: Way, robots: int, seconds: float) -> tuple[float, float]:
    """Return environment steps of all robots together per second, and per second of this process's CPU time."""
    step()
    count, began, cpu = 0, time.perf_counter(), time.process_time()
    while (elapsed := time.perf_counter() - began) < seconds:
        step()
        count += robots
    return count / elapsed, count / max(time.process_time() - cpu, 1e-6)


def median(rates: Rates, name: str, robots: int) -> float:
    return statistics.median(wall for wall, _ in rates[name][robots])


def ratio(rates: Rates, name: str, robots: int, clock: int) -> float:
    """Return the median over the rounds of a method's speed relative to SyncVectorEnv's."""
    pairs = zip(rates[name][robots], rates[SYNC][robots], strict=True)
    return statistics.median(own[clock] / sync[clock] for own, sync in pairs)


def ways_of(robots: int) -> dict[str, contextlib.AbstractContextManager[Way]]:
    return {
        SYNC: vector_env(SyncVectorEnv, robots),
        ASYNC: vector_env(AsyncVectorEnv, robots),
        "bare loop": environments(robots, threads=0),
        f"bare loop, divided among {THREADS} threads": environments(robots, threads=THREADS),
        "physics alone: substep by substep": physics_loop(robots, substeps_at_once=False, threads=0),
        "physics alone: a cycle in one call": physics_loop(robots, substeps_at_once=True, threads=0),
        f"physics alone: that, in {THREADS} threads": physics_loop(robots, substeps_at_once=True, threads=THREADS),
        "physics alone: mujoco.rollout": physics_rollout(robots, threads=0),
        f"physics alone: mujoco.rollout, {THREADS} threads": physics_rollout(robots, threads=THREADS),
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
        yield lambda: cast(None, envs.step(next(actions)))
    finally:
        envs.close()


@contextlib.contextmanager
def environments(robots: int, *, threads: int) -> Iterator[Way]:
    """Whole environments in a loop, or in one loop per thread."""
    envs = [make() for _ in range(robots)]
    for index, env in enumerate(envs):
        env.reset(seed=index)
    actions = actions_of(envs[0].action_space)

    def one(env: gym.Env[Any, Any], action: Any) -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    with divided(envs, threads) as each:
        yield lambda: each(lambda env: one(env, next(actions)))
    for env in envs:
        env.close()


@contextlib.contextmanager
def divided(items: Sequence[Any], threads: int) -> Iterator[Callable[[Callable[[Any], None]], None]]:
    """Give a function that applies another to every item: in a loop, or in one loop per thread."""

    def loop(chunk: Sequence[Any], work: Callable[[Any], None]) -> None:
        for item in chunk:
            work(item)

    if not threads:
        yield partial(loop, items)
        return
    chunks = [items[start::threads] for start in range(threads) if items[start::threads]]
    with ThreadPoolExecutor(threads) as pool:

        def in_threads(work: Callable[[Any], None]) -> None:
            list(pool.map(lambda chunk: loop(chunk, work), chunks))

        yield in_threads


def physics(robots: int) -> tuple[Any, list[Any], int]:
    """Return the UR5's model, a state of it for each robot, and the substeps of an environment step."""
    env = cast(Any, make().unwrapped)
    env.reset(seed=0)
    simulation = env.simulation
    datas = [mujoco.MjData(simulation.model) for _ in range(robots)]
    for data in datas:
        data.qpos[:] = data.act[:] = simulation.data.qpos
        mujoco.mj_forward(simulation.model, data)
    substeps = int(simulation._substeps)
    env.close()
    return simulation.model, datas, substeps


@contextlib.contextmanager
def physics_loop(robots: int, *, substeps_at_once: bool, threads: int) -> Iterator[Way]:
    """`mj_step`, called for every substep and asked for contacts, or once for all of a cycle."""
    model, datas, substeps = physics(robots)

    def one(data: Any) -> None:
        if substeps_at_once:
            mujoco.mj_step(model, data, nstep=substeps)
            return
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            if data.ncon:
                pass

    with divided(datas, threads) as each:
        yield lambda: each(one)


@contextlib.contextmanager
def physics_rollout(robots: int, *, threads: int) -> Iterator[Way]:
    """MuJoCo's batched stepping: states and setpoints in, states of every substep out."""
    model, datas, substeps = physics(robots)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((robots, mujoco.mj_stateSize(model, kind)))
    for row, data in zip(states, datas, strict=True):
        mujoco.mj_getState(model, data, row, kind)
    control = np.zeros((robots, substeps, model.nu))
    after = np.zeros((robots, substeps, states.shape[1]))
    sensors = np.zeros((robots, substeps, model.nsensordata))
    own = [mujoco.MjData(model) for _ in range(max(1, threads))]
    with rollout.Rollout(nthread=threads) as pool:

        def step() -> None:
            pool.rollout(model, own, states, control, state=after, sensordata=sensors)
            states[:] = after[:, -1]

        yield step


def write(rates: Rates, robots: Sequence[int], out: Path) -> None:
    """Write what has been measured so far."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    done = [count for count in robots if count in rates[SYNC]]
    document = {
        name: {
            str(n): {
                "steps_per_s": median(rates, name, n),
                "of_sync": ratio(rates, name, n, WALL),
                "of_sync_per_cpu_s": None if name == ASYNC else ratio(rates, name, n, CPU),
                "rounds": own[n],
            }
            for n in done
        }
        for name, own in rates.items()
    }
    (out / "vectorisation.json").write_text(json.dumps(document, indent=2) + "\n")
    figure, axes = pyplot.subplots(figsize=(8, 4), layout="constrained")
    for name in rates:
        style = "--" if name.startswith("physics") else "-"
        axes.plot(done, [median(rates, name, n) for n in done], style, marker="o", label=name)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set(xlabel="robots in one process", ylabel="environment steps/s", title=UR5)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="x-small")
    figure.savefig(out / "vectorisation.png", dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
