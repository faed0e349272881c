"""Simulator speed: environment steps per second on one core, one environment, random actions.

    python benchmarks/simulators.py [--seconds 3]

Medians of five rounds, the environments taking turns; written to bench/simulators.json too.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import time
from pathlib import Path

import gymnasium as gym
from rich.console import Console
from rich.table import Table

GOALS = {  # environment id -> steps per second that we promise
    "rlservo/EndEffectorPositioningURSim-v0": 4000,
    "rlservo/NoObstacleNavigationMir100Sim-v0": None,
    "rlservo/ObstacleAvoidanceMir100Sim-v0": 1500,
}
ROUNDS = 5


def measure(env_id: str, seconds: float) -> float:
    """Return steps per second, resets included, over about `seconds`."""
    env = gym.make(env_id).unwrapped
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(1000)])
    env.reset(seed=0)
    steps, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        for _ in range(50):
            _, _, terminated, truncated, _ = env.step(next(actions))
            if terminated or truncated:
                env.reset()
        steps += 50
    env.close()
    return steps / elapsed


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure simulator speed on one core.")
    parser.add_argument("--seconds", type=float, default=3.0, help="per environment and round")
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    rounds: dict[str, list[float]] = {env_id: [] for env_id in GOALS}
    for _ in range(ROUNDS):
        for env_id, speeds in rounds.items():
            speeds.append(measure(env_id, args.seconds))

    table = Table(title="Simulator speed, one core, random actions")
    for column in ("environment", "steps/s (median)", "slowest round", "goal"):
        table.add_column(column, justify="left" if column == "environment" else "right")
    results = {}
    for env_id, speeds in rounds.items():
        results[env_id] = {"median": statistics.median(speeds), "rounds": speeds, "goal": GOALS[env_id]}
        goal = f"{GOALS[env_id]:,}" if GOALS[env_id] else "-"
        table.add_row(env_id, f"{statistics.median(speeds):,.0f}", f"{min(speeds):,.0f}", goal)
    Console().print(table)
    args.out.mkdir(exist_ok=True)
    (args.out / "simulators.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
