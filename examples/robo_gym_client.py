"""robo-gym's own environment, driven by a policy that is served somewhere: on our simulator, or on the real robot.

    rlservo serve policies                # one terminal, in rlservo's environment
    rlservo server-manager                # another one
    python examples/robo_gym_client.py    # a third, in robo-gym's environment
    python examples/robo_gym_client.py --task ObstacleAvoidanceMir100 --policy mir100_obstacle_avoidance

robo-gym pins an old protobuf, so it cannot share an environment with Ray. Its own holds robo-gym and the light client:

    python3 -m venv robo-gym && robo-gym/bin/pip install robo-gym==2.0.1 'httpx>=0.27' 'pydantic>=2.6'
    robo-gym/bin/pip install --no-deps rlservo

`--rs-address` drives a robot server that is already running, the real robot's for example: read examples/robo_gym.md
before that.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from typing import Any

import gymnasium as gym
import numpy as np

from rlservo.export.errors import RlservoError
from rlservo.serve_app.client import PolicyClient

# robo-gym's names, and the policies that README.md serves for them.
POLICIES = {
    "EndEffectorPositioningUR": "ur5",
    "NoObstacleNavigationMir100": "mir100",
    "ObstacleAvoidanceMir100": "mir100_obstacle_avoidance",
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Drive one of robo-gym's own environments with a served policy.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--task", choices=POLICIES, default="EndEffectorPositioningUR", help="(default: %(default)s)")
    parser.add_argument(
        "--policy", help="its name on the server (default: ur5, mir100 or mir100_obstacle_avoidance, by the task)"
    )
    parser.add_argument("--ur-model", help="of a UR task (default: ur5)")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--manager", default="127.0.0.1", help="where rlservo server-manager runs")
    parser.add_argument("--manager-port", type=int, help="its port; without it 50100 to 50199 are searched")
    parser.add_argument("--rs-address", help="host:port of a running robot server, instead of a manager")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    args = parser.parse_args()
    is_arm = args.task.endswith("UR")
    if args.ur_model is not None and not is_arm:
        parser.error(f"--ur-model is for UR tasks, and {args.task} has a MiR100")

    importlib.import_module("robo_gym")  # registers its environments

    if args.rs_address:
        env_id, arguments = f"{args.task}Rob-v0", {"rs_address": args.rs_address}
    else:
        env_id, arguments = f"{args.task}Sim-v0", {"ip": args.manager}
        if args.manager_port is not None:
            arguments |= {"lower_bound_port": args.manager_port, "upper_bound_port": args.manager_port + 1}
    if is_arm:
        arguments["ur_model"] = args.ur_model or "ur5"
    env = gym.make(env_id, **arguments).unwrapped
    kill_sim = getattr(env, "kill_sim", None)  # robo-gym's own; its UR environments' `close` leaves the simulator
    endings: list[str] = []
    seconds: list[float] = []  # from asking for an action to having it
    try:
        with PolicyClient(args.url, args.policy or POLICIES[args.task]) as policy:
            for _ in range(args.episodes):
                endings.append(drive_one_episode(env, policy, seconds))
                if not args.json:
                    print(f"episode {len(endings)}: {endings[-1]}")
    finally:
        if kill_sim is not None:
            kill_sim()

    p50, p95, p99 = (1000.0 * np.percentile(seconds, [50, 95, 99])).tolist()
    report = {
        "environment": env_id,
        "episodes": len(endings),
        "successes": endings.count("success"),
        "endings": {ending: endings.count(ending) for ending in sorted(set(endings))},
        "steps": len(seconds),
        "latency_ms": {"p50": p50, "p95": p95, "p99": p99},
    }
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        print(f"{report['successes']} of {len(endings)} at the target")
        print(f"action latency p50 {p50:.2f} ms, p95 {p95:.2f} ms, p99 {p99:.2f} ms over {len(seconds):,} steps")


def drive_one_episode(env: gym.Env[Any, Any], policy: PolicyClient, seconds: list[float]) -> str:
    """Return how the episode ended."""
    first = env.reset()
    obs = first[0] if isinstance(first, tuple) else first  # robo-gym 2.0.1's obstacle avoidance gives no info
    policy.reset()
    while True:
        began = time.perf_counter()
        action = policy.act(obs)
        seconds.append(time.perf_counter() - began)
        obs, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return str(info["final_status"])


if __name__ == "__main__":
    try:
        main()
    except RlservoError as error:
        raise SystemExit(f"error: {error}") from None
