"""Readers of what is said of a given ONNX file: its metadata, and the files that its exporter wrote beside it.

| origin | where |
|---|---|
| mjlab (and whole_body_tracking) | `metadata_props`: comma-separated lists, numbers with three decimals |
| Isaac Lab | `IO_descriptors.yaml`; the run's `env.yaml` |
| Unitree's unitree_rl_lab | `deploy.yaml`: numbers with three digits, joints without names |
| Microduck | `manifest.json` with `obs_len`, or `policies` |
| physicalai, LeRobot | `manifest.json` with the format `policy_package` |

They may only add to each other: where two differ by more than such rounding, the file is refused.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.sources.isaac_env import (
    KINDS,
    LIBRARIES,
    action_terms,
    class_name,
    clip_actions,
    read_yaml,
    selected,
)
from rlservo.export.sources.isaac_observations import clip_note, clip_notes

DESCRIPTORS = ("IO_descriptors.yaml", "io_descriptors/IO_descriptors.yaml", "../io_descriptors/IO_descriptors.yaml")
DEPLOYS = ("deploy.yaml", "params/deploy.yaml", "../params/deploy.yaml")
ENVIRONMENTS = ("params/env.yaml", "../params/env.yaml")
AGENTS = ("params/agent.yaml", "../params/agent.yaml")
"""Places beside the file: of a run's `exported/policy.onnx`, the run's folder."""
LENGTHS = {
    "default_joint_pos": "joint_names",
    "observation_terms_scale": "observation_names",
    "observation_terms_clip": "observation_names",
    "observation_terms_history_length": "observation_names",
}
"""Lists of mjlab's metadata, and those that name their entries."""
RTOL, ATOL = 6e-3, 6e-4
"""What three digits or three decimals leave of a number."""
Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Term:
    """One of the terms that an observation is a row of."""

    name: str
    kind: str
    """Name of its function in Isaac Lab or mjlab."""
    size: int | None = None
    joints: tuple[str, ...] = ()
    offsets: Sequence[float | None] = ()
    scale: float | list[float] | None = None
    history: int = 1


@dataclass(frozen=True)
class Annotation:
    """What one place says; what it leaves out is None or empty. An action's lists have one entry for each element."""

    place: str
    observation_size: int | None = None
    action_size: int | None = None
    control_rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    scale: Numbers = ()
    offset: Numbers = ()
    clip: tuple[tuple[float, float], ...] = ()
    terms: tuple[Term, ...] = ()
    observation_names: tuple[str, ...] = ()
    inputs: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Shapes of the graph's inputs, without the batch."""
    gains: Mapping[str, Any] = field(default_factory=dict)
    order: str = ""
    """Order of quaternions."""
    left_out: str = ""
    """A clause for what it says of the action that a scale and an offset do not express."""
    notes: tuple[str, ...] = ()
    """Warnings."""


def annotation_files(model: Path) -> list[Path]:
    """Return the files beside a model that are read with it."""
    names = (*ENVIRONMENTS, *DESCRIPTORS, "manifest.json", *DEPLOYS, *AGENTS)
    return [file for name in names if (file := model.parent / name).is_file()]


def limit_of(model: Path) -> float | None:
    """Return the `clip_actions` of the run that a model is of: the training's wrapper clips before it scales."""
    agents = [file for name in AGENTS if (file := model.parent / name).is_file()]
    return clip_actions(agents[0], read_yaml(agents[0])) if agents else None


def read_annotations(
    model: Path, metadata: Mapping[str, str], size: int, joint_order: Sequence[str]
) -> list[Annotation]:
    """Return what each place says of a policy with `size` action elements, the most exact numbers first.

    Raises CheckpointError for a place that cannot be read or does not fit the action, UnsupportedError for steps that
    are not in the graph.
    """
    found: list[tuple[str, Callable[[], Annotation]]] = []
    for file in annotation_files(model):
        if file.name == "IO_descriptors.yaml":
            found.append((str(file), partial(_descriptors, file, joint_order)))
        elif file.name == "env.yaml":
            found.append((str(file), partial(_environment, file, size, joint_order)))
        elif file.name == "agent.yaml":
            continue
        elif file.name == "deploy.yaml":
            found.append((str(file), partial(_deploy, file, size, joint_order)))
        elif (manifest := _json(file)).get("format") == "policy_package":
            found.append((str(file), partial(_policy_package, file, manifest, model)))
        elif manifest.keys() & {"obs_len", "action_len", "policies", "schema_version"}:
            found.append((str(file), partial(_microduck, file, manifest, model)))
    if metadata.keys() & {"joint_names", "observation_names", "action_scale"}:
        place = f"{model} (metadata_props)"
        found.append((place, partial(_mjlab, place, metadata, size, joint_order)))
    read: list[Annotation] = []
    for place, reader in found:
        try:
            read.append(reader())
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(
                f"{place} is not as its exporter writes it: {type(error).__name__}: {error}"
            ) from error
    if sum(bool(each.scale) for each in read) == 1 and read[-1].scale and "action_scale" in metadata:
        read[-1] = _with_rounding(read[-1], metadata["action_scale"])
    return read


def _with_rounding(said: Annotation, scale: str) -> Annotation:
    """Return the annotation with a warning of an action_scale of few digits. Raises CheckpointError if it is 0."""
    rounded = [text for text in scale.split(",") if abs(float(text)) < 0.05 and re.fullmatch(r"-?\d*\.\d{1,3}", text)]
    if 0.0 in map(float, scale.split(",")):
        raise CheckpointError(
            f"{said.place}: action_scale is {scale}, and a joint with 0 would never move: its exporter rounds to three "
            "decimals; write the training's own numbers there, or lay the run's params/env.yaml beside"
        )
    if rounded:
        off = max(0.0005 / abs(float(text)) for text in rounded)
        note = f"action_scale is {scale}, rounded: the training's numbers may differ by {off:.0%}"
        return replace(said, notes=(*said.notes, note))
    return said


def merged(annotations: Sequence[Annotation]) -> Annotation:
    """Return everything that is said. Raises CheckpointError with both values where two places differ."""
    if not annotations:
        return Annotation("no file")
    first, *others = annotations
    result = first
    for other in others:
        for name in Annotation.__dataclass_fields__:
            ours, theirs = getattr(result, name), getattr(other, name)
            if not ours:
                result = replace(result, **{name: theirs})
            elif theirs and name in COMPARED and not _alike(ours, theirs):
                raise CheckpointError(
                    f"{result.place} has the {COMPARED[name]} {_text(ours)}, but {other.place} has {_text(theirs)}: "
                    "they do not describe the same policy; remove one of them"
                )
    return result


COMPARED = {
    "observation_size": "observation size", "action_size": "action size", "control_rate_hz": "control rate",
    "joints": "action's joints", "command": "action's command", "scale": "action scale", "offset": "action offset",
    "clip": "action clip",
}  # fmt: skip


def _alike(ours: Any, theirs: Any) -> bool:
    a, b = np.asarray(ours), np.asarray(theirs)
    if a.dtype.kind not in "iuf" or b.dtype.kind not in "iuf":
        return bool(ours == theirs)
    return a.shape == b.shape and bool(np.allclose(a, b, RTOL, ATOL))


def _text(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _json(file: Path) -> dict[str, Any]:
    try:
        read = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file} cannot be read: {error}") from error
    if not isinstance(read, dict):
        raise CheckpointError(f"{file} holds a {type(read).__name__}: expected a mapping")
    return read


def _each(place: str, what: str, given: Any, size: int) -> Numbers:
    """Return a number for each element. Raises CheckpointError for a list of another length."""
    numbers = tuple(float(number) for number in given) if isinstance(given, list) else (float(given),) * size
    if len(numbers) != size:
        raise CheckpointError(f"{place}: {what} has {len(numbers)} numbers, but the action has {size} elements")
    if not np.isfinite(numbers).all():
        raise CheckpointError(f"{place}: {what} is not finite: {_text(numbers)}")
    return numbers


def _mjlab(place: str, metadata: Mapping[str, str], size: int, joint_order: Sequence[str]) -> Annotation:
    """mjlab/rl/exporter_utils.py: lists with commas, lists in them with semicolons."""

    def names(key: str) -> list[str]:
        listed = [name.strip() for name in metadata.get(key, "").split(",") if name]
        if any(re.search(r"[\[\]{}'\"]", name) for name in listed):
            raise ValueError(f"{key} is {metadata[key]!r}: expected entries with commas between")
        return listed

    def numbers(key: str) -> list[float]:
        return [float(number) for number in names(key)]

    robot, terms = names("joint_names"), names("observation_names")
    for key, names_key in LENGTHS.items():
        count, expected = len(names(key)), len(names(names_key))
        if count and expected and count != expected:
            raise CheckpointError(f"{place}: {names_key} has {expected} entries, {key} has {count}")
    joints = list(joint_order) or (robot if len(robot) == size else [])
    if robot and [joint for joint in robot if joint in joints] != joints:
        raise CheckpointError(
            f"{place} has the joints {_text(tuple(robot))}, the joint order that was given is {_text(tuple(joints))}"
        )
    if robot and len(joints) != size:
        raise CheckpointError(
            f"{place}: joint_names has {len(robot)} joints, but the action has {size} elements: --joint-order names "
            "those that the action moves, in its order"
        )
    clause = metadata.get("action_term") or metadata.get("action_type") or ""
    moved: dict[str, Any] = {}
    if clause in ("", "joint_pos") and "action_scale" in metadata and not (robot and "default_joint_pos" in metadata):
        absent = "default_joint_pos" if robot else "joint_names"
        clause = f"joint target with an action_scale, but no {absent} to start from"
    if "action_scale" in metadata and clause in ("", "joint_pos"):
        default = dict(zip(robot, numbers("default_joint_pos"), strict=True))
        scale = numbers("action_scale")
        moved = {
            "command": ("joint position",) * size,
            "scale": _each(place, "action_scale", scale[0] if len(scale) == 1 else scale, size),
            "offset": tuple(default[joint] for joint in joints),
        }
        clause = ""
    scales = [[float(part) for part in one.split(";")] for one in names("observation_terms_scale")]
    histories = numbers("observation_terms_history_length") or [0.0] * len(terms)
    clips = [[float(end) for end in one.split(";")] for one in names("observation_terms_clip")]
    unknown, is_twist = (None,) * len(robot), metadata.get("command_names") == "twist"

    def term(name: str, scale: list[float], history: float) -> Term:
        size = len(scale) if len(scale) > 1 else 3 if name == "command" and is_twist else None
        return Term(
            name, name, size, tuple(robot), unknown, scale[0] if len(scale) == 1 else scale, max(1, int(history))
        )

    return Annotation(
        place,
        joints=tuple(joints),
        terms=tuple(map(term, terms, scales or [[1.0]] * len(terms), histories)),
        notes=tuple(filter(None, map(clip_note, terms, clips))),
        gains={key: numbers(key) for key in ("joint_stiffness", "joint_damping")},
        left_out=f"its action is a {clause}" if clause else "",
        **moved,
    )


def _environment(file: Path, size: int, joint_order: Sequence[str]) -> Annotation:
    """The training's configuration: exact numbers."""
    terms = action_terms(file, size, None, joint_order)
    rate, notes = terms.control_rate_hz, (*terms.notes, *clip_notes(file, ("policy", "actor")))
    if not terms.processed or terms.affine is None:
        return Annotation(str(file), control_rate_hz=rate, notes=notes)
    low, high = terms.bounds or (np.full(size, -np.inf), np.full(size, np.inf))
    return Annotation(
        str(file),
        control_rate_hz=rate,
        joints=tuple(element.joint for element in terms.elements),
        command=tuple(str(element.quantity) for element in terms.elements),
        scale=tuple(terms.affine.scale.tolist()),
        offset=tuple(terms.affine.offset.tolist()),
        clip=tuple(zip(low.tolist(), high.tolist(), strict=True)),
        notes=notes,
    )


def _descriptors(file: Path, joint_order: Sequence[str]) -> Annotation:
    """Isaac Lab's ManagerBasedEnv.get_IO_descriptors."""
    described = read_yaml(file)
    terms = [
        (
            class_name(str(term["full_path"])),
            term.get("joint_names") or [],
            int(np.prod(term["shape"])),
            term,
        )
        for term in described["actions"]
    ]
    groups = described["observations"]
    group = groups.get("policy", groups.get("actor", next(iter(groups.values())) if len(groups) == 1 else []))
    texts = [str((term.get("extras") or {}).get("description")) for term in group]
    orders = [order for order in ("wxyz", "xyzw") if any(f"({', '.join(order)})" in text for text in texts)]
    scene = described.get("scene") or {}
    step, physics, decimation = (scene.get(key) for key in ("dt", "physics_dt", "decimation"))
    if step and physics and decimation and not np.isclose(step, physics * decimation, rtol=1e-4):
        raise CheckpointError(f"{file}: dt is {step} s, but {decimation} times physics_dt are {physics * decimation} s")
    robot: Mapping[str, Any] = next(iter((described.get("articulations") or {}).values()), {})
    own = robot.get("joint_names") or [joint for _, joints, _, _ in terms for joint in joints]
    if own and joint_order and [joint for joint in own if joint in joint_order] != list(joint_order):
        raise CheckpointError(f"the joint order that was given ({_text(tuple(joint_order))}) is not that of {file} "
                              f"({_text(tuple(own))})")  # fmt: skip
    observed = tuple(_described_term(term) for term in group)
    return Annotation(
        str(file),
        notes=tuple(filter(None, (clip_note(str(t["name"]), (t.get("overloads") or {}).get("clip")) for t in group))),
        observation_size=sum((term.size or 0) * term.history for term in observed) or None,
        control_rate_hz=1.0 / step if step else None,
        terms=observed,
        gains={key: robot[key] for key in ("default_joint_stiffness", "default_joint_damping") if key in robot},
        order=orders[0] if len(orders) == 1 else "",
        action_size=sum(size for _, _, size, _ in terms),
        **_commands(file, terms),
    )


def _commands(file: Path, terms: Iterable[tuple[str, list[str], int, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the fields of an annotation, given each action term's class, joints, size and settings."""
    moved: dict[str, list[Any]] = {"joints": [], "command": [], "scale": [], "offset": [], "clip": []}
    for kind, joints, size, term in terms:
        if kind not in KINDS:
            return {"left_out": f"an action term is a {kind}, which is more than a scale and an offset"}
        moved["joints"] += joints
        moved["command"] += [KINDS[kind][2]] * size
        for key in ("scale", "offset"):
            if term.get(key) is None:
                raise CheckpointError(f"{file}: the {kind} has no {key}, and a guess would move the joints wrongly")
            moved[key] += _each(str(file), key, term[key], size)
        moved["clip"] += _sides(str(file), term.get("clip") or [[-np.inf, np.inf]] * size, size)
    return {key: _tuples(values) for key, values in moved.items()}


def _sides(place: str, given: Any, size: int) -> list[list[float]]:
    """Return [low, high] for each element of a term. Raises CheckpointError for anything else."""
    sides = np.asarray(given, np.float64)  # a ValueError if it is ragged
    if sides.shape != (size, 2) or not (sides[:, 0] <= sides[:, 1]).all():
        raise CheckpointError(
            f"{place}: the action's clip is {given}: expected [low, high] for each of {size} elements"
        )
    return [list(map(float, side)) for side in sides]


def _described_term(term: Mapping[str, Any]) -> Term:
    overloads = term.get("overloads") or {}
    joints = tuple(term.get("joint_names") or ())
    offsets = term.get("joint_pos_offsets", term.get("joint_vel_offsets")) or [0.0] * len(joints)
    is_own = not LIBRARIES.match(str(term["full_path"])) or (term.get("extras") or {}).get("modifiers")
    kind = "" if is_own else re.split(r"[.:]", str(term["full_path"]))[-1]
    history = max(1, int(overloads.get("history_length") or 0))
    size = int(np.prod(term["shape"]))
    return Term(str(term["name"]), kind, size, joints, offsets, overloads.get("scale"), history)


def _deploy(file: Path, size: int, joint_order: Sequence[str]) -> Annotation:
    """unitree_rl_lab/utils/export_deploy_cfg.py: the robot's joints only by number."""
    described = read_yaml(file)
    default = described["default_joint_pos"]
    if joint_order and len(joint_order) != len(default):
        raise CheckpointError(
            f"{file}: default_joint_pos has {len(default)} joints, but the given joint order has {len(joint_order)}"
        )
    actions = []
    for name, term in described["actions"].items():
        joints = selected(joint_order, term.get("joint_ids")) if joint_order else []
        actions.append((name, joints, len(term["scale"]), term))
        offset, ids = term.get("offset"), term.get("joint_ids")
        own = selected(default, ids) if isinstance(ids, list) else default
        if isinstance(offset, list) and offset != own and sorted(offset) == sorted(default):
            raise CheckpointError(
                f"{file}: default_joint_pos is {default}, but the offset of {name} has the same numbers as {offset}: "
                "they are in different joint orders"
            )
    total = sum(count for _, _, count, _ in actions)
    if total != size:
        raise CheckpointError(f"{file}: the actions' scale has {total} numbers, but the action has {size} elements")
    terms = [
        Term(name, name, len(term["scale"]), tuple(joint_order) if len(term["scale"]) == len(default) else (),
             default if name == "joint_pos_rel" else [0.0] * len(default), term["scale"],
             max(1, int(term.get("history_length") or 1)))
        for name, term in described["observations"].items()
    ]  # fmt: skip
    return Annotation(
        str(file),
        observation_size=sum((term.size or 0) * term.history for term in terms),
        action_size=total,
        control_rate_hz=1.0 / float(described["step_dt"]),
        terms=tuple(terms),
        notes=tuple(filter(None, (clip_note(n, term.get("clip")) for n, term in described["observations"].items()))),
        gains={key: described[key] for key in ("stiffness", "damping") if key in described},
        **_commands(file, actions),
    )


def _microduck(file: Path, manifest: Mapping[str, Any], model: Path) -> Annotation:
    """pollen-robotics/microduck, docs/policy-manifest.md: one policy, or a set with an entry for each file."""
    said = _entry(manifest, model)
    return Annotation(
        str(file),
        observation_size=said.get("obs_len"),
        action_size=said.get("action_len"),
        control_rate_hz=(said.get("robot") or {}).get("control_hz"),
    )


def _entry(manifest: Mapping[str, Any], model: Path) -> Mapping[str, Any]:
    entries = [each for each in manifest.get("policies") or () if each.get("file") == model.name]
    return {**manifest, **(entries[0] if entries else {})}


def read_facts(model: Path) -> CheckpointFacts:
    """Return what a manifest beside a model says of its training."""
    file = model.parent / "manifest.json"
    training = _entry(_json(file), model).get("training") if file.is_file() else None
    if not isinstance(training, Mapping):
        return CheckpointFacts()
    task, steps = training.get("task_id"), training.get("checkpoint")
    return CheckpointFacts(
        env_id=task if isinstance(task, str) else None, training_iterations=steps if isinstance(steps, int) else None
    )


def _policy_package(file: Path, manifest: Mapping[str, Any], path: Path) -> Annotation:
    """physicalai/inference/manifest.py, also LeRobot's: the processors around the model are not in the graph."""
    model = manifest.get("model") or {}
    files = [str(name) for name in (model.get("artifacts") or {}).values()]
    if files and path.name not in map(os.path.basename, files):
        raise CheckpointError(f"{file}: its model is {', '.join(files)}, the given file is {path.name}")
    runner = model.get("runner") or {}
    kind = str(runner.get("type") or runner.get("class_path") or "single_pass")
    around = [*(model.get("preprocessors") or ()), *(model.get("postprocessors") or ())]
    if around or re.split(r"[.]", kind)[-1] not in ("single_pass", "SinglePass"):
        what = (
            [f"the runner {kind}"] if not around else [str(one.get("type") or one.get("class_path")) for one in around]
        )
        raise UnsupportedError(
            f"{file}: {', '.join(what)} is not in the graph, which would act differently without it: export the model "
            "with it inside, with one action per step"
        )
    robots = (manifest.get("hardware") or {}).get("robots") or [{}]
    state, action = robots[0].get("state") or {}, robots[0].get("action") or {}
    features = [each.get("init_args") or each for each in model.get("input_features") or ()]
    return Annotation(
        str(file),
        observation_size=int(np.prod(state["shape"])) if "shape" in state else None,
        action_size=int(np.prod(action["shape"])) if "shape" in action else None,
        joints=tuple(action.get("order") or ()),
        observation_names=tuple(state.get("order") or ()),
        inputs={str(each["name"]): tuple(each["shape"]) for each in features if "name" in each and "shape" in each},
    )


def _tuples(values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(tuple(each) if isinstance(each, list) else each for each in values)
