"""Environment of a rollout, and the check that the policy fits it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.environment_id import importing_id
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import install, needs_extra
from rlservo.export.contract.spaces import BoxSpec, DictSpec, MultiBinarySpec, MultiDiscreteSpec, SpaceSpec, TupleSpec
from rlservo.serve_app.rollout.disturbance import parse_disturbance

if TYPE_CHECKING:
    import gymnasium as gym

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
        hint = install("sim") if env_id.startswith("rlservo/") else "install what it needs"
        raise UsageError(f"environment {env_id!r} cannot be made: {error}: {hint}") from error
    except Exception as error:  # a constructor is third-party code
        raise UsageError(f"environment {env_id!r} cannot be made with {arguments}: {error}") from error


def check_proven(contract: Contract, env: gym.Env[Any, Any]) -> None:
    """Raise UsageError if the robot is real and no evaluation under latency shows that the policy succeeds."""
    if not getattr(env.unwrapped, "is_real", False):
        return
    found = [one for one in contract.evaluations if _action_latency(one.disturbance)]
    bounds = [one.success_interval[0] for one in found if one.success_interval is not None]
    if max(bounds, default=0.0) >= PROVEN_SUCCESS:
        return
    why = "was never evaluated under latency"
    if found:
        rows = ", ".join(
            f"{one.disturbance}: {one.success_rate_bundle or 0.0:.0%} of {one.episodes} episodes" for one in found
        )
        why = f"succeeded too rarely, or in too few episodes, under latency ({rows})"
    raise UsageError(
        f"policy '{contract.name}' version {contract.version} {why}: a real robot needs one whose 95% interval of "
        f"success begins at {PROVEN_SUCCESS:.0%} or above. Measure the robot with `rlservo robot-latency`, evaluate "
        "with the `rlservo verify --disturb ... --write` that it prints, or pass --unproven"
    )


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

    The observation must have the same shape, kind of number and, if both name them, elements; the action also the same
    bounds, since the policy scales to them.
    """
    description = _description(env, arguments)
    sides = (
        ("observation", contract.observation_space, env.observation_space),
        ("action", contract.action_space, env.action_space),
    )
    for side, expected, actual in sides:
        difference = _difference(expected, actual, bounds=side == "action")
        difference = difference or _name_difference(expected, description.get(side))
        if difference:
            name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
            raise UsageError(f"policy {contract.name!r} does not fit {name}: the {side} {difference}")


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


def _name_difference(expected: SpaceSpec, elements: Any) -> str | None:
    if not isinstance(elements, list | tuple) or len(elements) != len(expected.elements):
        return None
    for index, (ours, theirs) in enumerate(zip(expected.elements, elements, strict=True)):
        if ours.name != theirs["name"]:
            return f"element {index} is {theirs['name']!r} there, the policy has {ours.name!r}"
    return None


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
