"""Simulator speed: environment steps per second on one core, one environment, random actions.

    python benchmarks/simulators.py [--seconds 3]

Steps per second of wall clock, and per second of this process's CPU time, which stays comparable on a busy machine.
Medians of five rounds, the environments alternating; written to bench/simulators.json as well.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from pathlib import Path

import gymnasium as gym
from rich.console import Console
from rich.table import Table

GOALS = {  # environment id -> steps per second that we promise
    "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0": 4000,
    "rlservo.envs:rlservo/NoObstacleNavigationMir100Sim-v0": None,
    "rlservo.envs:rlservo/ObstacleAvoidanceMir100Sim-v0": 1500,
}
ROUNDS = 5


def measure(env_id: str, seconds: float) -> tuple[float, float]:
    """Return steps per second of wall clock and of CPU time, resets included, over about `seconds`."""
    env = gym.make(env_id).unwrapped
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(1000)])
    env.reset(seed=0)
    steps, began, cpu_began = 0, time.perf_counter(), time.process_time()
    while (elapsed := time.perf_counter() - began) < seconds:
        for _ in range(50):
            _, _, terminated, truncated, _ = env.step(next(actions))
            if terminated or truncated:
                env.reset()
        steps += 50
    cpu = time.process_time() - cpu_began
    env.close()
    return steps / elapsed, steps / cpu


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure simulator speed on one core.")
    parser.add_argument("--seconds", type=float, default=3.0, help="per environment and round")
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    rounds: dict[str, list[tuple[float, float]]] = {env_id: [] for env_id in GOALS}
    for _ in range(ROUNDS):
        for env_id, speeds in rounds.items():
            speeds.append(measure(env_id, args.seconds))

    table = Table(title="Simulator speed, one core, random actions")
    table.add_column("environment", overflow="fold")
    for column in ("steps/s", "slowest round", "steps per CPU second", "goal"):
        table.add_column(column, justify="right")
    results = {}
    for env_id, speeds in rounds.items():
        wall, cpu = ([speed[which] for speed in speeds] for which in (0, 1))
        goal = GOALS[env_id]
        results[env_id] = {
            "steps_per_s": statistics.median(wall),
            "steps_per_cpu_s": statistics.median(cpu),
            "rounds": speeds,
            "goal": goal,
        }
        figures = (statistics.median(wall), min(wall), statistics.median(cpu))
        table.add_row(env_id, *(f"{figure:,.0f}" for figure in figures), f"{goal:,}" if goal else "-")
    Console().print(table)
    args.out.mkdir(exist_ok=True)
    (args.out / "simulators.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
