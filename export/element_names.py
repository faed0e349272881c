"""Names and units of observation and action elements, read from the environment's class.

An environment names them by a classmethod `describe(**env_config)` that returns
`{"observation": [{"name", "unit"}, ...], "action": [...], "control_rate_hz": 10.0}`. Names help people and change
nothing about the policy, so whatever is missing or wrong here is a notice and not an error.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
from gymnasium.spaces import Box
from pydantic import ValidationError

from rlservo.export.contract.environment_id import importing_id
from rlservo.export.contract.errors import first_line
from rlservo.export.contract.spaces import Element
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.sources.restored_policy import ElementNames


def read_elements(
    env_id: str | None, env_config: Mapping[str, Any], recipe: Recipe, notify: Callable[[str], None]
) -> ElementNames:
    """Return the element names of the environment's class."""
    if env_id is None:
        return ElementNames()
    try:
        describe = getattr(_env_class(env_id), "describe", None)
        if describe is None:
            return ElementNames()
        description = describe(**env_config)
        observation = _elements(description.get("observation", ()))
        action = _elements(description.get("action", ()))
        rate = _rate(description.get("control_rate_hz"))
    except (Exception, SystemExit) as error:  # importing and describing run the user's own code
        notify(
            f"the elements stay unnamed, which changes nothing else: environment {env_id} cannot name them "
            f"({first_line(error)})"
        )
        return ElementNames()
    spaces = {"observation": recipe.observation_space, "action": recipe.action_space}
    wanted = {which: math.prod(space.shape) if isinstance(space, Box) else 0 for which, space in spaces.items()}
    named = {"observation": observation, "action": action}
    for which, elements in named.items():
        if elements and len(elements) != wanted[which]:
            notify(
                f"environment {env_id} names {len(elements)} {which} elements, the policy has {wanted[which]}: "
                "they stay unnamed"
            )
            named[which] = ()
    return ElementNames(named["observation"], named["action"], rate)


def _env_class(env_id: str) -> Any:
    """Return the class of a Gymnasium id, with or without its module, or of a `module:Class` path."""
    module, _, name = importing_id(env_id).rpartition(":")
    if module:
        importlib.import_module(module)
    entry_point = gymnasium.spec(name).entry_point if name in gymnasium.registry or not module else env_id
    return pkgutil.resolve_name(entry_point) if isinstance(entry_point, str) else entry_point


def _elements(described: Any) -> tuple[Element, ...]:
    try:
        return tuple(Element(name=one["name"], unit=one.get("unit", "")) for one in described)
    except (ValidationError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected a list of {{'name', 'unit'}}, got {described!r:.80}") from error


def _rate(described: Any) -> float | None:
    if described is None:
        return None
    rate = float(described)
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"control_rate_hz must be a positive number, got {described!r}")
    return rate
