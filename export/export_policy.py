"""`rlservo.export_policy`: turns a torch module in memory into a proven bundle."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.bundle.conventions import parse_elements
from rlservo.bundle.spaces import Element
from rlservo.errors import UsageError
from rlservo.export.checkpoints.facts import CheckpointFacts
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
    observation_names: Sequence[str | Mapping[str, Any]] = (),
    observation_units: Sequence[str] = (),
    action_names: Sequence[str | Mapping[str, Any]] = (),
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
    and units are given for each element in row-major order; in place of a name, a mapping says more, as an
    environment's `describe()` does (`{"name": "target_qw", "quantity": "quaternion", "axis": "w", "frame": "base"}`).
    The module itself is not changed.

    Raises UsageError for arguments that do not fit together, UnsupportedError for a module that cannot be traced or
    does not run on the space's observations, ParityError when the graph's results differ from the module's.
    """
    facts = CheckpointFacts(algorithm=algorithm)
    elements = ElementNames(
        _elements("observation", observation_names, observation_units),
        _elements("action", action_names, action_units),
        control_rate_hz,
    )
    initial = {name: _initial(name, values) for name, values in (state or {}).items()}
    spec = ModuleSpec(observation_space, action_space, scale, offset, clip, initial, elements, facts)
    options = ExportOptions(
        TorchModule(spec), Path(out), name, version, description, RestoreOptions(Path()), False, notify, progress
    )
    return export_files([ModuleFiles(module)], options, name)[0]


def _initial(name: str, values: ArrayLike) -> NDArray[Any]:
    given = np.asarray(values)
    if isinstance(values, np.ndarray | np.generic) and given.dtype != np.float32:
        raise UsageError(
            f"the state '{name}' is {given.dtype}: a bundle carries states as float32, so pass it, and return it from "
            "the module, as float32"
        )
    return given.astype(np.float32)


def _elements(which: str, names: Sequence[str | Mapping[str, Any]], units: Sequence[str]) -> tuple[Element, ...]:
    if units and len(units) != len(names):
        raise UsageError(f"{len(names)} {which} names and {len(units)} units were given: expected a unit for each name")
    described: list[Mapping[str, Any]] = [{"name": name} if isinstance(name, str) else name for name in names]
    try:
        return parse_elements(
            {**one, "unit": unit or one.get("unit", "")}
            for one, unit in zip(described, units or [""] * len(names), strict=True)
        )
    except ValueError as error:
        raise UsageError(f"{which}_names: {error}") from error
