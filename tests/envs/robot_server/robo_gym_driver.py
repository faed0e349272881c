"""Runs in robo-gym's environment: drives its own classes on a test's request, and records what they return.

Each line of standard input names a file of jobs and one for their results, with a tab between; the driver prints "done"
when it has written that. If a job says "pause", it prints "paused" after that many steps and waits for a line; if one
says "keep", the next job is another episode in the same environment.

Two of robo-gym 2.0.1's base methods cannot work with any server: `URBaseAvoidanceEnv.reset` calls `super(gym.Env)`,
which has no reset, and refuses the arguments its subclass passes; its `step` returns five values, but the subclasses
unpack four. `mend_avoidance` puts `URBaseEnv.reset` and the four values there. Everything else is as it came from PyPI.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import robo_gym  # noqa: F401 (registers the environments)
from robo_gym.envs.ur.ur_base_avoidance_env import URBaseAvoidanceEnv
from robo_gym.envs.ur.ur_base_env import URBaseEnv
from robo_gym.wrappers.exception_handling import ExceptionHandling


def mend_avoidance() -> None:
    def reset(
        self: Any,
        *,
        options: Any = None,
        joint_positions: Any = None,
        fixed_object_position: Any = None,
        seed: Any = None,
    ) -> Any:
        options = options or {"joint_positions": joint_positions, "fixed_object_position": fixed_object_position}
        fixed = options.get("fixed_object_position")
        compose = type(self)._set_initial_robot_server_state
        self._set_initial_robot_server_state = lambda rs_state: compose(self, rs_state, fixed)
        return URBaseEnv.reset(self, options={"joint_positions": options["joint_positions"]})

    def step(self: Any, action: Any) -> Any:
        state, reward, done, _, info = URBaseEnv.step(self, action)
        return state, reward, done, info

    URBaseAvoidanceEnv.reset, URBaseAvoidanceEnv.step = reset, step


def run(job: dict[str, Any], kept: dict[str, Any]) -> dict[str, Any]:
    """Drive an episode; `kept` holds the environment of a job that says "keep", for the next one that has the same."""
    same = json.dumps([job["env"], job["arguments"]])
    env = kept.pop(same, None) or gym.make(job["env"], disable_env_checker=True, **job["arguments"]).unwrapped
    sent: list[Any] = []  # joint positions or velocities on the wire, and what SetState held
    client = env.client
    set_state, send_action, send_and_get = client.set_state_msg, client.send_action, client.send_action_get_state
    params: list[Any] = []
    client.set_state_msg = lambda message: params.append(dict(message.float_params)) or set_state(message)
    client.send_action = lambda action: sent.append(list(action)) or send_action(action)
    client.send_action_get_state = lambda action: sent.append(list(action)) or send_and_get(action)
    if "seed" in job:
        env.seed(job["seed"])
    result: dict[str, Any] = {"sent": sent, "params": params, "observations": [], "rewards": [], "status": None}
    first = env.reset(**job["reset"])
    first = first[0] if isinstance(first, tuple) else first
    result["observations"].append(first.tolist())
    result["obstacles"] = getattr(env, "sim_obstacles", None)
    for action in job["actions"]:
        if job.get("pause") == len(result["rewards"]):
            print("paused", flush=True)
            sys.stdin.readline()
        answer = env.step(np.array(action, dtype=np.float32))
        result["observations"].append(answer[0].tolist())
        result["rewards"].append(float(answer[1]))
        if answer[2]:
            result["status"] = answer[-1]["final_status"]
            break
    client.set_state_msg, client.send_action, client.send_action_get_state = set_state, send_action, send_and_get
    if job.get("keep"):
        kept[same] = env
        return result
    getattr(env, "kill_sim", lambda: None)()  # `close` of the UR environments finds gymnasium's before robo-gym's
    return result


def run_through_a_crash(job: dict[str, Any], _: dict[str, Any]) -> dict[str, Any]:
    """Episode, crash, and on with robo-gym's own wrapper for it."""
    env = ExceptionHandling(gym.make(job["env"], disable_env_checker=True, **job["arguments"]).unwrapped)
    env.reset()
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    env.step(action)
    print("paused", flush=True)
    sys.stdin.readline()
    *_, done, _, info = env.step(action)
    result = {"exception": type(info.get("ExceptionType")).__name__, "done": done}
    env.reset()
    _, _, done, _, info = env.step(action)
    result["goes_on"] = "ExceptionType" not in info and not done
    env.unwrapped.kill_sim()
    return result


def main() -> None:
    mend_avoidance()
    while line := sys.stdin.readline():
        asked, answered = map(Path, line.rstrip("\n").split("\t"))
        results, kept = [], {}
        for job in json.loads(asked.read_text()):
            try:
                results.append((run_through_a_crash if job.get("crash") else run)(job, kept))
            except Exception as error:
                results.append({"error": f"{type(error).__name__}: {error}"})
        answered.write_text(json.dumps(results))
        print("done", flush=True)


if __name__ == "__main__":
    main()
