"""LEAPP's YAML: stages, their tensors, the edges between them, and what a person should know about them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from rlservo.bundle.spaces import Element
from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.sources.isaac_env import read_yaml

UNITS = (
    ("linear_acceleration", "m/s^2"), ("angular_acceleration", "rad/s^2"), ("linear_velocity", "m/s"),
    ("angular_velocity", "rad/s"), ("body/position", "m"),
)  # fmt: skip
"""The end of a tensor's kind, and its SI unit; LEAPP leaves open whether a joint turns (rad) or slides (m)."""
QUANTITIES = {
    "joint/position": "joint position", "joint/velocity": "joint velocity", "joint/effort": "joint effort",
    "joint/torques": "joint effort", "body/position": "position", "body/linear_velocity": "linear velocity",
    "body/angular_velocity": "angular velocity",
}  # fmt: skip
"""A tensor's kind after its first word (state, command, target), and the contract's quantity."""
GAINS = {"kp", "kd", "stiffness", "damping", "joint_stiffness", "joint_damping"}


@dataclass(frozen=True)
class StageTensor:
    """One input or output of a stage, as LEAPP describes it.

    A first axis of size 1 in front of others is the batch; a tensor without it is one row as it is.
    """

    key: str
    """Stage and name, `stage/name`."""
    shape: tuple[int, ...]
    dtype: str
    kind: str
    elements: tuple[Element, ...]
    extra: Mapping[str, Any] = field(compare=False)

    @property
    def name(self) -> str:
        """The name without its stage."""
        return self.key.partition("/")[2]

    @property
    def row(self) -> tuple[int, ...]:
        """The shape without the batch."""
        return self.shape[1:] if len(self.shape) > 1 and self.shape[0] == 1 else self.shape


@dataclass(frozen=True)
class LeappStage:
    """One model of the bundle."""

    name: str
    file: Path
    backend: str
    inputs: tuple[StageTensor, ...]
    outputs: tuple[StageTensor, ...]


@dataclass(frozen=True)
class Description:
    """A bundle; its stages run in their order, and a value stays until another is written over it."""

    file: Path
    stages: tuple[LeappStage, ...]
    given: Mapping[str | None, StageTensor]
    """What each step brings, by key of the observation; None if it is one tensor."""
    results: Mapping[str | None, StageTensor]
    """What each step answers, by key of the action."""
    flows: Mapping[str, tuple[str, ...]]
    """Outputs to the inputs they are written to."""
    initial: Path | None
    """The file of first values of inputs; the others begin with zeros."""
    configs: Mapping[str, Any]

    @property
    def files(self) -> list[Path]:
        """All files that decide what the policy does."""
        return [self.file, *(stage.file for stage in self.stages), *([self.initial] if self.initial else [])]

    def carried(self) -> tuple[list[StageTensor], list[StageTensor]]:
        """Return the inputs that keep a value of the step before, and those that nothing writes to."""
        written = {tensor.key for tensor in self.given.values()}
        early: list[StageTensor] = []
        for stage in self.stages:
            early += [tensor for tensor in stage.inputs if tensor.key not in written]
            written.update(target for tensor in stage.outputs for target in self.flows.get(tensor.key, ()))
        return [tensor for tensor in early if tensor.key in written], [t for t in early if t.key not in written]


def describe(file: Path) -> Description:
    """Read a bundle's YAML.

    Raises CheckpointError if it is not LEAPP's, UnsupportedError for models that cannot be traced.
    """
    described = read_yaml(file)
    try:
        return _described(file, described)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{file} is not as LEAPP writes it: {type(error).__name__}: {error}") from error


def _described(file: Path, described: Mapping[str, Any]) -> Description:
    models, pipeline = described["models"], described["pipeline"]
    stages = tuple(_stage(file, str(name), model) for name, model in models.items())
    tensors = {side: {t.key: t for stage in stages for t in getattr(stage, side)} for side in ("inputs", "outputs")}
    keys = {
        side: [f"{stage}/{name}" for stage, names in (pipeline[side] or {}).items() for name in names]
        for side in tensors
    }
    if not keys["inputs"] or not keys["outputs"]:
        none = "inputs" if not keys["inputs"] else "outputs"
        raise UnsupportedError(
            f"{file} has no {none}: all its {none} are connected to stages, so the policy would have no "
            f"{'observation' if none == 'inputs' else 'action'}; LEAPP leaves out what is fed back, so also return it "
            "as an output of its own"
        )
    flows: dict[str, tuple[str, ...]] = {}
    for part in ("data_flow", "feedback_flow"):
        for source, targets in (pipeline.get(part) or {}).items():
            flows[source] = (*flows.get(source, ()), *targets)
    initial = pipeline.get("initial_values")
    return Description(
        file,
        stages,
        _named([tensors["inputs"][key] for key in keys["inputs"]]),
        _named([tensors["outputs"][key] for key in keys["outputs"]]),
        flows,
        file.with_name(initial) if initial else None,
        pipeline.get("configs") or {},
    )


def _stage(file: Path, name: str, model: Mapping[str, Any]) -> LeappStage:
    parameters = model.get("parameters") or {}
    if count := parameters.get("warp_segments"):
        raise UnsupportedError(
            f"{file}: stage '{name}' has {count} Warp segments (the operator com.nvidia.warp::WrpRunner), which only "
            "LEAPP's own runtime library runs: export the stage without Warp"
        )
    if parameters.get("backend") not in ("jit", "onnx"):
        raise UnsupportedError(
            f"{file}: stage '{name}' uses the backend {parameters.get('backend')!r}: only TorchScript and ONNX can be "
            "traced; export it with export_with='jit-trace'"
        )
    sides = (tuple(_tensor(name, each) for each in model[side] or ()) for side in ("inputs", "outputs"))
    return LeappStage(name, file.with_name(str(parameters["model_path"])), parameters["backend"], *sides)


def _tensor(stage: str, described: Mapping[str, Any]) -> StageTensor:
    shape = described["shape"]
    sizes = tuple(int(size) for size in (json.loads(shape) if isinstance(shape, str) else shape))
    kind = str(described.get("kind") or "")
    return StageTensor(
        f"{stage}/{described['name']}", sizes, str(described["dtype"]), kind,
        _elements(kind, int(np.prod(sizes)), described), described,
    )  # fmt: skip


def _elements(kind: str, size: int, described: Mapping[str, Any]) -> tuple[Element, ...]:
    """Return the elements' names: those of the last axis, if the others have size 1; units and conventions."""
    names: Any = described.get("element_names") or []
    if names and isinstance(names[-1], list):
        names = names[-1]
    if len(names) != size or not all(isinstance(name, str) for name in names):
        return ()
    units = described.get("units") or next((unit for end, unit in UNITS if kind.endswith(end)), "")
    every = units if isinstance(units, list) and len(units) == size else [units] * size
    turns = list(names[3:]) if kind.endswith("/pose") and size == 7 else names if kind.endswith("/rotation") else []
    frame = str(described.get("frame") or "")
    return tuple(
        Element(name=name, unit=str(unit), **_conventions(kind, name, turns, frame))
        for name, unit in zip(names, every, strict=True)
    )


def _conventions(kind: str, name: str, turns: Sequence[str], frame: str) -> dict[str, Any]:
    """Return what a tensor's kind and an element's name say of the element.

    The betas of Isaac Lab 3.0 name a pose command's quaternion qw, qx, qy, qz, over numbers that are x, y, z, w
    (isaaclab/envs/mdp/commands/pose_command.py): that order is not believed.
    """
    if quantity := QUANTITIES.get(kind.partition("/")[2]):
        return {"quantity": quantity} | ({"joint": name} if quantity.startswith("joint") else _vector(name, frame))
    if name in turns and len(turns) == 4:
        axis = name[-1] if set(turns) in ({"qx", "qy", "qz", "qw"}, set("xyzw")) else ""
        doubtful = kind == "command/body/pose" and turns[0] == "qw"
        return {"quantity": "quaternion", "axis": "" if doubtful else axis, "frame": frame}
    if kind.endswith("/pose") and name in ("x", "y", "z"):
        return {"quantity": "position", "axis": name, "frame": frame}
    return {}


def _vector(name: str, frame: str) -> dict[str, Any]:
    axis = name[-1:] if re.fullmatch(r"(.*_)?[xyz]", name) else ""
    return {"axis": axis, "frame": frame}


def _named(tensors: Sequence[StageTensor]) -> dict[str | None, StageTensor]:
    """Return the tensors by their name in a Dict space; None if there is only one, which needs no Dict."""
    if len(tensors) == 1:
        return {None: tensors[0]}
    short = [tensor.name for tensor in tensors]
    names = short if len(set(short)) == len(short) else [tensor.key.replace("/", ".") for tensor in tensors]
    return dict(zip(names, tensors, strict=True))


def leaf_names(tensors: Mapping[str | None, StageTensor], root: str) -> dict[str, StageTensor]:
    """Return the tensors by the graph's names."""
    return {root if name is None else f"{root}.{name}": tensor for name, tensor in tensors.items()}


def space(file: Path, tensors: Mapping[str | None, StageTensor], *, action: bool = False) -> Any:
    """Return the tensors as a space. Raises UnsupportedError for types that a policy does not take or give."""
    spaces = {name: _box(file, tensor, action=action) for name, tensor in tensors.items()}
    return spaces[None] if None in spaces else Dict({str(name): box for name, box in spaces.items()})


def _box(file: Path, tensor: StageTensor, *, action: bool) -> Box:
    if tensor.dtype == "float64" and not action:
        raise UnsupportedError(
            f"{file}: the input {tensor.key} is float64: an exported policy sees observations in single precision, in "
            "which a large number loses digits; annotate it as float32 and convert it inside the stage if need be"
        )
    if tensor.dtype not in ("float32", "float64"):
        side = "output" if action else "input"
        raise UnsupportedError(
            f"{file}: the {side} {tensor.key} is {tensor.dtype}: only floating-point tensors are exported; annotate it "
            "as float32 and convert it inside the stage"
        )
    return Box(-np.inf, np.inf, tensor.row, np.dtype(tensor.dtype).type)


def without_units(description: Description) -> list[str]:
    """Return the tensors of joints whose units are unknown."""
    tensors = (*description.given.values(), *description.results.values())
    return [t.key for t in tensors if "joint/" in t.kind and not all(element.unit for element in t.elements)]


def empty_gains(description: Description, constants: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Yield a clause for each set of gains that is only 0, 1 or -0; `constants` are the outputs that never change."""
    found = {t.key: constants[t.key] for t in description.results.values() if t.kind in GAINS and t.key in constants}
    places = [("configs", description.configs)]
    places += [(t.key, t.extra) for stage in description.stages for t in (*stage.inputs, *stage.outputs)]
    found |= {f"{key} of {place}": values[key] for place, values in places for key in GAINS & values.keys()}
    for name, gains in found.items():
        if only := placeholders(gains):
            yield f"{name} is {only} for every joint"


def placeholders(gains: Any) -> str:
    """Return the numbers of gains that are only 0, 1 or -0, which some exporters write for unknown ones; else ''."""
    numbers = np.asarray(gains)
    if numbers.dtype.kind not in "iuf" or not numbers.size or not np.isin(numbers, (0, 1)).all():
        return ""
    return ", ".join(f"{number:g}" for number in np.unique(numbers))
