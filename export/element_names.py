"""Names, units and conventions of observation and action elements, read from the environment's class.

An environment names them by a classmethod `describe(**env_config)` that returns
`{"observation": [{"name", "unit", ...}, ...], "action": [...], "control_rate_hz": 10.0}`; the contract's `Element` has
the fields. A list has the form of its space: a dict of lists for a Dict, a list of lists for a Tuple. They change
nothing about the policy, so whatever is missing or wrong here is a notice and not an error, and only that part stays
unnamed.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
from gymnasium.spaces import Box, Dict, Tuple

from rlservo.bundle.conventions import IN_A_FRAME, contradiction, parse_elements
from rlservo.bundle.environment_id import importing_id
from rlservo.bundle.spaces import Element
from rlservo.errors import UsageError, first_line
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.sources.restored_policy import ElementNames, Elements

COMMANDS = {
    "absolute": "joint position", "relative": "relative joint position", "velocity": "joint velocity",
    "effort": "joint effort",
}  # fmt: skip
"""Values of `--convention action=`, as the contract's quantities."""
ORDERS = ("wxyz", "xyzw")


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
        description = {**describe(**env_config)}
    except (Exception, SystemExit) as error:  # importing and describing run the user's own code
        notify(
            f"the elements stay unnamed, which changes nothing else: environment {env_id} cannot name them "
            f"({first_line(error)})"
        )
        return ElementNames()
    found: dict[str, Any] = {}
    parts: dict[str, Callable[[Any], Any]] = {
        "observation": lambda given: _elements(recipe.observation_space, given, "obs"),
        "action": lambda given: _elements(recipe.action_space, given, "action"),
        "control_rate_hz": _rate,
    }
    for part, read in parts.items():
        if description.get(part) is not None:
            try:
                found[part] = read(description[part])
            except (ValueError, TypeError) as error:
                notify(f"environment {env_id} does not describe its {part}, which changes nothing else: {error}")
    return ElementNames(**found)


def _env_class(env_id: str) -> Any:
    """Return the class of a Gymnasium id, with or without its module, or of a `module:Class` path."""
    module, _, name = importing_id(env_id).rpartition(":")
    if module:
        importlib.import_module(module)
    entry_point = gymnasium.spec(name).entry_point if name in gymnasium.registry or not module else env_id
    return pkgutil.resolve_name(entry_point) if isinstance(entry_point, str) else entry_point


def _elements(space: Any, described: Any, name: str) -> Elements:
    """Return the elements of a space, by tensor name if it is nested. Raises ValueError for a wrong leaf."""
    if not isinstance(space, Dict | Tuple):
        return _leaf(space, described, name)
    children: dict[Any, Any] = dict(space.spaces.items() if isinstance(space, Dict) else enumerate(space.spaces))
    given: Mapping[Any, Any] = described if isinstance(described, Mapping) else dict(enumerate(described))
    found: dict[str, tuple[Element, ...]] = {}
    for key, child in children.items():
        if key in given:
            inside, path = _elements(child, given[key], f"{name}.{key}"), f"{name}.{key}"
            found |= inside if isinstance(inside, Mapping) else {path: inside}
    if strange := [key for key in given if key not in children]:
        raise ValueError(f"'{name}' has no part {strange[0]!r}")
    return found


def _leaf(space: Any, described: Any, name: str) -> tuple[Element, ...]:
    elements: list[Element] = []
    for number, one in enumerate(described):
        if not isinstance(one, Mapping):
            raise ValueError(f"element {number} of '{name}' is {one!r:.80}: expected {{'name': ..., 'unit': ...}}")
        try:
            elements += parse_elements([one])
        except ValueError as error:
            raise ValueError(f"element {number} of '{name}': {error}") from None
    size = math.prod(space.shape)
    if elements and len(elements) != size:
        raise ValueError(f"it names {len(elements)} elements of '{name}', which has {size}")
    return tuple(elements)


def _rate(described: Any) -> float:
    rate = float(described)
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"control_rate_hz must be a positive number, got {described!r}")
    return rate


def described_by(
    env_id: str, env_config: Mapping[str, Any], known: ElementNames | None, recipe: Recipe
) -> ElementNames:
    """Return the elements as an environment that the user named describes them, with what the checkpoint says.

    Raises UsageError if it does not describe them, or contradicts the checkpoint.
    """
    problems: list[str] = []
    try:
        _env_class(env_id)
    except (Exception, SystemExit) as error:  # importing runs the user's own code
        hint = ": give its folder with --app-dir" if isinstance(error, ModuleNotFoundError) else ""
        raise UsageError(f"--env {env_id} cannot be found: {first_line(error)}{hint}") from error
    described = read_elements(env_id, env_config, recipe, problems.append)
    if problems or not (described.observation or described.action):
        raise UsageError(f"--env {env_id}: {problems[0] if problems else 'it has no describe() that names elements'}")
    if known is None:
        return described
    sides: list[Elements] = []
    for side, ours, theirs in (
        ("observation", known.observation, described.observation),
        ("action", known.action, described.action),
    ):
        if not (ours and theirs) or isinstance(ours, Mapping) or isinstance(theirs, Mapping):
            sides.append(ours or theirs)
            continue
        named = [other.model_copy(update={"name": mine.name}) for mine, other in zip(ours, theirs, strict=True)]
        if found := contradiction(ours, named):
            raise UsageError(f"--env {env_id}: the {side} {found[0]} {found[2]} there, the checkpoint has {found[1]}")
        sides.append(tuple(_filled(mine, other) for mine, other in zip(ours, theirs, strict=True)))
    return ElementNames(sides[0], sides[1], known.control_rate_hz or described.control_rate_hz)


def with_conventions(elements: ElementNames, given: Mapping[str, str], recipe: Recipe) -> ElementNames:
    """Return the elements with the conventions that the user gives where a source leaves them open.

    Raises UsageError for an unknown one, one that contradicts the source, or one that no element needs.
    """
    observation, action = elements.observation, elements.action
    for name, value in given.items():
        if name == "quaternion" and value in ORDERS:
            observation = _each(observation, partial(_ordered, order=value), name)
        elif name == "frame" and value:
            observation = _each(observation, partial(_in_frame, frame=value), name)
        elif name == "action" and value in COMMANDS:
            if not action and isinstance(recipe.action_space, Box):
                action = tuple(Element(name=f"action_{index}") for index in range(math.prod(recipe.action_space.shape)))
            action = _each(action, partial(_commanding, command=COMMANDS[value]), name)
        else:
            raise UsageError(
                f"--convention {name}={value}: expected quaternion={' or '.join(ORDERS)}, frame=NAME, or "
                f"action={', '.join(COMMANDS)}"
            )
    return ElementNames(observation, action, elements.control_rate_hz)


def with_rate(elements: ElementNames, given: float | None) -> ElementNames:
    """Return the elements with the control rate that the user gives. Raises UsageError if the source has another."""
    known = elements.control_rate_hz
    if given is not None and known is not None and not math.isclose(given, known, rel_tol=1e-3):
        raise UsageError(f"--control-rate {given:g}: the source has a control rate of {known:g} Hz")
    return elements if given is None or known is not None else replace(elements, control_rate_hz=given)


def open_conventions(elements: ElementNames) -> str:
    """Return what the elements leave open that a real robot asks for, with the options that say it; '' for nothing."""
    observed = _flat(elements.observation)
    turns = [element.name for element in observed if element.quantity == "quaternion" and not element.axis]
    framed = [element.name for element in observed if element.quantity in IN_A_FRAME and not element.frame]
    raw = [element.name for element in _flat(elements.action) if element.quantity == "raw"]
    asked = [
        f"{what} of {names[0]}{' ...' if len(names) > 1 else ''} (--convention {option})"
        for what, names, option in (
            ("the order of the quaternion", turns, "quaternion=wxyz or xyzw"),
            ("the frame", framed, "frame=NAME"),
            ("the command", raw, "action=absolute, relative, velocity or effort"),
        )
        if names
    ]
    return f"no file says {', nor '.join(asked)}: a real robot accepts no policy that leaves this open" if asked else ""


def _flat(elements: Elements) -> list[Element]:
    leaves = elements.values() if isinstance(elements, Mapping) else (elements,)
    return [element for leaf in leaves for element in leaf]


def _each(elements: Elements, change: Callable[[tuple[Element, ...]], tuple[Element, ...]], name: str) -> Elements:
    """Return the elements of all leaves, changed. Raises UsageError if nothing does."""
    if isinstance(elements, Mapping):
        changed: Elements = {leaf: change(inside) for leaf, inside in elements.items()}
    else:
        changed = change(elements)
    if changed == elements:
        raise UsageError(
            f"--convention {name}: no element needs it: their quantities are unknown, or the source states it"
        )
    return changed


def _ordered(elements: tuple[Element, ...], order: str) -> tuple[Element, ...]:
    places = [index for index, element in enumerate(elements) if element.quantity == "quaternion"]
    changed = list(elements)
    for number, index in enumerate(places):
        axis = order[number % 4]
        if changed[index].axis not in ("", axis):
            raise UsageError(
                f"--convention quaternion={order}: element {index} ({changed[index].name}) is the part "
                f"{changed[index].axis} according to its source, not {axis}"
            )
        changed[index] = changed[index].model_copy(update={"axis": axis})
    return tuple(changed)


def _in_frame(elements: tuple[Element, ...], frame: str) -> tuple[Element, ...]:
    return tuple(
        element.model_copy(update={"frame": frame}) if element.quantity in IN_A_FRAME and not element.frame else element
        for element in elements
    )


def _commanding(elements: tuple[Element, ...], command: str) -> tuple[Element, ...]:
    for element in elements:
        if element.quantity not in (None, "raw", command):
            raise UsageError(
                f"--convention action: {element.name} is a {element.quantity} according to its source, not a {command}"
            )
    return tuple(element.model_copy(update={"quantity": command}) for element in elements)


def _filled(mine: Element, other: Element) -> Element:
    """Return an element under the other's name, with what the other knows of it besides."""
    known = {field: value for field, value in mine.model_dump(exclude={"name"}).items() if value != ""}
    return other if mine.quantity == "raw" else other.model_copy(update=known)
