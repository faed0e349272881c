"""Gate before a real robot: a policy must have succeeded in simulation, under what was measured of the robot."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rlservo.bundle.contract import Contract, Evaluation
from rlservo.drive.disturbance import parse_disturbance
from rlservo.errors import UsageError

if TYPE_CHECKING:
    import gymnasium as gym

logger = logging.getLogger(__name__)
PROVEN_COLLISIONS = 0.05  # of the episodes, at most
PROVEN_SUCCESS = 0.8  # lower end of the 95% interval required on a real robot: at least 16 of 16 episodes


def check_proven(contract: Contract, env: gym.Env[Any, Any]) -> None:
    """Raise UsageError if the robot is real and no evaluation under latency shows that the policy succeeds."""
    if not getattr(env.unwrapped, "is_real", False):
        return
    found = [one for one in contract.evaluations if _action_latency(one.disturbance)]
    good = [one for one in found if one.success_interval and one.success_interval[0] >= PROVEN_SUCCESS]
    differences = [_difference_to(one, env) for one in good]
    if None in differences:
        proof = good[differences.index(None)]
        if collisions := proof.endings.get("collision", 0):
            logger.warning("%d of %d evaluated episodes ended in a collision", collisions, proof.episodes)
        return
    why = "was never evaluated under latency"
    if good:
        why = f"was evaluated for another robot: {'; '.join(str(one) for one in differences)}"
    elif found:
        rows = ", ".join(
            f"{one.disturbance}: {_rate(one.success_rate_bundle)} of {one.episodes} episodes" for one in found
        )
        why = f"succeeded too rarely, or in too few episodes, under latency ({rows})"
    raise UsageError(
        f"policy '{contract.name}' version {contract.version} {why}: a real robot needs one whose 95% interval of "
        f"success begins at {PROVEN_SUCCESS:.0%} or above. Measure the robot with `rlservo robot-latency`, evaluate "
        "with the `rlservo verify --disturb ... --write` that it prints, or pass --unproven"
    )


def _rate(rate: float | None) -> str:
    return "no success rate" if rate is None else f"{rate:.0%}"


def _difference_to(evaluation: Evaluation, env: gym.Env[Any, Any]) -> str | None:
    """Return the first difference of an evaluation's robot to the real arm, with both values; None for none.

    A robot that does not describe itself is not compared.
    """
    facts: Mapping[str, Any] | None = getattr(env.unwrapped, "robot_facts", None)
    if facts is None or env.spec is None:
        return None
    row = f"evaluation {evaluation.disturbance}"
    evaluated, driven = (one.rpartition("/")[2].replace("Sim-v", "-v") for one in (evaluation.env_id, env.spec.id))
    if evaluated != driven.replace("Rob-v", "-v"):
        return f"{row} is of {evaluation.env_id}, but the robot's is {env.spec.id}"
    for name, here in facts.items():
        there = evaluation.robot.get(name, "unknown")
        if there != here:
            return f"{row} has {name} {there}, but the robot has {here}"
    collisions = evaluation.endings.get("collision", 0)
    if collisions > PROVEN_COLLISIONS * evaluation.episodes:
        return (
            f"{row} has {collisions} collisions in {evaluation.episodes} episodes, but a real robot allows "
            f"{PROVEN_COLLISIONS:.0%}"
        )
    measured_ms, evaluated_cycles = env.unwrapped.measured_latency_ms, _action_latency(evaluation.disturbance)  # type: ignore[attr-defined]
    if measured_ms is None:
        return f"{row} has {evaluated_cycles} cycles of latency, but the robot's was never measured"
    cycles = max(1, math.ceil(measured_ms / 1e3 * float(facts["action_cycle_rate"])))
    if cycles > evaluated_cycles:
        return (
            f"{row} has {evaluated_cycles} cycles of latency, but the robot has up to {cycles} ({measured_ms:.0f} ms)"
        )
    return None


def _action_latency(disturbance: str | None) -> int:
    """Return the control cycles by which actions were late in all episodes of an evaluation."""
    if disturbance is None or "latency=" not in disturbance:
        return 0
    lowest: int = parse_disturbance(disturbance).arguments.get("action_latency", (0, 0))[0]
    return lowest
