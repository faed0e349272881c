"""Action terms of an Isaac Lab or mjlab environment, from the `params/env.yaml` beside a policy.

Scale, offset, clip and control rate are in there, and joint names or patterns. An action's elements are in the robot's
own order of joints, which env.yaml does not have: Isaac Lab writes it into io_descriptors/IO_descriptors.yaml, or the
user gives it. The rules are those of Isaac Lab's JointAction and its resolve_matching_names (isaaclab 2.3, 3.0).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rlservo.bundle.spaces import Element, Quantity
from rlservo.errors import CheckpointError, UsageError, first_line
from rlservo.export.recipe.recipe import Affine

DESCRIPTORS = Path("io_descriptors/IO_descriptors.yaml")
"""Isaac Lab's description of an environment, in a run that was trained with `--export_io_descriptors`."""
# An action term's class: the unit of its command, the key of its default offset, and what it commands.
KINDS: dict[str, tuple[str, str, Quantity]] = {
    "JointPositionAction": ("rad", "joint_pos", "joint position"),
    "RelativeJointPositionAction": ("rad", "", "relative joint position"),
    "JointVelocityAction": ("rad/s", "joint_vel", "joint velocity"),
    "JointEffortAction": ("N*m", "", "joint effort"),
}
LARGEST = float(np.finfo(np.float32).max)
LIBRARIES = re.compile(r"(isaaclab(_\w+)?\.envs|omni\.isaac\.(lab|orbit)\.envs|mjlab\.envs)\.")
_PLAIN = re.compile(r"[\w/ -]+")
"""A name that no pattern matches but itself."""


class _PlainLoader(yaml.SafeLoader):
    """Reads Python's tuples as lists and its other objects as None; runs no code."""


def _plain(loader: yaml.SafeLoader, suffix: str, node: yaml.Node) -> Any:
    if suffix == "tuple" and isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if suffix.startswith("name:"):  # functions and classes, by their path
        return suffix.removeprefix("name:")
    if suffix == "object/apply:builtins.slice" and isinstance(node, yaml.SequenceNode):
        ends = loader.construct_sequence(node)
        return slice(*ends) if len(ends) == 3 and all(end is None or isinstance(end, int) for end in ends) else ends
    return None


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def read_yaml(file: Path) -> dict[str, Any]:
    """Return the mapping in `file`. Raises CheckpointError if it is not one."""
    try:
        read = yaml.load(file.read_text(encoding="utf-8"), _PlainLoader)
    except (OSError, ValueError, TypeError, RecursionError, yaml.YAMLError) as error:  # ValueError: a date of month 13
        raise CheckpointError(f"{file} cannot be read: {first_line(error)}") from error
    if not isinstance(read, dict):
        raise CheckpointError(f"{file} holds a {type(read).__name__}: expected a mapping")
    return read


def section(settings: Mapping[str, Any], name: str, file: Path) -> Mapping[str, Any]:
    """Return the mapping `name` of a file's settings, {} if it is absent.

    Raises CheckpointError if it is of another type.
    """
    found = settings.get(name)
    if found is None:
        return {}
    if not isinstance(found, Mapping):
        raise CheckpointError(f"{file}: '{name}' is a {type(found).__name__}: expected a mapping")
    return found


@dataclass(frozen=True)
class ActionTerms:
    """The environment's processing of a policy's action."""

    affine: Affine | None = None
    bounds: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    """The clip of the processed action, (low, high), infinite where there is none; None if no term clips."""
    elements: tuple[Element, ...] = ()
    control_rate_hz: float | None = None
    notes: tuple[str, ...] = ()
    """Warnings: what is not in the export."""
    processed: bool = False
    """Whether scale, offset and clip of the terms are in it."""


@dataclass(frozen=True)
class _Term:
    joints: list[str]
    unit: str
    quantity: Quantity
    scale: list[float]
    offset: list[float]
    clip: list[tuple[float, float]] | None


def action_terms(file: Path, size: int, limit: float | None, joint_order: Sequence[str] = ()) -> ActionTerms:
    """Return what env.yaml's terms do to the `size` elements of an action that is clipped to ±`limit` before.

    If a term is of another kind, or the file does not exist, the policy's own numbers stay as they are. Raises
    CheckpointError if a term's joints, or a number of theirs, cannot be known.
    """
    raw = None if limit is None else Affine(np.ones(size, np.float32), np.zeros(size, np.float32), limit)
    own = tuple(Element(name=f"action_{index}", quantity="raw") for index in range(size))
    if not file.is_file():
        note = "no params/env.yaml: the export gives the policy's own numbers, unscaled"
        return ActionTerms(raw, elements=own, notes=(note,))
    env = read_yaml(file)
    rate = _rate(env)
    settings = {name: term for name, term in section(env, "actions", file).items() if term is not None}
    if not settings:
        note = "env.yaml has no actions: the export gives the policy's own numbers"
        return ActionTerms(raw, elements=own, control_rate_hz=rate, notes=(note,))
    for name, term in settings.items():
        if (kind := _kind(term)) not in KINDS:
            note = (
                f"action term '{name}' is a {kind or 'term without a class'}, which is more than a scale and an "
                "offset: they are NOT in the export, which gives the policy's own numbers"
            )
            return ActionTerms(raw, elements=own, control_rate_hz=rate, notes=(note,))
    terms: dict[str, _Term] = {}
    for name, term in settings.items():
        try:
            terms[name] = _term(env, term, robot_joints(file, env, asset_of(term), joint_order))
        except (ValueError, OverflowError, re.error) as error:
            raise CheckpointError(f"{file}: action term '{name}' {error}") from error
    elements = tuple(
        Element(name=joint, unit=term.unit, quantity=term.quantity, joint=joint, scale=1.0, offset=0.0)
        for term in terms.values()
        for joint in term.joints
    )
    if len(elements) != size:
        raise CheckpointError(
            f"env.yaml's action terms ({', '.join(terms)}) have {len(elements)} elements, the policy's action "
            f"has {size}: they do not belong together"
        )
    _compare(file, settings, terms, rate)
    scale = np.array([number for term in terms.values() for number in term.scale], np.float32)
    offset = np.array([number for term in terms.values() for number in term.offset], np.float32)
    return ActionTerms(Affine(scale, offset, limit), _bounds(terms), elements, rate, processed=True)


def _bounds(terms: Mapping[str, _Term]) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    if all(term.clip is None for term in terms.values()):
        return None
    sides = [side for term in terms.values() for side in term.clip or [(-np.inf, np.inf)] * len(term.joints)]
    low, high = np.array(sides, np.float32).T
    return low.copy(), high.copy()


def _kind(term: Any) -> str:
    return class_name(str(term.get("class_type") or "") if isinstance(term, Mapping) else "")


def class_name(path: str) -> str:
    """Return a class's name, with its module if it is not the library's own; '' if there is none."""
    return re.split(r"[.:]", path)[-1] if LIBRARIES.match(path) else path


def clip_actions(agent_file: Path, agent: Mapping[str, Any]) -> float | None:
    """Return to what the training's wrapper for rsl_rl clips actions, before their terms scale them."""
    limit = agent.get("clip_actions")
    if limit is None:
        return None
    if not isinstance(limit, int | float) or not 0 <= limit < np.inf:
        raise CheckpointError(f"{agent_file}: clip_actions is {limit!r}: expected null, or a finite number")
    return float(limit)


def asset_of(term: Mapping[str, Any]) -> str:
    """Return the name of the robot that an action term moves."""
    return str(term.get("asset_name") or term.get("entity_name") or "robot")


def robot_joints(file: Path, env: Mapping[str, Any], asset: str, joint_order: Sequence[str]) -> Sequence[str] | None:
    """Return a robot's joints in its own order, or None if neither a file nor the user has it.

    `joint_order` is that of the one robot that the action moves, of `robot` if it moves several.
    """
    if len(set(joint_order)) != len(joint_order):
        raise UsageError(f"the joint order names a joint twice: {', '.join(joint_order)}")
    moved = {asset_of(term) for term in section(env, "actions", file).values() if isinstance(term, Mapping)}
    if asset != (next(iter(moved)) if len(moved) == 1 else "robot"):
        joint_order = ()
    described = file.parent.parent / DESCRIPTORS
    if not described.is_file():
        return joint_order or None
    robot = section(section(read_yaml(described), "articulations", described), asset, described)
    joints = robot.get("joint_names")
    if not isinstance(joints, list) or not joints or not all(isinstance(joint, str) for joint in joints):
        return joint_order or None
    if joint_order and [joint for joint in joints if joint in joint_order] != list(joint_order):
        raise CheckpointError(
            f"the joint order that was given ({', '.join(joint_order)}) is not that of {described} "
            f"({', '.join(joints)}): leave it out, or give that of this run"
        )
    return joints


def _term(env: Mapping[str, Any], term: Mapping[str, Any], robot: Sequence[str] | None) -> _Term:
    """Return one term's joints and numbers. Raises ValueError with a reason."""
    unit, default, quantity = KINDS[_kind(term)]
    joints = _joints(term, robot)
    scale = _numbers(term.get("scale", 1.0), joints, 1.0, "scale")
    offset = _numbers(term.get("offset", 0.0), joints, 0.0, "offset")
    if default and term.get("use_default_offset"):
        offset = default_offset(env, term, default, joints)
    if term.get("use_zero_offset"):  # of relative positions
        offset = [0.0] * len(joints)
    return _Term(joints, unit, quantity, scale, offset, _clip(term.get("clip"), joints))


def _joints(term: Mapping[str, Any], robot: Sequence[str] | None) -> list[str]:
    """Return the joints that a term moves, in the action's order."""
    given = term.get("joint_names") or term.get("actuator_names")
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"names no joints: expected a list of names or patterns, got {given!r}")
    keeps, shown = term.get("preserve_order") is True, ", ".join(names)
    # Releases of mjlab differ in whether they heed preserve_order.
    heeds = keeps and not _is_mjlab(term)
    if robot is None:
        if all(_PLAIN.fullmatch(name) for name in names) and (heeds or len(names) == 1):
            return list(match(names, names, "joint_names"))
        raise ValueError(
            f"acts on the joints {shown} in the robot's own order, which no file of the run has: give --joint-order "
            "with the robot's joint names (env.scene['robot'].joint_names of the training), or train with "
            "--export_io_descriptors"
        )
    matched = match(names, robot, "joint_names")
    natural = list(matched)
    listed = sorted(natural, key=lambda joint: matched[joint])  # stable: the robot's order within a pattern
    if keeps and not heeds and listed != natural:
        raise ValueError(
            f"has preserve_order, which some releases of mjlab ignore, and lists {shown} in an order other than the "
            f"robot's ({', '.join(natural)}): delete params/env.yaml to export the policy's own numbers"
        )
    return listed if heeds else natural


def match(patterns: Sequence[str], joints: Sequence[str], what: str, *, partly: bool = False) -> dict[str, int]:
    """Return the number of the pattern that each matched joint matches, in the order of `joints`.

    Raises ValueError if a joint matches two patterns, or (unless `partly`) a pattern matches no joint.
    """
    found: dict[str, int] = {}
    for joint in joints:
        numbers = [number for number, pattern in enumerate(patterns) if re.fullmatch(pattern, joint)]
        if len(numbers) > 1:
            raise ValueError(
                f"has two entries of {what} for the joint '{joint}': {', '.join(patterns[n] for n in numbers)}"
            )
        if numbers:
            found[joint] = numbers[0]
    for number, pattern in enumerate(patterns):
        if not partly and number not in found.values():
            raise ValueError(f"has an entry of {what}, '{pattern}', that matches none of {', '.join(joints)}")
    return found


def selected(joints: Sequence[str], ids: Any) -> list[str]:
    """Return the joints that `joint_ids` choose: a slice, numbers, or None for all. Raises ValueError."""
    if ids is None or isinstance(ids, slice):
        return list(joints[slice(None) if ids is None else ids])
    numbers = [ids] if isinstance(ids, int) else ids
    if not isinstance(numbers, list) or not all(isinstance(n, int) and 0 <= n < len(joints) for n in numbers):
        raise ValueError(f"has the joint_ids {ids!r}: expected numbers of {len(joints)} joints")
    return [joints[number] for number in numbers]


def default_offset(env: Mapping[str, Any], term: Mapping[str, Any], key: str, joints: Sequence[str]) -> list[float]:
    """Return the default `key` of a term's robot. Raises ValueError if env.yaml does not have it."""
    asset = asset_of(term)
    state = below(below(env.get("scene"), asset) or below(below(env.get("scene"), "entities"), asset), "init_state")
    values = below(state, key)
    if not isinstance(values, Mapping):
        raise ValueError(f"starts from the default {key} of '{asset}', which env.yaml does not have")
    if not _is_mjlab(term):
        return _numbers(values, joints, 0.0, f"default {key}", partly=True)
    first = {joint: next((p for p in values if re.match(str(p), joint)), None) for joint in joints}
    return [0.0 if p is None else _number(values[p], f"default {key}", joint) for joint, p in first.items()]


def below(settings: Any, key: str) -> Any:
    """Return an entry of a mapping; None if there is none."""
    return settings.get(key) if isinstance(settings, Mapping) else None


def _is_mjlab(term: Mapping[str, Any]) -> bool:
    return str(term.get("class_type")).startswith("mjlab")


def _numbers(given: Any, joints: Sequence[str], missing: float, what: str, *, partly: bool = False) -> list[float]:
    """Return one number per joint, given one for all, or a mapping from patterns of names."""
    if not isinstance(given, Mapping):
        return [_number(given, what, joint) for joint in joints]
    found = match([str(pattern) for pattern in given], joints, what, partly=partly)
    values = list(given.values())
    return [_number(values[found[joint]], what, joint) if joint in found else missing for joint in joints]


def _number(given: Any, what: str, joint: str) -> float:
    if not isinstance(given, int | float):
        raise ValueError(f"has a {what} of {given!r} for the joint '{joint}': expected a number")
    if not abs(given) <= LARGEST:
        raise ValueError(f"has a {what} of {given} for the joint '{joint}': expected a finite number")
    return float(given)


def _clip(given: Any, joints: Sequence[str]) -> list[tuple[float, float]] | None:
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise ValueError(f"has a clip of {given!r}: expected a mapping from joints to [low, high]")
    found = match([str(pattern) for pattern in given], joints, "clip")
    values = list(given.values())
    sides: list[tuple[float, float]] = []
    for joint in joints:
        side = values[found[joint]] if joint in found else [-np.inf, np.inf]
        if not (isinstance(side, list) and len(side) == 2 and all(isinstance(end, int | float) for end in side)):
            raise ValueError(f"has a clip of {side!r} for the joint '{joint}': expected [low, high]")
        low, high = (float(end) if abs(end) <= LARGEST else end * np.inf for end in side)
        if not (low <= high and low < np.inf and high > -np.inf):
            raise ValueError(f"has a clip of {side} for the joint '{joint}': expected a low end below a high one")
        sides.append((low, high))
    return sides


def _compare(file: Path, settings: Mapping[str, Any], terms: Mapping[str, _Term], rate: float | None) -> None:
    """Raise CheckpointError where Isaac Lab's own description of the run has other joints, numbers or commands."""
    described = file.parent.parent / DESCRIPTORS
    given = read_yaml(described) if described.is_file() else {}
    step = below(given.get("scene"), "dt")
    if rate is not None and isinstance(step, int | float) and not np.isclose(step * rate, 1.0, rtol=1e-4):
        raise CheckpointError(f"{file} has a control rate of {rate:g} Hz, but {described} steps of {step} s: they are "
                              "not from the same run")  # fmt: skip
    actions = given.get("actions")
    if not isinstance(actions, list) or len(actions) != len(terms):
        return  # terms may be left out of it
    for (name, term), action in zip(terms.items(), actions, strict=True):
        if not isinstance(action, Mapping):
            continue
        path = str(action.get("full_path") or "")
        kinds = (_kind(settings[name]), class_name(path) if LIBRARIES.match(path) else "")
        pairs: list[tuple[str, Any, Any]] = [
            ("joint_names", term.joints, action.get("joint_names")),
            ("scale", term.scale, action.get("scale")),
            ("offset", term.offset, action.get("offset")),
            ("clip", _ends(term.clip), _ends(action["clip"]) if "clip" in action else None),
            ("class", [kinds[0]], [kinds[1]] if kinds[1] else None),
        ]
        for what, ours, theirs in pairs:
            if isinstance(theirs, int | float):
                theirs = [theirs] * len(ours)
            if isinstance(theirs, list) and not _alike(ours, theirs):
                raise CheckpointError(
                    f"action term '{name}' has the {what} {ours} in {file}, but {theirs} in {described}: they are not "
                    "from the same run"
                )


def _ends(clip: Any) -> list[Any]:
    """Return a clip's ends one after the other, those that clip nothing left out."""
    ends = [end for side in clip or () for end in (side if isinstance(side, list | tuple) else [side])]
    return [end for end in ends if isinstance(end, int | float) and abs(end) <= LARGEST]


def _alike(ours: list[Any], theirs: list[Any]) -> bool:
    if len(ours) != len(theirs) or not all(isinstance(one, int | float) for one in [*ours, *theirs]):
        return ours == theirs
    return bool(np.allclose(ours, theirs, rtol=1e-5, atol=1e-6))


def _rate(env: Mapping[str, Any]) -> float | None:
    simulation = env.get("sim")
    step: Any = below(simulation, "dt") or below(below(simulation, "mujoco"), "timestep")
    decimation: Any = env.get("decimation")
    try:
        rate = 1.0 / (float(step) * int(decimation))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None
