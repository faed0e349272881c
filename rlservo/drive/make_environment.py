"""Environment of a rollout, and the check that the policy fits it."""

from __future__ import annotations

import difflib
import logging
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.bundle.contract import Contract, Evaluation
from rlservo.bundle.conventions import contradiction, missing, parse_elements
from rlservo.bundle.environment_id import importing_id
from rlservo.bundle.spaces import (
    BoxSpec,
    DictSpec,
    Element,
    MultiBinarySpec,
    MultiDiscreteSpec,
    SpaceSpec,
    TupleSpec,
)
from rlservo.drive.disturbance import parse_disturbance
from rlservo.errors import UsageError
from rlservo.extras import install, needs_extra

if TYPE_CHECKING:
    import gymnasium as gym

logger = logging.getLogger(__name__)
PROVEN_COLLISIONS = 0.05  # of the episodes, at most
PROVEN_SUCCESS = 0.8  # lower end of the 95% interval required on a real robot: at least 16 of 16 episodes


def make_env(env_id: str, arguments: Mapping[str, Any], *, render: bool) -> gym.Env[Any, Any]:
    """Return the environment, or raise UsageError: no such id (with close matches), a missing extra, bad arguments."""
    with needs_extra("sim", what="a rollout"):
        import gymnasium as gym
    mode = {"render_mode": "rgb_array"} if render else {}
    try:
        # Gymnasium's checker inspects every step and warns on the terminal, which is meant for environment authors.
        return gym.make(importing_id(env_id), disable_env_checker=True, **{**arguments, **mode})
    except gym.error.UnregisteredEnv as error:
        close = difflib.get_close_matches(env_id, list(gym.registry), n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else "write 'module:Id' to import the module that has it"
        raise UsageError(f"environment {env_id!r} is not registered: {hint}", {"close_matches": close}) from error
    except (ModuleNotFoundError, gym.error.DependencyNotInstalled) as error:
        hint = install("sim") if env_id.startswith("rlservo/") else "install it, or name its folder with --app-dir"
        raise UsageError(f"environment {env_id!r} cannot be made: {error}: {hint}") from error
    except Exception as error:  # a constructor is third-party code
        raise UsageError(f"environment {env_id!r} cannot be made with {arguments}: {error}") from error


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
        return f"{row} is of {evaluation.env_id}, the robot's is {env.spec.id}"
    for name, here in facts.items():
        there = evaluation.robot.get(name, "unknown")
        if there != here:
            return f"{row} has {name} {there}, the robot {here}"
    collisions = evaluation.endings.get("collision", 0)
    if collisions > PROVEN_COLLISIONS * evaluation.episodes:
        return (
            f"{row} has {collisions} collisions in {evaluation.episodes} episodes, a real robot takes "
            f"{PROVEN_COLLISIONS:.0%}"
        )
    measured_ms, evaluated_cycles = env.unwrapped.measured_latency_ms, _action_latency(evaluation.disturbance)  # type: ignore[attr-defined]
    if measured_ms is None:
        return f"{row} has {evaluated_cycles} cycles of latency, the robot's was never measured"
    cycles = max(1, math.ceil(measured_ms / 1e3 * float(facts["action_cycle_rate"])))
    if cycles > evaluated_cycles:
        return f"{row} has {evaluated_cycles} cycles of latency, the robot up to {cycles} ({measured_ms:.0f} ms)"
    return None


def _action_latency(disturbance: str | None) -> int:
    """Return the control cycles by which actions were late in all episodes of an evaluation."""
    if disturbance is None or "latency=" not in disturbance:
        return 0
    lowest: int = parse_disturbance(disturbance).arguments.get("action_latency", (0, 0))[0]
    return lowest


def control_rate_of(env: gym.Env[Any, Any], arguments: Mapping[str, Any], contract: Contract) -> float | None:
    """Return the rate at which actions are due [Hz]: the environment's own, else the contract's, else render_fps.

    `render_fps` comes last because Gymnasium's own environments mean it for videos (Pendulum: 30 at 20 Hz).
    """
    described_hz = _description(env, arguments).get("control_rate_hz")
    for candidate in (described_hz, contract.control_rate_hz, env.unwrapped.metadata.get("render_fps")):
        if candidate:
            return float(candidate)
    return None


def check_fit(contract: Contract, env: gym.Env[Any, Any], arguments: Mapping[str, Any]) -> None:
    """Raise UsageError, which names the first difference, unless the policy's spaces are the environment's.

    The observation must have the same shape, kind of number and, if both name them, elements, whose conventions do not
    contradict each other; the action also the same bounds, since the policy scales to them. A real robot takes no
    policy that leaves a convention open whose guess could move it wrongly.
    """
    description = _description(env, arguments)
    is_real = getattr(env.unwrapped, "is_real", False)
    sides = (
        ("observation", contract.observation_space, env.observation_space),
        ("action", contract.action_space, env.action_space),
    )
    for side, expected, actual in sides:
        theirs = _described(description.get(side), expected.size)
        difference = _difference(expected, actual, bounds=False)
        if not difference and len(theirs) == len(expected.elements):
            difference = _contradiction(expected.elements, theirs)
        if difference := difference or _difference(expected, actual, bounds=side == "action"):
            name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
            raise UsageError(f"policy {contract.name!r} does not fit {name}: the {side} {difference}")
        if is_real:
            check_complete(contract, side, expected.elements, theirs)


def check_complete(contract: Contract, side: str, ours: Sequence[Element], theirs: Sequence[Element]) -> None:
    """Raise UsageError if the policy leaves a convention open that a robot must know; `theirs` are the robot's."""
    what, option = missing(ours, theirs, is_action=side == "action")
    if what:
        say = f" or with --convention {option}=..." if option else ""
        raise UsageError(
            f"policy {contract.name!r} does not say of its {side} {what}: export it again, with --env and an "
            f"environment whose describe() says it{say}"
        )


def _difference(expected: SpaceSpec, actual: gym.Space[Any], *, bounds: bool) -> str | None:
    from gymnasium import spaces

    if isinstance(expected, DictSpec | TupleSpec):
        return _nested_difference(expected, actual, bounds=bounds)
    if isinstance(expected, MultiDiscreteSpec):
        if not isinstance(actual, spaces.MultiDiscrete):
            return f"is a {type(actual).__name__} there, the policy has MultiDiscrete({list(expected.nvec)})"
        if (actual.shape, tuple(actual.nvec.ravel().tolist())) != (expected.shape, expected.nvec):
            return f"has {actual.nvec.tolist()} choices there, the policy has {list(expected.nvec)}"
        return None
    if isinstance(expected, MultiBinarySpec):
        if not isinstance(actual, spaces.MultiBinary) or actual.shape != expected.shape:
            return f"is {actual} there, the policy has MultiBinary of shape {expected.shape}"
        return None
    if not isinstance(expected, BoxSpec):
        if not isinstance(actual, spaces.Discrete):
            return f"is a {type(actual).__name__} there, the policy has Discrete({expected.n})"
        if (int(actual.n), int(actual.start)) != (expected.n, expected.start):
            return (
                f"is {int(actual.n)} choices from {int(actual.start)} there, "
                f"the policy has {expected.n} from {expected.start}"
            )
        return None
    if not isinstance(actual, spaces.Box):
        return f"is a {type(actual).__name__} there, the policy has a Box of shape {expected.shape}"
    if actual.shape != expected.shape:
        return f"has shape {actual.shape} there, the policy has {expected.shape}"
    if np.dtype(actual.dtype).kind != np.dtype(expected.dtype).kind:  # float32 and float64 convert safely
        return f"has dtype {actual.dtype} there, the policy has {expected.dtype}"
    if not bounds:
        return None
    for word, ours, theirs in zip(("low", "high"), expected.bounds(), (actual.low, actual.high), strict=True):
        differs = ~np.isclose(ours, theirs.astype(np.float64), rtol=1e-6, atol=1e-9)
        if differs.any():
            first = tuple(int(i) for i in np.argwhere(differs)[0])
            index = int(np.ravel_multi_index(first, ours.shape)) if first else 0
            element = f" ({expected.elements[index].name})" if index < len(expected.elements) else ""
            return f"element {index}{element} has {word} {theirs[first]:g} there, the policy has {ours[first]:g}"
    return None


def _nested_difference(expected: DictSpec | TupleSpec, actual: gym.Space[Any], *, bounds: bool) -> str | None:
    from gymnasium import spaces

    kind = spaces.Dict if isinstance(expected, DictSpec) else spaces.Tuple
    if not isinstance(actual, kind):
        return f"is a {type(actual).__name__} there, the policy has a {kind.__name__}"
    ours: dict[Any, SpaceSpec] = (
        dict(expected.spaces) if isinstance(expected, DictSpec) else dict(enumerate(expected.spaces))
    )
    theirs: dict[Any, Any] = dict(actual.spaces) if isinstance(actual, spaces.Dict) else dict(enumerate(actual.spaces))
    if set(ours) != set(theirs):
        return f"has the parts {sorted(map(str, theirs))} there, the policy has {sorted(map(str, ours))}"
    for key, child in ours.items():
        if difference := _difference(child, theirs[key], bounds=bounds):
            return f"part {key} {difference}"
    return None


def _contradiction(ours: Sequence[Element], theirs: Sequence[Element]) -> str | None:
    found = contradiction(ours, theirs)
    return found and f"{found[0]} {found[2]} there, the policy has {found[1]}"


def _described(elements: Any, size: int) -> tuple[Element, ...]:
    """Return an environment's elements; none if it does not describe them."""
    try:
        described = parse_elements(elements or ())
    except ValueError as error:  # an unrelated method of that name
        logger.warning("the environment's describe() is not used: %s", error)
        return ()
    return described if len(described) == size else ()


def _description(env: gym.Env[Any, Any], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the environment class's description, if it has one: element names and the control rate."""
    describe = getattr(type(env.unwrapped), "describe", None)
    if describe is None:
        return {}
    try:
        description = describe(**arguments)
    except TypeError:  # an unrelated method of that name
        return {}
    return description if isinstance(description, Mapping) else {}
