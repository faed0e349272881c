"""Simulator speed: environment steps per second on one core, one environment, random actions.

    python benchmarks/simulators.py [--seconds 3]

Steps per second of wall clock and of this process's CPU time, resets included. Medians of five rounds, the environments
alternating; written to bench/simulators.json as well.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable
from functools import partial

import gymnasium as gym
from measuring import CPU, WALL, alternate, column, parser, rate, show, write

GOALS = {  # environment id -> steps per second that we promise
    "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0": 4000,
    "rlservo.envs:rlservo/NoObstacleNavigationMir100Sim-v0": None,
    "rlservo.envs:rlservo/ObstacleAvoidanceMir100Sim-v0": 1500,
}
ROUNDS = 5


def stepper(env_id: str) -> Callable[[], None]:
    """Return a function that steps an environment of its own."""
    env = gym.make(env_id).unwrapped
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(1000)])
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return step


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--seconds", type=float, default=3.0, help="per environment and round")
    args = options.parse_args()
    found = alternate({env_id: partial(rate, stepper(env_id), args.seconds) for env_id in GOALS}, ROUNDS)
    rows, results = [], {}
    for env_id, goal in GOALS.items():
        wall, cpu = column(found[env_id], WALL), column(found[env_id], CPU)
        figures = statistics.median(wall), min(wall), statistics.median(cpu)
        rows.append([env_id, *(f"{figure:,.0f}" for figure in figures), f"{goal:,}" if goal else "-"])
        results[env_id] = {
            "steps_per_s": figures[0], "steps_per_cpu_s": figures[2], "rounds": found[env_id], "goal": goal,
        }  # fmt: skip
    columns = ("environment", "steps/s", "slowest round", "steps per CPU second", "goal")
    show("Simulator speed, one core, random actions", columns, rows)
    write(args.out, "simulators", results)


if __name__ == "__main__":
    main()
