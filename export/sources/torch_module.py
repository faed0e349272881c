"""Source of a torch module in memory: the user gives what a checkpoint would hold."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from numpy.typing import NDArray

from rlservo.bundle.scores import Q_VALUES
from rlservo.errors import UnsupportedError, UsageError
from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.recipe.recipe import Affine, Mode, Recipe, StateLeaf
from rlservo.export.recipe.trees import map_tree, space_leaves
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source

if TYPE_CHECKING:
    from torch import Tensor, nn

    from rlservo.export.sources.restored_policy import ElementNames, RestoredPolicy

ACTIONS = (Box, Discrete, MultiDiscrete)


@dataclass(frozen=True)
class ModuleFiles:
    """A module in place of a checkpoint's files."""

    module: nn.Module
    module_id: str = "default_policy"
    agent_id: str | None = None
    is_one_of_several: bool = False

    @property
    def root(self) -> Path:
        return Path(type(self.module).__name__)

    def sha256(self) -> str:
        """Return a hash over the weights' names and values."""
        digest = hashlib.sha256()
        for name, weights in self.module.state_dict().items():
            digest.update(name.encode() + b"\0")
            digest.update(np.ascontiguousarray(weights.detach().cpu().numpy()).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class ModuleSpec:
    """A user's description of a module (`rlservo.export_policy`)."""

    observation_space: Any
    action_space: Any
    scale: float | NDArray[Any] | None
    offset: float | NDArray[Any] | None
    clip: bool
    state: Mapping[str, NDArray[Any]]
    elements: ElementNames
    facts: CheckpointFacts


class TorchModule(Source):
    """One module; it detects no path."""

    name = "torch"
    framework = "torch"
    distribution = "torch"
    extra = "export"
    expects = "a module given to rlservo.export_policy"
    reference = (
        "the torch module's own forward pass in evaluation mode, then the scale, offset and clip that were given"
    )

    def __init__(self, spec: ModuleSpec) -> None:
        self._spec = spec

    def detects(self, path: Path) -> bool:  # noqa: ARG002
        return False

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        raise NotImplementedError("a module has no files")

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002
        return ""

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        return self._spec.facts

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:  # noqa: ARG002
        from rlservo.export.sources.torch_policy import TorchPolicy, notify_mode, restored, second

        assert isinstance(files, ModuleFiles)
        spec, what = self._spec, type(files.module).__name__
        _check_module(files.module)
        _check_spaces(spec)
        traced, acting = (second(files.module, what).cpu().eval() for _ in range(2))
        mode: Mode = "given" if isinstance(spec.action_space, Box) else "argmax"
        recipe = Recipe(
            spec.observation_space,
            spec.action_space,
            (),
            mode,
            "clip" if spec.clip and mode == "given" else "none",
            None,
            tuple(StateLeaf(name, initial) for name, initial in spec.state.items()),
            affine=_affine(spec),
        )
        names = () if mode == "given" else (Q_VALUES,)
        policy = TorchPolicy(
            recipe, traced, partial(_act, spec), lambda: partial(_act_single, spec, acting), names, partial(_send, spec)
        )
        made = restored(policy, spec.elements, what)
        if any(part.training for part in files.module.modules()):
            notify_mode(policy, second(files.module, what).cpu(), notify)
        return made


def _act(spec: ModuleSpec, module: nn.Module, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
    """Return the module's output and its next state."""
    outputs = module(obs, *state)
    first, after = (outputs[0], list(outputs[1:])) if isinstance(outputs, tuple) else (outputs, [])
    if len(after) != len(spec.state):
        raise ValueError(f"it gives {len(after)} tensors of state, {len(spec.state)} were named ({list(spec.state)})")
    return first, after


def _act_single(spec: ModuleSpec, module: nn.Module, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
    """Return what the module gives for an environment's observation, its floating-point numbers in single precision."""
    return _act(spec, module, map_tree(lambda leaf: leaf.float() if leaf.is_floating_point() else leaf, obs), state)


def _send(spec: ModuleSpec, action: NDArray[Any]) -> NDArray[Any]:
    """Return `action * scale + offset`, clipped, by the user's own numbers."""
    if spec.scale is not None:
        action = action * np.asarray(spec.scale, np.float32)
    if spec.offset is not None:
        action = action + np.asarray(spec.offset, np.float32)
    return np.asarray(np.clip(action, spec.action_space.low, spec.action_space.high) if spec.clip else action)


def _affine(spec: ModuleSpec) -> Affine | None:
    if spec.scale is None and spec.offset is None:
        return None
    if not isinstance(spec.action_space, Box):
        raise UsageError(f"scale and offset are for a Box of actions, got {spec.action_space}")
    sides = []
    for name, given, default in (("scale", spec.scale, 1.0), ("offset", spec.offset, 0.0)):
        values = np.asarray(default if given is None else given, np.float32)
        try:
            sides.append(np.ascontiguousarray(np.broadcast_to(values, spec.action_space.shape)))
        except ValueError:
            raise UsageError(
                f"{name} has shape {values.shape}, but the action has {spec.action_space.shape}: expected one number, "
                "or one for each element"
            ) from None
        if not np.isfinite(values).all():
            raise UsageError(f"{name} is not finite: {values}")
    return Affine(sides[0], sides[1])


def _check_module(module: Any) -> None:
    """Raise an error for what is not a torch module that can be traced."""
    import torch

    if not isinstance(module, torch.nn.Module):
        raise UsageError(f"a {type(module).__name__} is not a torch module: expected a torch.nn.Module")
    if any(isinstance(part, torch.jit.ScriptModule) for part in module.modules()):
        raise UnsupportedError(
            f"{type(module).__name__} is or holds a TorchScript module, which is not exported again: give the "
            "torch.nn.Module that it was scripted or traced from"
        )
    for name, weights in module.state_dict().items():
        if not isinstance(weights, torch.Tensor) or weights.is_quantized:
            raise UnsupportedError(
                f"{type(module).__name__}: '{name}' is of a quantized layer, which is not exported: give the module as "
                "it was before"
            )


def _check_spaces(spec: ModuleSpec) -> None:
    """Raise UsageError for spaces or names that no bundle has."""
    if not isinstance(spec.observation_space, Box | Discrete | MultiDiscrete | MultiBinary | Dict | Tuple):
        raise UsageError(f"the observation space {spec.observation_space!r} is not exported: it has no fixed shape")
    if not isinstance(spec.action_space, ACTIONS):
        raise UsageError(f"the action space {spec.action_space!r} is not exported: expected a Box, Discrete or "
                         "MultiDiscrete")  # fmt: skip
    if isinstance(spec.action_space, MultiDiscrete) and spec.action_space.nvec.ndim != 1:
        raise UsageError(f"the action space {spec.action_space} is not exported: only one-dimensional ones are")
    starts = np.asarray(getattr(spec.action_space, "start", 0))
    if (starts != 0).any():
        raise UsageError(
            f"the action space {spec.action_space} does not start at 0: the module's scores choose from 0 on; give the "
            "space without its start, and add it to the action"
        )
    for name, space in (*space_leaves(spec.observation_space, "obs").items(), ("action", spec.action_space)):
        if isinstance(space, Box) and np.dtype(space.dtype).kind == "f" and space.dtype not in (np.float32, np.float64):
            raise UsageError(f"{name}: {space} is not exported: of floating-point spaces only float32 and float64 are")
    for name, space, elements in (
        ("observation", spec.observation_space, spec.elements.observation),
        ("action", spec.action_space, spec.elements.action),
    ):
        size = int(np.prod(space.shape)) if space.shape is not None else 0
        if elements and len(elements) != size:
            raise UsageError(f"{len(elements)} {name} names were given, but the space has {size} elements")
