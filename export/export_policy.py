"""`rlservo.export_policy`: turns a torch module in memory into a proven bundle."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.export.checkpoints.facts import CheckpointFacts
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.spaces import Element
from rlservo.export.export_checkpoint import ExportOptions, ExportResult, export_files, silent
from rlservo.export.sources.restored_policy import ElementNames
from rlservo.export.sources.source import Notify, RestoreOptions
from rlservo.export.sources.torch_module import ModuleFiles, ModuleSpec, TorchModule

if TYPE_CHECKING:
    from torch import nn

logger = logging.getLogger(__name__)


def export_policy(
    module: nn.Module,
    observation_space: Any,
    action_space: Any,
    out: str | Path,
    *,
    name: str,
    version: str | None = None,
    description: str = "",
    scale: float | NDArray[Any] | None = None,
    offset: float | NDArray[Any] | None = None,
    clip: bool = True,
    state: Mapping[str, ArrayLike] | None = None,
    observation_names: Sequence[str] = (),
    observation_units: Sequence[str] = (),
    action_names: Sequence[str] = (),
    action_units: Sequence[str] = (),
    control_rate_hz: float | None = None,
    algorithm: str = "unknown",
    notify: Notify = logger.warning,
    progress: Notify = silent,
) -> ExportResult:
    """Export a torch module to `out/<name>/<version>/`, proven against its own forward pass.

    The module takes an observation `[batch, *shape]` (for a Dict space a dict; floating-point numbers in single
    precision) and gives for a Box the action `[batch, *shape]`, for a Discrete or MultiDiscrete one score for each
    choice `[batch, n]`. The robot gets `action * scale + offset`, with `clip` clipped to the space's bounds. A
    recurrent module takes one tensor `[batch, ...]` for each entry of `state` after the observation, and returns a
    tuple of the action and the next ones; the entries are what an episode starts with, without the batch axis. Names
    and units are given for each element in row-major order. The module itself is not changed.

    Raises UsageError for arguments that do not fit together, UnsupportedError for a module that cannot be traced or
    does not run on the space's observations, ParityError when the graph's results differ from the module's.
    """
    facts = CheckpointFacts(algorithm=algorithm)
    elements = ElementNames(
        _elements("observation", observation_names, observation_units),
        _elements("action", action_names, action_units),
        control_rate_hz,
    )
    initial = {name: np.asarray(values, np.float32) for name, values in (state or {}).items()}
    spec = ModuleSpec(observation_space, action_space, scale, offset, clip, initial, elements, facts)
    options = ExportOptions(
        TorchModule(spec), Path(out), name, version, description, RestoreOptions(Path()), False, notify, progress
    )
    return export_files([ModuleFiles(module)], options, name)[0]


def _elements(which: str, names: Sequence[str], units: Sequence[str]) -> tuple[Element, ...]:
    if units and len(units) != len(names):
        raise UsageError(f"{len(names)} {which} names and {len(units)} units were given: expected a unit for each name")
    return tuple(Element(name=name, unit=unit) for name, unit in zip(names, units or [""] * len(names), strict=True))
