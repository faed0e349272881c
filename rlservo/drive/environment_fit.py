"""Fit of a policy and an environment: spaces, bounds, elements' names and conventions, and the control rate."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rlservo.bundle.contract import Contract
from rlservo.bundle.conventions import contradiction, missing, parse_elements
from rlservo.bundle.spaces import (
    BoxSpec,
    DictSpec,
    Element,
    MultiBinarySpec,
    MultiDiscreteSpec,
    SpaceSpec,
    TupleSpec,
)
from rlservo.errors import UsageError

if TYPE_CHECKING:
    import gymnasium as gym

logger = logging.getLogger(__name__)


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
        difference = _difference(expected, actual, bounds=False) or _contradiction(expected, description.get(side))
        if difference := difference or _difference(expected, actual, bounds=side == "action"):
            name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
            raise UsageError(f"policy {contract.name!r} does not fit {name}: the {side} {difference}")
        if is_real:
            check_complete(contract, side, expected.elements, _described(description.get(side), expected.size))


def check_complete(contract: Contract, side: str, ours: Sequence[Element], theirs: Sequence[Element]) -> None:
    """Raise UsageError if the policy leaves a convention open that a robot must know; `theirs` are the robot's."""
    what, option = missing(ours, theirs, is_action=side == "action")
    if what:
        say = f" or with --convention {option}=..." if option else ""
        raise UsageError(
            f"policy {contract.name!r}: its {side} does not state {what}: export it again, with --env and an "
            f"environment whose describe() states it{say}"
        )


def _difference(expected: SpaceSpec, actual: gym.Space[Any], *, bounds: bool) -> str | None:
    from gymnasium import spaces

    if isinstance(expected, DictSpec | TupleSpec):
        return _nested_difference(expected, actual, bounds=bounds)
    if isinstance(expected, MultiDiscreteSpec):
        if not isinstance(actual, spaces.MultiDiscrete):
            return f"is a {type(actual).__name__} there, but the policy has MultiDiscrete({list(expected.nvec)})"
        if (actual.shape, tuple(actual.nvec.ravel().tolist())) != (expected.shape, expected.nvec):
            return f"has {actual.nvec.tolist()} choices there, but the policy has {list(expected.nvec)}"
        return None
    if isinstance(expected, MultiBinarySpec):
        if not isinstance(actual, spaces.MultiBinary) or actual.shape != expected.shape:
            return f"is {actual} there, but the policy has MultiBinary of shape {expected.shape}"
        return None
    if not isinstance(expected, BoxSpec):
        if not isinstance(actual, spaces.Discrete):
            return f"is a {type(actual).__name__} there, but the policy has Discrete({expected.n})"
        if (int(actual.n), int(actual.start)) != (expected.n, expected.start):
            return (
                f"is {int(actual.n)} choices from {int(actual.start)} there, "
                f"the policy has {expected.n} from {expected.start}"
            )
        return None
    if not isinstance(actual, spaces.Box):
        return f"is a {type(actual).__name__} there, but the policy has a Box of shape {expected.shape}"
    if actual.shape != expected.shape:
        return f"has shape {actual.shape} there, but the policy has {expected.shape}"
    if np.dtype(actual.dtype).kind != np.dtype(expected.dtype).kind:  # float32 and float64 convert safely
        return f"has dtype {actual.dtype} there, but the policy has {expected.dtype}"
    if not bounds:
        return None
    for word, ours, theirs in zip(("low", "high"), expected.bounds(), (actual.low, actual.high), strict=True):
        differs = ~np.isclose(ours, theirs.astype(np.float64), rtol=1e-6, atol=1e-9)
        if differs.any():
            first = tuple(int(i) for i in np.argwhere(differs)[0])
            index = int(np.ravel_multi_index(first, ours.shape)) if first else 0
            element = f" ({expected.elements[index].name})" if index < len(expected.elements) else ""
            return f"element {index}{element} has {word} {theirs[first]:g} there, but the policy has {ours[first]:g}"
    return None


def _nested_difference(expected: DictSpec | TupleSpec, actual: gym.Space[Any], *, bounds: bool) -> str | None:
    from gymnasium import spaces

    kind = spaces.Dict if isinstance(expected, DictSpec) else spaces.Tuple
    if not isinstance(actual, kind):
        return f"is a {type(actual).__name__} there, but the policy has a {kind.__name__}"
    ours = _parts(expected.spaces)
    theirs: dict[Any, Any] = dict(actual.spaces) if isinstance(actual, spaces.Dict) else dict(enumerate(actual.spaces))
    if set(ours) != set(theirs):
        return f"has the parts {sorted(map(str, theirs))} there, but the policy has {sorted(map(str, ours))}"
    for key, child in ours.items():
        if difference := _difference(child, theirs[key], bounds=bounds):
            return f"part {key} {difference}"
    return None


def _contradiction(expected: SpaceSpec, described: Any) -> str | None:
    """Return what an environment's description, which has the form of its space, says otherwise than the policy."""
    if isinstance(expected, DictSpec | TupleSpec):
        theirs = _parts(described) if isinstance(described, Mapping | Sequence) else {}
        found_in = ((key, _contradiction(child, theirs.get(key))) for key, child in _parts(expected.spaces).items())
        return next((f"part {key} {difference}" for key, difference in found_in if difference), None)
    elements = _described(described, expected.size)
    found = contradiction(expected.elements, elements) if len(elements) == len(expected.elements) else None
    return found and f"{found[0]} {found[2]} there, but the policy has {found[1]}"


def _parts(nested: Mapping[Any, Any] | Sequence[Any]) -> Mapping[Any, Any]:
    return nested if isinstance(nested, Mapping) else dict(enumerate(nested))


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
