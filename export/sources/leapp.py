"""Source of LEAPP bundles: a YAML of stages, their inputs and outputs, and a model for each: TorchScript or ONNX.

Stages are chained by the YAML's data flow; what an input keeps from step to step is the policy's state, whose first
values are in a safetensors file. Kinds, element names and units become the contract's.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.bundle.spaces import Element
from rlservo.errors import CheckpointError, UnsupportedError, first_line
from rlservo.export.checkpoints.unpickle import explain
from rlservo.export.recipe.recipe import Recipe, StateLeaf
from rlservo.export.sources.leapp_description import (
    Description,
    StageTensor,
    describe,
    empty_gains,
    leaf_names,
    space,
    without_units,
)
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy

if TYPE_CHECKING:
    from torch import Tensor

    from rlservo.export.sources.restored_policy import RestoredPolicy

STATE_TYPES = ("float32", "float64", "int32", "int64", "bool")
PARTS = ("models:", "pipeline:", "system information:")


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
        files = describe(found[0]).files
        if missing := [file.name for file in files if not file.is_file()]:
            raise CheckpointError(f"{found[0]} is incomplete: {', '.join(missing)} is not beside it")
        return one_policy(found[0], files, module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""  # YAML, TorchScript, ONNX and safetensors hold no pickled objects

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:  # noqa: ARG002
        return _restore(describe(files.root), notify)


def _descriptions(path: Path) -> list[Path]:
    files = sorted(path.glob("*.yaml")) if path.is_dir() else [path] if path.suffix == ".yaml" else []
    texts = {file: file.read_text("utf-8", errors="replace") for file in files if file.is_file()}
    return [file for file, text in texts.items() if all(re.search(f"^{part}", text, re.M) for part in PARTS)]


def _restore(description: Description, notify: Notify) -> RestoredPolicy:
    from rlservo.export.sources.leapp_pipeline import Pipeline
    from rlservo.export.sources.leapp_replay import StageReplay
    from rlservo.export.sources.restored_policy import ElementNames, RestoredPolicy

    file = description.file
    observations, actions = space(file, description.given), space(file, description.results, action=True)
    start = partial(_manager, file)
    start()  # it checks the hashes and the connections
    first = _first_values(description)
    try:
        with warnings.catch_warnings():
            _ignore_deprecation()
            network = Pipeline(description, first)
    except UnsupportedError as error:
        error.prefix(str(file))
        raise
    except Exception as error:  # a stage raises anything
        raise CheckpointError(
            f"{file}: its stages do not run on tensors as it describes them: {first_line(error)}"
        ) from error
    carried, _ = description.carried()
    state = tuple(StateLeaf(_state_name(t), first[t.key].reshape(t.row).numpy()) for t in carried)
    for gains in empty_gains(description, network.constants):
        notify(
            f"{file}: {gains}: some exporters write this for gains they do not know; check it before a robot uses it"
        )
    if joints := without_units(description):
        notify(
            f"{file}: LEAPP does not say whether a joint turns or slides, so {', '.join(joints)} get no unit; "
            "TensorSemantics takes extra={'units': 'rad'}, or a list of one for each element"
        )
    given, results = leaf_names(description.given, "obs"), leaf_names(description.results, "action")
    states = {f"state_out.{_state_name(tensor)}": tensor for tensor in carried}
    rate = description.configs.get("frequency")
    return RestoredPolicy(
        Recipe(observations, actions, (), "given", "none", None, state),
        network,
        "leapp.InferenceManager",
        lambda: StageReplay(start, given, results, states),
        elements=ElementNames(_elements(given), _elements(results), float(rate) if rate else None),
        one_by_one=network.one_by_one,
    )


def _manager(file: Path) -> Any:
    from leapp import InferenceManager

    try:
        with warnings.catch_warnings():
            _ignore_deprecation()
            return InferenceManager(str(file))
    except Exception as error:  # LEAPP, torch, onnxruntime and safetensors raise several unrelated types
        raise CheckpointError(f"{file} cannot be loaded by LEAPP: {explain(error)}") from error


def _ignore_deprecation() -> None:
    warnings.filterwarnings("ignore", r"`torch\.jit\.\w+` is (deprecated|not supported)", DeprecationWarning)


def _first_values(description: Description) -> dict[str, Tensor]:
    """Return the values that inputs begin with, of all that keep one or that nothing writes to."""
    import torch
    from safetensors.torch import load_file

    saved = load_file(description.initial) if description.initial else {}
    values: dict[str, Tensor] = {}
    for tensor in (each for kind in description.carried() for each in kind):
        kind = getattr(torch, tensor.dtype, None)
        if tensor.dtype not in STATE_TYPES:
            raise UnsupportedError(
                f"{description.file}: the input {tensor.key} is {tensor.dtype}, which numpy does not have"
            )
        values[tensor.key] = saved.get(tensor.key, torch.zeros(tensor.shape, dtype=kind))
        if values[tensor.key].shape != tensor.shape or values[tensor.key].dtype != kind:
            raise CheckpointError(f"{description.initial}: {tensor.key} is not {tensor.dtype} {list(tensor.shape)}")
    return values


def _state_name(tensor: StageTensor) -> str:
    return tensor.key.replace("/", ".")


def _elements(tensors: Mapping[str, StageTensor]) -> dict[str, tuple[Element, ...]]:
    return {name: tensor.elements for name, tensor in tensors.items()}
