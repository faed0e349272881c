"""Steps per second of robo-gym's own environments; `robot_server.py` runs this in robo-gym's Python.

    python robo_gym_steps.py MANAGER_PORT SECONDS ROUNDS

The last line it prints is JSON: which protobuf this Python has, and for each robot the steps per second of each round
and the client's processor time per step.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

import gymnasium as gym
import numpy as np
from google.protobuf.internal import api_implementation

ENVIRONMENTS = {"ur5": "EndEffectorPositioningURSim-v0", "mir100": "ObstacleAvoidanceMir100Sim-v0"}


def measure(env_id: str, port: int, seconds: float, rounds: int) -> dict[str, Any]:
    """Return steps per second and client CPU milliseconds per step of each round; small random actions."""
    made = gym.make(
        env_id, ip="127.0.0.1", lower_bound_port=port, upper_bound_port=port + 1, rs_state_to_info=False,
        disable_env_checker=True,
    )  # fmt: skip
    env: Any = made.unwrapped
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (200, *env.action_space.shape)).astype(np.float32)
    per_s, cpu_ms = [], []
    for _ in range(rounds):
        env.reset()
        steps, spent, cpu = 0, 0.0, 0.0
        while spent < seconds:
            began, cpu_began = time.perf_counter(), time.process_time()
            _, _, ended, _, _ = env.step(actions[steps % len(actions)])
            spent, cpu, steps = spent + time.perf_counter() - began, cpu + time.process_time() - cpu_began, steps + 1
            if ended:
                env.reset()  # not counted
        per_s.append(steps / spent)
        cpu_ms.append(1e3 * cpu / steps)
    env.kill_sim()
    return {"steps_per_s": per_s, "client_cpu_ms_per_step": cpu_ms}


def main() -> None:
    importlib.import_module("robo_gym")  # registers its environments
    port, seconds, rounds = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    results = {name: measure(env_id, port, seconds, rounds) for name, env_id in ENVIRONMENTS.items()}
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    print(json.dumps({"python": python, "protobuf": api_implementation.Type(), **results}))


if __name__ == "__main__":
    main()
