"""Action terms of an Isaac Lab or mjlab environment, from the `params/env.yaml` beside a policy.

Scale, offset, joint names and control rate are in there; which joints a pattern matches is only in the robot's file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlservo.export.contract.errors import CheckpointError, first_line
from rlservo.export.contract.spaces import Element
from rlservo.export.recipe.recipe import Affine

# The end of an action term's class name: the unit of its command, and the key of its default offset.
KINDS = {
    "JointPositionAction": ("rad", "joint_pos"),
    "JointVelocityAction": ("rad/s", "joint_vel"),
    "JointEffortAction": ("N*m", ""),
}


class _PlainLoader(yaml.SafeLoader):
    """Reads Python's tuples as lists and its other objects as None; runs no code."""


def _plain(loader: yaml.SafeLoader, suffix: str, node: yaml.Node) -> Any:
    if suffix == "tuple" and isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if suffix.startswith("name:"):  # functions and classes, by their path
        return suffix.removeprefix("name:")
    return None


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def read_yaml(file: Path) -> dict[str, Any]:
    """Return the mapping in `file`. Raises CheckpointError if it is not one."""
    try:
        read = yaml.load(file.read_text(encoding="utf-8"), _PlainLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise CheckpointError(f"{file} cannot be read: {first_line(error)}") from error
    if not isinstance(read, dict):
        raise CheckpointError(f"{file} holds a {type(read).__name__}: expected a mapping")
    return read


@dataclass(frozen=True)
class ActionTerms:
    """The environment's processing of a policy's action."""

    affine: Affine | None = None
    elements: tuple[Element, ...] = ()
    control_rate_hz: float | None = None
    notes: tuple[str, ...] = ()
    """Warnings: parts that could not be determined, and are therefore not in the export."""


def action_terms(env: Mapping[str, Any], size: int, limit: float | None) -> ActionTerms:
    """Return scale, offset and names of the `size` elements of an action that is clipped to ±`limit` before.

    If a term is of another kind, or its default offset is unknown, the policy's own numbers stay as they are.
    """
    rate = _rate(env)
    terms = {name: term for name, term in (env.get("actions") or {}).items() if isinstance(term, Mapping)}
    raw = None if limit is None else Affine(np.ones(size, np.float32), np.zeros(size, np.float32), limit)
    scales: list[float] = []
    offsets: list[float] = []
    elements: list[Element] = []
    notes: list[str] = []
    for name, term in terms.items():
        try:
            joints, unit, scale, offset = _term(env, term, size if len(terms) == 1 else None, notes)
        except ValueError as error:
            why = f"action term '{name}' {error}: its scale and offset are NOT in the export, which gives the policy's"
            return ActionTerms(raw, (), rate, (f"{why} own numbers",))
        scales += scale
        offsets += offset
        elements += [Element(name=joint, unit=unit) for joint in joints]
    if not terms:
        return ActionTerms(raw, (), rate, ("env.yaml has no actions: the export gives the policy's own numbers",))
    if len(scales) != size:
        raise CheckpointError(
            f"env.yaml's action terms ({', '.join(terms)}) have {len(scales)} elements, the policy's action "
            f"has {size}: they do not belong together"
        )
    affine = Affine(np.array(scales, np.float32), np.array(offsets, np.float32), limit)
    return ActionTerms(affine, tuple(elements) if len(elements) == size else (), rate, tuple(notes))


def _term(
    env: Mapping[str, Any], term: Mapping[str, Any], size: int | None, notes: list[str]
) -> tuple[list[str], str, list[float], list[float]]:
    """Return one term's joint names (empty if unknown), unit, scale and offset. Raises ValueError with a reason."""
    path = str(term.get("class_type", ""))
    kind = re.split(r"[.:]", path)[-1]
    if kind not in KINDS:
        raise ValueError(f"is a {kind or 'term without a class'}, which is more than a scale and an offset")
    unit, default = KINDS[kind]
    asset = str(term.get("asset_name") or term.get("entity_name") or "robot")
    state = _init_state(env, asset)
    patterns = [str(each) for each in term.get("joint_names") or term.get("actuator_names") or ()]
    # Alphabetical keys have lost the order of the joints.
    joints = _joints(patterns, {} if list(env) == sorted(env) else state, size, notes)
    count = len(joints) or size
    if count is None:
        raise ValueError(f"names its joints by the pattern {', '.join(patterns)}, and env.yaml does not list them")
    scale = _values(term.get("scale", 1.0), joints, count, 1.0, "scale")
    offset = _values(term.get("offset", 0.0), joints, count, 0.0, "offset")
    if term.get("use_default_offset") and default:
        offset = _values(state.get(default) or {".*": 0.0}, joints, count, 0.0, "default offset")
    if term.get("clip"):
        raise ValueError("has a clip of its own")
    return joints, unit, scale, offset


def _init_state(env: Mapping[str, Any], asset: str) -> Mapping[str, Any]:
    scene = env.get("scene") or {}
    entity = scene.get(asset) or (scene.get("entities") or {}).get(asset) or {}
    state = entity.get("init_state") if isinstance(entity, Mapping) else None
    return state if isinstance(state, Mapping) else {}


def _joints(patterns: Sequence[str], state: Mapping[str, Any], size: int | None, notes: list[str]) -> list[str]:
    """Return the joints' names in the action's order; empty if only the robot's file has them.

    Isaac Lab writes env.yaml in the order of its settings, so the initial state lists the joints as the robot has them;
    a file with sorted keys does not show it.
    """
    if patterns and all(re.fullmatch(r"\w+", each) for each in patterns):
        return list(patterns)
    listed = [str(name) for name in state.get("joint_pos") or {} if re.fullmatch(r"\w+", str(name))]
    meant = [name for name in listed if any(re.fullmatch(pattern, name) for pattern in patterns)]
    if meant and len(meant) == size:
        notes.append(f"the joints' order is that of env.yaml's init_state, check it: {', '.join(meant)}")
        return meant
    return []


def _values(given: Any, joints: Sequence[str], count: int, missing: float, what: str) -> list[float]:
    """Return one number per element, given a number, a list, or a mapping from patterns of names."""
    if isinstance(given, int | float):
        return [float(given)] * count
    if isinstance(given, list) and len(given) == count:
        return [float(each) for each in given]
    if isinstance(given, Mapping):
        if joints:
            matches = [[v for pattern, v in given.items() if re.fullmatch(str(pattern), joint)] for joint in joints]
            return [float(found[0]) if found else missing for found in matches]
        if list(given) == [".*"]:
            return [float(given[".*"])] * count
    raise ValueError(f"has a {what} of single joints ({given}) whose order is not in env.yaml")


def _rate(env: Mapping[str, Any]) -> float | None:
    simulation = env.get("sim") or {}
    step: Any = simulation.get("dt") or (simulation.get("mujoco") or {}).get("timestep")
    decimation: Any = env.get("decimation")
    try:
        rate = 1.0 / (float(step) * int(decimation))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None
