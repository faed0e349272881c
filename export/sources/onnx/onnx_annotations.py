"""Readers of what is said of a given ONNX file: its metadata, and the files that its exporter wrote beside it.

| origin | where |
|---|---|
| mjlab (and whole_body_tracking) | `metadata_props`: comma-separated lists, numbers with three decimals |
| Isaac Lab | `IO_descriptors.yaml` |
| Unitree's unitree_rl_lab | `deploy.yaml`: numbers with three digits, joints without names |
| Microduck | `manifest.json` with `obs_len`, or `policies` |
| physicalai, LeRobot | `manifest.json` with the format `policy_package` |

They may only add to each other: where two differ by more than such rounding, the file is refused.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.sources.isaac_env import KINDS, class_name, clip_actions, read_yaml

DESCRIPTORS = ("IO_descriptors.yaml", "io_descriptors/IO_descriptors.yaml", "../io_descriptors/IO_descriptors.yaml")
DEPLOYS = ("deploy.yaml", "params/deploy.yaml", "../params/deploy.yaml")
AGENTS = ("params/agent.yaml", "../params/agent.yaml")
"""Places beside the file: of a run's `exported/policy.onnx`, the run's folder."""
LENGTHS = {
    "default_joint_pos": "joint_names",
    "observation_terms_scale": "observation_names",
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


def annotation_files(model: Path) -> list[Path]:
    """Return the files beside a model that are read with it."""
    names = (*DESCRIPTORS, "manifest.json", *DEPLOYS, *AGENTS)
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
    if metadata.keys() & {"joint_names", "observation_names", "action_scale"}:
        place = f"{model} (metadata_props)"
        found.append((place, partial(_mjlab, place, metadata, size, joint_order)))
    for file in annotation_files(model):
        if file.name == "IO_descriptors.yaml":
            found.append((str(file), partial(_descriptors, file)))
        elif file.name == "agent.yaml":
            continue
        elif file.name == "deploy.yaml":
            found.append((str(file), partial(_deploy, file, size, joint_order)))
        elif (manifest := _json(file)).get("format") == "policy_package":
            found.append((str(file), partial(_policy_package, file, manifest)))
        elif manifest.keys() & {"obs_len", "action_len", "policies", "schema_version"}:
            found.append((str(file), partial(_microduck, file, manifest, model)))
    read: list[Annotation] = []
    for place, reader in found:
        try:
            read.append(reader())
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(
                f"{place} is not as its exporter writes it: {type(error).__name__}: {error}"
            ) from error
    return read


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
        return [name for name in metadata.get(key, "").split(",") if name]

    def numbers(key: str) -> list[float]:
        return [float(number) for number in names(key)]

    robot, terms = names("joint_names"), names("observation_names")
    for key, names_key in LENGTHS.items():
        count, expected = len(names(key)), len(names(names_key))
        if count and expected and count != expected:
            raise CheckpointError(f"{place}: {names_key} has {expected} entries, {key} has {count}")
    joints = list(joint_order) or (robot if len(robot) == size else [])
    if robot and not set(joints) <= set(robot):
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
    if "action_scale" in metadata and "default_joint_pos" in metadata and robot and clause in ("", "joint_pos"):
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
    unknown = (None,) * len(robot)
    return Annotation(
        place,
        joints=tuple(joints),
        terms=tuple(
            Term(name, name, None, tuple(robot), unknown, scale[0] if len(scale) == 1 else scale, max(1, int(history)))
            for name, scale, history in zip(terms, scales or [[1.0]] * len(terms), histories, strict=True)
        ),
        gains={key: numbers(key) for key in ("joint_stiffness", "joint_damping")},
        left_out=f"its action is a {clause}" if clause else "",
        **moved,
    )


def _descriptors(file: Path) -> Annotation:
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
    step = (described.get("scene") or {}).get("dt")
    robot: Mapping[str, Any] = next(iter((described.get("articulations") or {}).values()), {})
    return Annotation(
        str(file),
        control_rate_hz=1.0 / step if step else None,
        terms=tuple(_described_term(term) for term in group),
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
        for key, default in (("scale", 1.0), ("offset", 0.0)):
            given = term.get(key)
            moved[key] += _each(str(file), key, default if given is None else given, size)
        moved["clip"] += term.get("clip") or [[-np.inf, np.inf]] * size
    return {key: _tuples(values) for key, values in moved.items()}


def _described_term(term: Mapping[str, Any]) -> Term:
    overloads = term.get("overloads") or {}
    joints = tuple(term.get("joint_names") or ())
    offsets = term.get("joint_pos_offsets", term.get("joint_vel_offsets")) or [0.0] * len(joints)
    kind = re.split(r"[.:]", str(term["full_path"]))[-1]
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
        joints = [joint_order[i] for i in term["joint_ids"]] if term.get("joint_ids") and joint_order else joint_order
        actions.append((name, list(joints), len(term["scale"]), term))
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


def _policy_package(file: Path, manifest: Mapping[str, Any]) -> Annotation:
    """physicalai/inference/manifest.py, also LeRobot's: the processors around the model are not in the graph."""
    model = manifest.get("model") or {}
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
