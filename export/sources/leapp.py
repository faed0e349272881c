"""Source of LEAPP bundles: a YAML of stages, their inputs and outputs, and a model for each: TorchScript or ONNX.

Stages are chained by the YAML's data flow; tensors that flow back are the policy's state, whose first values are in a
safetensors file. Kinds and element names become the contract's names and units.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Dict

from rlservo.export.checkpoints.unpickle import explain
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.contract.spaces import Element
from rlservo.export.recipe.recipe import Recipe, StateLeaf
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from torch import Tensor

    from rlservo.export.sources.restored_policy import RestoredPolicy

PARTS = ("models:", "pipeline:", "system information:")
UNITS = (
    ("joint/position", "rad"), ("joint/velocity", "rad/s"), ("joint/effort", "N*m"), ("joint/torques", "N*m"),
    ("linear_acceleration", "m/s^2"), ("angular_acceleration", "rad/s^2"), ("linear_velocity", "m/s"),
    ("angular_velocity", "rad/s"), ("body/position", "m"),
)  # fmt: skip
"""The end of a tensor's kind, and the SI unit that LEAPP means by it."""


class Leapp(Source):
    """Bundles that leapp.compile_graph wrote."""

    name = "leapp"
    framework = "LEAPP"
    distribution = "leapp"
    extra = "leapp"
    packages = ("leapp", "safetensors")
    expects = "the YAML that leapp.compile_graph wrote, or its folder"
    reference = "LEAPP's own replay, InferenceManager.run_policy, one observation at a time"

    def detects(self, path: Path) -> bool:
        return len(_descriptions(path)) == 1

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        given = path.expanduser().absolute()
        found = _descriptions(given)
        if len(found) != 1:
            raise CheckpointError(f"{given} holds {len(found)} bundles of LEAPP: expected {self.expects}")
        described = _read(found[0])
        names = [_parameters(found[0], name, model)["model_path"] for name, model in described["models"].items()]
        names += [described["pipeline"]["initial_values"]] if described["pipeline"].get("initial_values") else []
        files = [found[0], *(found[0].with_name(str(name)) for name in names)]
        if missing := [file.name for file in files if not file.is_file()]:
            raise CheckpointError(f"{found[0]} is incomplete: {', '.join(missing)} is not beside it")
        return one_policy(found[0], files, module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""  # YAML, TorchScript, ONNX and safetensors hold no pickled objects

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:  # noqa: ARG002
        return _restore(files.root)


def _descriptions(path: Path) -> list[Path]:
    files = sorted(path.glob("*.yaml")) if path.is_dir() else [path] if path.suffix == ".yaml" else []
    texts = {file: file.read_text("utf-8", errors="replace") for file in files if file.is_file()}
    return [file for file, text in texts.items() if all(re.search(f"^{part}", text, re.M) for part in PARTS)]


def _read(file: Path) -> dict[str, Any]:
    from rlservo.export.sources.isaac_env import read_yaml

    described = read_yaml(file)
    for part, wanted in (("models", dict), ("pipeline", dict)):
        if not isinstance(described.get(part), wanted):
            raise CheckpointError(f"{file}: expected a mapping '{part}'")
    return described


def _parameters(file: Path, name: str, model: Mapping[str, Any]) -> Mapping[str, Any]:
    parameters = model.get("parameters") or {}
    if parameters.get("backend") not in ("jit", "onnx"):
        raise UnsupportedError(
            f"{file}: stage '{name}' uses the backend {parameters.get('backend')!r}: only TorchScript and ONNX can be "
            "traced; export it with export_with='jit-trace'"
        )
    return dict(parameters)


class _Tensor:
    """One input or output of a stage as the YAML describes it."""

    def __init__(self, file: Path, stage: str, described: Mapping[str, Any]) -> None:
        self.key = f"{stage}/{described['name']}"
        shape = described["shape"]
        self.shape: tuple[int, ...] = tuple(json.loads(shape) if isinstance(shape, str) else shape)
        if not self.shape or self.shape[0] != 1:
            raise UnsupportedError(f"{file}: {self.key} has shape {list(self.shape)}: expected 1 for the batch, first")
        self.dtype = str(described["dtype"])
        kind = str(described.get("kind") or "")
        unit = next((unit for end, unit in UNITS if kind.endswith(end)), "")
        names = described.get("element_names") or []
        while len(names) == 1 and isinstance(names[0], list):
            names = names[0]
        self.elements: tuple[Element, ...] = ()
        if len(names) == int(np.prod(self.shape)) and all(isinstance(name, str) for name in names):
            self.elements = tuple(Element(name=name, unit=unit) for name in names)

    def space(self, file: Path) -> Box:
        if self.dtype not in ("float32", "float64"):
            raise UnsupportedError(f"{file}: {self.key} is {self.dtype}: only floating-point tensors are exported")
        return Box(-np.inf, np.inf, self.shape[1:], np.float32 if self.dtype == "float32" else np.float64)


def _restore(file: Path) -> RestoredPolicy:
    import torch
    from leapp import InferenceManager
    from safetensors.torch import load_file

    from rlservo.export.sources.restored_policy import ElementNames
    from rlservo.export.sources.torch_policy import TorchPolicy, restored

    described = _read(file)
    models, pipeline = described["models"], described["pipeline"]
    inputs = {t.key: t for name, model in models.items() for t in _tensors(file, name, model["inputs"])}
    outputs = {t.key: t for name, model in models.items() for t in _tensors(file, name, model["outputs"])}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`torch\.jit\.\w+` is deprecated", DeprecationWarning)
            manager = InferenceManager(str(file))  # it checks the hashes and the connections
            stages = torch.nn.ModuleList([_stage(file, model) for model in models.values()])
        initial = load_file(file.with_name(pipeline["initial_values"])) if pipeline.get("initial_values") else {}
    except UnsupportedError:
        raise
    except Exception as error:  # LEAPP, torch and safetensors raise several unrelated types
        raise CheckpointError(f"{file} cannot be loaded by LEAPP: {explain(error)}") from error
    seen = _named({key: inputs[key] for key in manager.inputs})
    given = _named({key: outputs[key] for key in manager.outputs})
    feedback = list(manager.feedback_inputs)
    zeros = {key: np.zeros(inputs[key].shape[1:], inputs[key].dtype) for key in feedback}
    state = tuple(
        StateLeaf(key.replace("/", "."), initial[key][0].numpy() if key in initial else zeros[key]) for key in feedback
    )
    recipe = Recipe(_space(file, seen), _space(file, given), (), "given", "none", None, state)
    flows: dict[str, list[str]] = {}
    for part in ("data_flow", "feedback_flow"):
        for source, targets in (pipeline.get(part) or {}).items():
            flows.setdefault(source, []).extend(targets)

    def act(stages: Any, obs: Any, before: list[Tensor]) -> tuple[Any, list[Tensor]]:
        values = {tensor.key: obs if name is None else obs[name] for name, tensor in seen.items()}
        values.update(zip(feedback, before, strict=True))
        for (name, model), stage in zip(models.items(), stages, strict=True):
            results = stage(*(values[f"{name}/{each['name']}"] for each in model["inputs"]))
            results = results if isinstance(results, tuple) else (results,)
            for each, result in zip(model["outputs"], results, strict=True):
                key = f"{name}/{each['name']}"
                values[f"={key}"] = result
                values.update(dict.fromkeys(flows.get(key, ()), result))
        return _tree({name: values[f"={tensor.key}"] for name, tensor in given.items()}), [values[k] for k in feedback]

    def replay(obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        actions: list[dict[str, Tensor]] = []
        after: list[list[Tensor]] = []
        for row in range(len(next(iter(obs.values())) if isinstance(obs, dict) else obs)):
            for key, leaf in zip(feedback, state, strict=True):
                stage, _, name = key.partition("/")
                manager.set_input_value(stage, name, leaf[row : row + 1])
            one = {t.key: (obs if part is None else obs[part])[row : row + 1] for part, t in seen.items()}
            actions.append({key: value.clone() for key, value in manager.run_policy(one).items()})
            after.append([manager.value_dict[key.split("/")[0]][key.split("/")[1]].clone() for key in feedback])
        tree = {name: torch.cat([each[tensor.key] for each in actions]) for name, tensor in given.items()}
        return _tree(tree), [torch.cat([each[number] for each in after]) for number in range(len(feedback))]

    rate = (pipeline.get("configs") or {}).get("frequency")
    names = ElementNames(_elements(seen, "obs"), _elements(given, "action"), float(rate) if rate else None)
    return restored(TorchPolicy(recipe, stages, act, lambda: replay), names, str(file), "leapp.InferenceManager")


def _stage(file: Path, model: Mapping[str, Any]) -> Any:
    import torch

    parameters = model["parameters"]
    path = file.with_name(parameters["model_path"])
    if parameters["backend"] == "jit":
        return torch.jit.load(str(path))  # type: ignore[no-untyped-call]
    from rlservo.export.sources.onnx_stage import OnnxStage

    return OnnxStage(path, *([each["name"] for each in model[side]] for side in ("inputs", "outputs")))


def _tensors(file: Path, stage: str, described: Any) -> list[_Tensor]:
    return [_Tensor(file, stage, each) for each in described]


def _named(tensors: Mapping[str, _Tensor]) -> dict[str | None, _Tensor]:
    """Return the tensors by their name in a Dict space; None if there is only one, which needs no Dict."""
    if len(tensors) == 1:
        return {None: next(iter(tensors.values()))}
    short = [key.partition("/")[2] for key in tensors]
    names = short if len(set(short)) == len(short) else [key.replace("/", ".") for key in tensors]
    return dict(zip(names, tensors.values(), strict=True))


def _space(file: Path, tensors: Mapping[str | None, _Tensor]) -> Any:
    spaces = {name: tensor.space(file) for name, tensor in tensors.items()}
    return spaces[None] if None in spaces else Dict({str(name): space for name, space in spaces.items()})


def _tree(values: Mapping[str | None, Tensor]) -> Any:
    return values[None] if None in values else dict(values)


def _elements(tensors: Mapping[str | None, _Tensor], root: str) -> dict[str, tuple[Element, ...]]:
    return {root if name is None else f"{root}.{name}": tensor.elements for name, tensor in tensors.items()}
