"""Facts by which a browser simulates one of our robots, and episodes of Python's own simulation to check it by."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.drive.environment_fit import check_fit
from rlservo.drive.make_environment import make_env
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy

STARTS = 24  # starts and targets, as the environment draws them
PROOF_STEPS = 120  # control cycles that are recorded at least, in whole episodes, if the starts have so many
BOUND = 1e-4  # of an observation's difference, in its own unit
# Environments whose observations static/robots.js computes.
ARMS = {"EndEffectorPositioningURSim-v0", "IsaacReachURSim-v0", "EndEffectorPositioningPandaSim-v0"}
BASES = {"NoObstacleNavigationMir100Sim-v0", "SparseFixNavigationMir100Sim-v0", "ObstacleAvoidanceMir100Sim-v0"}

Keep = Callable[[NDArray[Any]], Any]
"""Put an array into the page's data and return its place there."""


def robot_facts(contract: Contract, policy: Policy, keep: Keep) -> dict[str, Any] | None:
    """Return the robot of a policy that was trained in one of our simulators; None for any other.

    Raises UsageError if the policy does not fit its environment or the simulator is not installed.
    """
    trained = contract.provenance
    name = (trained.env_id or "").removeprefix("rlservo/")
    if name == "Randomized-v0":
        name = str(trained.env_config.get("env_id", "")).removeprefix("rlservo/")
    if name not in ARMS | BASES:
        return None
    from rlservo.envs.randomization import wrapped_env

    env_id, arguments = wrapped_env(str(trained.env_id), trained.env_config)
    live = {"laser_noise": 0.0} if name in BASES else {}
    made = make_env(env_id, {**arguments, **live}, render=False)
    try:
        check_fit(contract, made, arguments)
        env: Any = made.unwrapped
        described = env.describe(**arguments)
        rate, theirs = contract.control_rate_hz, described["control_rate_hz"]
        if rate is not None and not math.isclose(rate, theirs, rel_tol=1e-3):
            raise UsageError(f"policy {contract.name!r} acts at {rate:g} Hz, but {env_id} at {theirs:g} Hz")
        simulation, (position, lookat) = env.simulation, env.viewpoint()
        facts = {
            "xml": simulation.xml,
            "timestep": float(simulation.model.opt.timestep),
            "observation": described["observation"],
            "action": described["action"],
            "camera": {"position": position.tolist(), "lookat": lookat.tolist()},
            "bound": BOUND,
            **(_arm(env) if name in ARMS else _base(env, arguments)),
        }
        facts["substeps"] = round(1.0 / described["control_rate_hz"] / facts["timestep"])
        return {**facts, "starts": _starts(env, facts["observation"], policy, keep)}
    finally:
        made.close()


def _arm(env: Any) -> dict[str, Any]:
    from rlservo.envs.panda import end_effector_positioning as panda
    from rlservo.envs.ur.isaac_reach import SUCCESS_ANGLE, IsaacReachURSim
    from rlservo.robots.ur.simulation import MIN_TRAJECTORY_S

    simulation = env.simulation
    is_panda = isinstance(env, panda.EndEffectorPositioningPandaSim)
    return {
        "kind": "arm",
        "joints": [env.JOINT_NAMES[joint] for joint in env.JOINTS],
        "actuators": list(env.JOINTS),
        "tool": simulation.tool,
        "base": env.BASE.tolist(),
        "target_body": "object_0",
        "max_velocity": simulation.max_velocity.tolist(),
        "min_trajectory_s": MIN_TRAJECTORY_S,
        "max_steps": env.MAX_STEPS,
        "time_limit_status": env.TIME_LIMIT_STATUS,
        "within": panda.SUCCESS_DISTANCE if is_panda else env.WITHIN,
        "within_angle": SUCCESS_ANGLE if isinstance(env, IsaacReachURSim) else None,
    }


def _base(env: Any, arguments: dict[str, Any]) -> dict[str, Any]:
    from rlservo.envs.mir100 import navigation, no_obstacle_navigation, obstacle_avoidance
    from rlservo.robots.mir100 import parameters, simulation
    from rlservo.robots.mir100.model import BEAM_GROUP

    in_room = isinstance(env, obstacle_avoidance.ObstacleAvoidanceMir100Sim)
    return {
        "kind": "base",
        "target_body": "target",
        "cube_bodies": [f"cube_{index}" for index in range(len(env.simulation.cubes))],
        "limits": [parameters.MAX_LINEAR_VELOCITY, parameters.MAX_ANGULAR_VELOCITY],
        "increments": [simulation.LINEAR_INCREMENT, simulation.ANGULAR_INCREMENT],
        "timeout": simulation.TIMEOUT_SUBSTEPS,
        "safety_distance": parameters.SAFETY_DISTANCE,
        "beam_group": BEAM_GROUP,
        "laser_range": [parameters.LASER_MIN, parameters.LASER_MAX],
        "laser_noise": arguments.get("laser_noise", parameters.LASER_NOISE),
        "scanners": [
            {"position": scanner.position, "angles": scanner.angles.tolist()}
            for scanner in (parameters.FRONT_SCANNER, parameters.BACK_SCANNER)
        ],
        "observed_beams": env.observed_beams.tolist(),
        "fix_interval": getattr(env, "fix_interval", 1),
        "max_steps": navigation.MAX_STEPS,
        "time_limit_status": "max_steps_exceeded",
        "within": navigation.SUCCESS_DISTANCE,
        "boundary": None if in_room else no_obstacle_navigation.BOUNDARY,
        "min_reading": obstacle_avoidance.MIN_READING,
        "safety_radius": obstacle_avoidance.SAFETY_RADIUS,
        "corners": obstacle_avoidance.CORNERS,
    }


def _starts(env: Any, elements: list[Any], policy: Policy, keep: Keep) -> list[dict[str, Any]]:
    """Return what episodes begin with, the first ones with their observations and endings."""
    starts: list[dict[str, Any]] = []
    quaternion = [index for index, element in enumerate(elements) if element.get("quantity") == "quaternion"]
    quaternion.sort(key=lambda index: "wxyz".index(elements[index]["axis"]))
    recorded = 0
    for seed in range(STARTS):
        observation, _ = env.reset(seed=seed)
        starts.append(
            {
                "qpos": env.data.qpos.tolist(),
                "target": env.target_position().tolist(),
                "quaternion": observation[quaternion].tolist(),
                "cubes": getattr(env.simulation, "cubes", []),
            }
        )
        if recorded < PROOF_STEPS:
            observations, info = [observation], {}
            policy.reset()
            while "final_status" not in info:
                observation, _, _, _, info = env.step(policy.act(observation))
                observations.append(observation)
            recorded += len(observations) - 1
            starts[-1] |= {"observations": keep(np.stack(observations)), "status": info["final_status"]}
    return starts
