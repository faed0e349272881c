"""Elements of an Isaac Lab or mjlab observation, from the terms in `params/env.yaml`.

A term is a function whose result is known: joints in the robot's order, a pose, a velocity. What no file says stays
open: the name of the robot's base frame, and the order of a quaternion where the release cannot be told.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.bundle.spaces import Axis, Element, Quantity
from rlservo.errors import CheckpointError
from rlservo.export.sources.isaac_env import (
    DESCRIPTORS,
    LIBRARIES,
    ActionTerms,
    below,
    default_offset,
    match,
    read_yaml,
    robot_joints,
    section,
    selected,
)

# Functions of joints: quantity, unit, and the key of the default that is subtracted.
JOINTS: dict[str, tuple[Quantity, str, str]] = {
    "joint_pos": ("joint position", "rad", ""),
    "joint_pos_rel": ("joint position", "rad", "joint_pos"),
    "joint_vel": ("joint velocity", "rad/s", ""),
    "joint_vel_rel": ("joint velocity", "rad/s", "joint_vel"),
    "joint_effort": ("joint effort", "N*m", ""),
}
# Functions of the robot's body: quantity, unit, axes, frame; the base's own frame has no name in the files.
XYZ: tuple[Axis, ...] = ("x", "y", "z")
BODY: dict[str, tuple[Quantity, str, tuple[Axis, ...], str]] = {
    "base_pos_z": ("position", "m", ("z",), "world"),
    "base_lin_vel": ("linear velocity", "m/s", XYZ, ""),
    "base_ang_vel": ("angular velocity", "rad/s", XYZ, ""),
    "projected_gravity": ("gravity", "1", XYZ, ""),
    "root_pos_w": ("position", "m", XYZ, "world"),
    "root_quat_w": ("quaternion", "1", (), "world"),
    "root_lin_vel_w": ("linear velocity", "m/s", XYZ, "world"),
    "root_ang_vel_w": ("angular velocity", "rad/s", XYZ, "world"),
}
POSE_COMMAND, VELOCITY_COMMAND = "UniformPoseCommand", "UniformVelocityCommand"
FARTHEST = 4 * math.pi  # [rad], of a joint from its default
RELEASES = {"physx": "wxyz", "physics": "xyzw", "mujoco": "wxyz"}  # keys of env.yaml's sim
IDENTITIES = {"wxyz": [1, 0, 0, 0], "xyzw": [0, 0, 0, 1]}


def quaternion_order(file: Path) -> str:
    """Return the order of quaternions in the release that wrote an env.yaml; '' if it cannot be told.

    Isaac Lab 2 has w, x, y, z and its solver's settings in `sim.physx`; 3 has x, y, z, w, and a choice of engines in
    `sim.physics` (isaaclab/sim/simulation_cfg.py). MuJoCo, and so mjlab, has w, x, y, z. IO_descriptors.yaml has the
    order in descriptions; its axes W, X, Y, Z are also those of 3.0's betas, whose numbers are x, y, z, w. Where two
    of these differ, or all poses of the scene without a turn are in the other order, nothing is certain.
    """
    env = read_yaml(file)
    simulation, scene = env.get("sim"), env.get("scene")
    found = {order for key, order in RELEASES.items() if isinstance(simulation, Mapping) and key in simulation}
    for term in _descriptions(file):
        extras = below(term, "extras")
        found |= {order for order in IDENTITIES if f"({', '.join(order)})" in str(below(extras, "description"))}
        if below(extras, "axes") == ["X", "Y", "Z", "W"]:
            found.add("xyzw")
    if len(found) != 1:
        return ""
    (order,) = found
    poses = scene.values() if isinstance(scene, Mapping) else ()
    turns = [below(below(entity, "init_state"), "rot") for entity in poses]
    others = [identity for other, identity in IDENTITIES.items() if other != order and identity in turns]
    return "" if others and IDENTITIES[order] not in turns else order


def _descriptions(file: Path) -> Iterator[Any]:
    described = file.parent.parent / DESCRIPTORS
    groups = read_yaml(described).get("observations") if described.is_file() else None
    for terms in groups.values() if isinstance(groups, Mapping) else ():
        yield from terms if isinstance(terms, list) else ()


def observation_elements(
    file: Path, groups: Sequence[str], size: int, actions: ActionTerms, joint_order: Sequence[str] = ()
) -> tuple[Element, ...]:
    """Return the `size` elements of an observation that concatenates `groups`; none where they cannot be known."""
    if not file.is_file():
        return ()
    env, order = read_yaml(file), quaternion_order(file)
    try:
        terms = [elements for group in groups for elements in _group(env, file, group, actions, joint_order, order)]
    except (CheckpointError, ValueError, re.error):  # the action's terms raise what matters
        return ()
    return fill(terms, size)


def fill(terms: Sequence[Sequence[Element] | str], size: int) -> tuple[Element, ...]:
    """Return the `size` elements of a row of terms, of which one may be unknown (its name); () if they do not fit."""
    unknown = [number for number, elements in enumerate(terms) if isinstance(elements, str)]
    left = size - sum(len(elements) for elements in terms if not isinstance(elements, str))
    if left != 0 if not unknown else len(unknown) != 1 or left < 1:
        return ()
    return tuple(
        element
        for elements in terms
        for element in (
            [Element(name=f"{elements}_{index}") for index in range(left)] if isinstance(elements, str) else elements
        )
    )


def _group(
    env: Mapping[str, Any], file: Path, group: str, actions: ActionTerms, joint_order: Sequence[str], order: str
) -> Iterator[list[Element] | str]:
    """Yield each term's elements, or its name if they are not known. Raises ValueError for another layout."""
    settings = section(section(env, "observations", file), group, file)
    if not settings or settings.get("concatenate_terms") is False or settings.get("history_length"):
        raise ValueError("the group is not a plain row of terms")
    nested = settings.get("terms")  # mjlab's
    for name, term in (nested if isinstance(nested, Mapping) else settings).items():
        if not isinstance(term, Mapping) or "func" not in term:
            continue
        path = str(term["func"])
        kind = re.split(r"[.:]", path)[-1] if LIBRARIES.match(path) else ""
        if term.get("history_length") or term.get("modifiers"):
            yield name
            continue
        elements = _term(env, file, name, kind, term, actions, joint_order, order)
        sides = [side for side in term.get("clip") or () if isinstance(side, int | float)]
        if elements is not None and sides and min(map(abs, sides)) < FARTHEST:  # beyond it, no longer the quantity
            elements = [element.model_copy(update={"offset": None}) for element in elements]
        yield name if elements is None else scaled(elements, term.get("scale"))


def _term(
    env: Mapping[str, Any],
    file: Path,
    name: str,
    kind: str,
    term: Mapping[str, Any],
    actions: ActionTerms,
    joint_order: Sequence[str],
    order: str,
) -> list[Element] | None:
    parameters = term.get("params")
    if kind in JOINTS:
        default = JOINTS[kind][2]
        asset = below(parameters, "asset_cfg")
        robot = str(below(asset, "name") or "robot")
        known = robot_joints(file, env, robot, joint_order)
        if known is None:
            return None
        joints = _observed_joints(asset, known)
        offsets = [0.0] * len(joints)
        if default and below(below(below(env.get("scene"), robot), "init_state"), default) is not None:
            offsets = default_offset(env, {"asset_name": robot, "class_type": str(term["func"])}, default, joints)
        return joint_elements(name, kind, joints, offsets)
    if kind in BODY:
        return body_elements(name, kind, order)
    if kind == "last_action" and below(parameters, "action_name") is None and actions.elements:
        affine = actions.affine if actions.processed else None
        numbers = (affine.scale.tolist(), affine.offset.tolist()) if affine is not None else ()
        return last_action(name, actions.elements, *numbers)
    if kind == "generated_commands":
        command = below(env.get("commands"), str(below(parameters, "command_name")))
        path = str(below(command, "class_type") or "")
        of = re.split(r"[.:]", path)[-1] if LIBRARIES.match(path) else ""
        if of == POSE_COMMAND:
            point = [Element(name=f"{name}_{axis}", unit="m", quantity="position", axis=axis) for axis in XYZ]
            return point + _quaternion(name, order, "")
        if of == VELOCITY_COMMAND:
            return velocity_command(name)
    return None


def _observed_joints(asset: Any, robot: Sequence[str]) -> list[str]:
    """Return the joints of a term in its order: SceneEntityCfg's `joint_names` or `joint_ids`. Raises ValueError."""
    patterns = below(asset, "joint_names")
    if patterns is None:
        return selected(robot, below(asset, "joint_ids"))
    found = match([patterns] if isinstance(patterns, str) else patterns, robot, "joint_names")
    keeps = below(asset, "preserve_order") is True
    return sorted(found, key=lambda joint: found[joint]) if keeps else list(found)


def clip_notes(file: Path, groups: Sequence[str]) -> Iterator[str]:
    """Yield a warning for each term of an observation that the training clips: no exported graph does."""
    env = read_yaml(file) if file.is_file() else {}
    for group in groups:
        settings = below(below(env, "observations"), group)
        terms = below(settings, "terms") or settings  # mjlab's
        for name, term in terms.items() if isinstance(terms, Mapping) else ():
            if note := clip_note(str(name), below(term, "clip")):
                yield note


def clip_note(name: str, clip: Any) -> str:
    """Return a warning that an observation's term is clipped before it is scaled; '' if it is not."""
    ends = [end for end in clip if isinstance(end, int | float)] if isinstance(clip, list | tuple) else []
    if not np.isfinite(ends).any():
        return ""
    sides = " to ".join(f"{end:g}" for end in ends)
    return f"the training clips '{name}' of the observation to {sides}, the export does not: clip it before you send it"


def joint_elements(name: str, kind: str, joints: Sequence[str], offsets: Sequence[float | None]) -> list[Element]:
    """Return the elements of a function of joints.

    A position whose offset is not known (None) may be relative to a default: it is not called a position.
    """
    quantity, unit, _ = JOINTS[kind]
    return [
        Element(name=f"{name}_{joint}", unit=unit, joint=joint)
        if offset is None and quantity == "joint position"
        else Element(name=f"{name}_{joint}", unit=unit, quantity=quantity, joint=joint, scale=1.0, offset=offset)
        for joint, offset in zip(joints, offsets, strict=True)
    ]


def body_elements(name: str, kind: str, order: str) -> list[Element]:
    """Return the elements of a function of the robot's body; `order` is that of quaternions, '' if not known."""
    quantity, unit, axes, frame = BODY[kind]
    if quantity == "quaternion":
        return _quaternion(name, order, frame)
    return [Element(name=f"{name}_{axis}", unit=unit, quantity=quantity, axis=axis, frame=frame) for axis in axes]


def last_action(
    name: str, actions: Sequence[Element], scale: Sequence[float] = (), offset: Sequence[float] = ()
) -> list[Element]:
    """Return the elements of the action before, in the policy's own numbers: the action is these * scale + offset."""
    unknown: list[float | None] = [None] * len(actions)
    known = zip(actions, scale or unknown, offset or unknown, strict=True)
    return [
        Element(
            name=f"{name}_{action.joint or index}",
            quantity="last action",
            joint=action.joint,
            scale=factor,
            offset=shift,
        )
        for index, (action, factor, shift) in enumerate(known)
    ]


def velocity_command(name: str) -> list[Element]:
    """Return the elements of a command of the base: two linear velocities and the turn."""
    linear = [Element(name=f"{name}_{axis}", unit="m/s", quantity="linear velocity", axis=axis) for axis in XYZ[:2]]
    return [*linear, Element(name=f"{name}_turn", unit="rad/s", quantity="angular velocity", axis="z")]


def scaled(elements: Sequence[Element], scale: Any) -> list[Element]:
    """Return the elements of a term that is multiplied by `scale`, as they are left if it is None."""
    if scale is None:
        return list(elements)
    factors = scale if isinstance(scale, list) and len(scale) == len(elements) else [scale] * len(elements)
    return [
        element.model_copy(update={"scale": (element.scale or 1.0) / factor})
        if isinstance(factor, int | float) and factor
        else element.model_copy(update={"scale": None, "offset": None, "unit": ""})
        for element, factor in zip(elements, factors, strict=True)
    ]


def _quaternion(name: str, order: str, frame: str) -> list[Element]:
    parts: Any = order or [""] * 4
    return [
        Element(name=f"{name}_q{axis or index}", unit="1", quantity="quaternion", axis=axis, frame=frame)
        for index, axis in enumerate(parts)
    ]
