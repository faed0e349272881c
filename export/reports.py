"""`rlservo inspect`: a contract as tables."""

from __future__ import annotations

import itertools
import resource
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from rlservo.bundle.contract import BakedStep, Contract, Evaluation, Parity, StateSpec
from rlservo.bundle.spaces import DiscreteSpec, LeafSpec, SpaceSpec, leaf_specs

MANY = 64  # elements shown one by one; if there are more, only the first and the last few
ENDS = 8
CHANGING = ("logarithm", "sine_and_cosine", "user_connector")  # steps that change which elements there are


def contract_report(contract: Contract) -> RenderableType:
    """Return the whole contract as text: inputs, baked-in steps, outputs and proof."""
    parts: list[RenderableType] = [
        _summary(contract),
        *_space_tables("Goes in: observation", "obs", contract.observation_space, _filters(contract)),
        _baked_table(contract.baked_in),
        *_space_tables("Comes out: action", "action", contract.action_space, {}),
        *([_state_table(contract.state)] if contract.state else []),
        _tensor_table(contract),
        _proof(contract.parity),
    ]
    if contract.evaluations:
        parts.append(_evaluation_table(contract.evaluations))
    return Group(*(item for part in parts for item in (part, Text(""))))


def export_report(contract: Contract) -> Text:
    """Return the same in a few lines, for the end of an export."""
    observation, action = contract.observation_space, contract.action_space
    differences = ", ".join(f"{name} {result.max_rel:.1e}" for name, result in contract.parity.formats.items())
    rate = f" at {contract.control_rate_hz:g} Hz" if contract.control_rate_hz else ""
    outcome = f"one of {action.n} actions" if isinstance(action, DiscreteSpec) else f"{action.size} action elements"
    if contract.state:
        outcome += f", remembering {', '.join(state.name for state in contract.state)}"
    frozen = next((step for step in contract.baked_in if step.step == "mean_std_filter"), None)
    steps = contract.provenance.env_steps
    trained = f"; training took {steps:,} environment steps" if steps is not None else ""
    seen = f"filter    statistics of {frozen.values['count']:,} observations{trained}\n" if frozen else ""
    framework = contract.provenance.framework.rpartition(" ")[0] or "RLlib"
    if contract.provenance.source == "onnx":
        framework += " on the given file (taken as given: no trainer was asked)"
    unreached = contract.parity.unreached
    unproven = f"\nunproven  never reached by a sample: {'; '.join(unreached)}" if unreached else ""
    return Text(
        f"policy    {contract.name} version {contract.version}\n"
        f"graph     {observation.size} observation elements to {outcome}{rate}\n"
        f"baked in  {', '.join(step.step for step in contract.baked_in)}\n"
        f"{seen}proven    {contract.parity.samples:,} observations; largest relative difference to {framework}: "
        f"{differences}{unproven}"
    )


def peak_memory_mb() -> float:
    """Return the most memory this process has held so far [MB]."""
    # Linux counts in KiB, macOS in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def verification_report(parity: Parity, evaluation: Evaluation | None) -> RenderableType:
    """Return the result of `rlservo verify`: the parity and, if episodes were run, both sides of the closed loop."""
    parts: list[RenderableType] = [_proof(parity)]
    if evaluation is not None:
        parts.append(_evaluation_table([evaluation]))
    return Group(*parts)


def _summary(contract: Contract) -> Table:
    origin = contract.provenance
    table = Table(title=f"{contract.name} {contract.version}", title_justify="left", show_header=False, box=None)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    progress = [
        f"{count:,} {what}"
        for count, what in ((origin.training_iterations, "iterations"), (origin.env_steps, "environment steps"))
        if count is not None
    ]
    rate = f"{contract.control_rate_hz:g} Hz" if contract.control_rate_hz else "not known"
    stack = f" ({origin.api_stack} API stack)" if origin.api_stack else ""
    trainer = ", ".join(filter(None, [origin.framework, f"ray {origin.ray_version}" if origin.ray_version else ""]))
    rows = {
        "description": contract.description,
        "algorithm": f"{origin.algorithm}{stack}, module {origin.module_id}",
        "agents": ", ".join(origin.agents),
        "environment": origin.env_id or "not known",
        "environment arguments": ", ".join(f"{key}={value}" for key, value in origin.env_config.items()),
        "trained for": ", ".join(progress) or "not known",
        "control rate": rate,
        "explores by": _exploration(contract),
        "made with": f"{trainer}, torch {origin.torch_version}, rlservo {origin.rlservo_version}",
        "exported": origin.exported_at,
        "checkpoint sha256": origin.checkpoint_sha256,
    }
    for key, value in rows.items():
        if value:
            table.add_row(key, Text(value))
    return table


def _exploration(contract: Contract) -> str:
    if contract.distribution is None:
        return "nothing: this bundle has no action distribution"
    transform = {"none": "", "unsquash": ", then unsquashed and clipped", "clip": ", then clipped"}
    kind = contract.distribution.kind.replace("_", " ")
    if contract.distribution.kind == "multi":
        kind = "Gaussian for each box and a choice for each other part"
    return f"sampling a {kind}{transform[contract.distribution.transform]}"


def _space_tables(title: str, root: str, space: SpaceSpec, filters: Mapping[str, BakedStep]) -> list[RenderableType]:
    """Return one table of all leaves, then one of the elements of each leaf with more than bounds."""
    leaves = leaf_specs(space, root)
    detailed = [name for name, leaf in leaves.items() if leaf.elements or _seen(filters.get(name), leaf.size)[0]]
    parts: list[RenderableType] = []
    if len(leaves) > 1 or not detailed:
        parts.append(_overview(title if len(leaves) == 1 else f"{title}, in {len(leaves)} parts", leaves))
    parts += [_elements(title if len(leaves) == 1 else name, leaves[name], filters.get(name)) for name in detailed]
    return parts


def _table(
    title: str, *columns: str, right: Sequence[str] = (), fold: Sequence[str] = ()
) -> tuple[Table, RenderableType]:
    """Return (a table, renderable): the title is above it, or it would be wrapped to the table's width."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for column in columns:
        justify: JustifyMethod = "right" if column in right else "left"
        table.add_column(column, justify=justify, no_wrap=column not in fold, overflow="fold")
    return table, Group(Text(title, style="italic", overflow="fold"), table)


def _overview(title: str, leaves: Mapping[str, LeafSpec]) -> RenderableType:
    table, shown = _table(title, "name", "what", "type", "low", "high", right=("low", "high"), fold=("what",))
    for name, leaf in leaves.items():
        low, high = leaf.bounds()
        what = f"one of {leaf.n} choices" if isinstance(leaf, DiscreteSpec) else _count(leaf.size)
        if len(leaf.shape) > 1:
            what += f", {_shape(leaf.shape)}"
        table.add_row(name, what, leaf.dtype, _span(low), _span(high))
    return shown


def _count(size: int) -> str:
    return "1 number" if size == 1 else f"{size:,} numbers"


def _span(bound: NDArray[np.float64]) -> str:
    """Return one bound if all elements share it, else its range."""
    least, most = float(bound.min()), float(bound.max())
    return _number(least) if least == most else f"{_number(least)} .. {_number(most)}"


def _shape(shape: Sequence[int]) -> str:
    return "x".join(str(size) for size in shape) or "scalar"


def _elements(title: str, space: LeafSpec, frozen: BakedStep | None) -> RenderableType:
    """Return one row per element: index, name, unit, bounds and, behind a filter, its numbers."""
    kind = f"one of {space.n} choices" if isinstance(space, DiscreteSpec) else f"{_shape(space.shape)}, {space.dtype}"
    mean, std = _seen(frozen, space.size)
    named = ["name", "unit"] if space.elements else []
    seen = ["mean", "std"] if mean else []
    kind += "; mean and std are the filter's" if mean else ""
    columns = ["#", *named, "low", "high", *seen]
    table, shown = _table(f"{title} ({kind})", *columns, right=("#", "low", "high", *seen))
    low, high = (bound.ravel().tolist() for bound in space.bounds())
    for index in _shown(space.size):
        if index is None:
            table.add_row("...", *([f"{space.size - 2 * ENDS:,} more"] if named else []))
            continue
        element = [space.elements[index].name, space.elements[index].unit or "-"] if named else []
        row = [str(index), *element, _number(low[index]), _number(high[index])]
        table.add_row(*row, *([_number(mean[index]), _number(std[index])] if mean else []))
    return shown


def _state_table(state: Sequence[StateSpec]) -> RenderableType:
    table, shown = _table("Remembered from step to step", "name", "kind", "type", "shape", "at first")
    for one in state:
        start = _number(one.initial) if isinstance(one.initial, float) else "as in contract.json"
        table.add_row(one.name, one.kind.replace("_", " "), one.dtype, _shape(one.shape), start)
    return shown


def _shown(size: int) -> list[int | None]:
    if size <= MANY:
        return list(range(size))
    return [*range(ENDS), None, *range(size - ENDS, size)]


def _filters(contract: Contract) -> dict[str, BakedStep]:
    """Return the filter of each tensor, if it applies to the observation itself, not to another step's output."""
    before = itertools.takewhile(lambda step: step.step not in CHANGING, contract.baked_in)
    return {str(step.values.get("leaf", "obs")): step for step in before if step.step == "mean_std_filter"}


def _seen(frozen: BakedStep | None, size: int) -> tuple[Sequence[Any], Sequence[Any]]:
    """Return the filter's (mean, std) if they fit the observation, else two empty lists."""
    if frozen is None:
        return (), ()
    mean, std = frozen.values.get("mean"), frozen.values.get("std")
    fits = isinstance(mean, list) and isinstance(std, list) and len(mean) == len(std) == size
    return (mean, std) if fits and mean and std else ((), ())


def _number(value: Any) -> str:
    if value in (float("inf"), float("-inf")):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _baked_table(steps: Sequence[BakedStep]) -> RenderableType:
    table, shown = _table("Baked in, in this order", "#", "step", "what it does", right=("#",), fold=("what it does",))
    for number, step in enumerate(steps, start=1):
        table.add_row(str(number), step.step, Text(step.detail))
    return shown


def _tensor_table(contract: Contract) -> RenderableType:
    table, shown = _table("Tensors of the graph", "", "name", "type", "shape")
    for direction, tensors in (("in", contract.inputs), ("out", contract.outputs)):
        for tensor in tensors:
            shape = ", ".join("batch" if size == -1 else str(size) for size in tensor.shape)
            table.add_row(direction, tensor.name, tensor.dtype, Text(f"[{shape}]"))
    return shown


def _proof(parity: Parity) -> RenderableType:
    columns = ("largest difference", "relative")
    table, shown = _table("Proven", "format", *columns, right=columns)
    for name, result in parity.formats.items():
        table.add_row(name, f"{result.max_abs:.2e}", f"{result.max_rel:.2e}")
    sizes = ", ".join(str(size) for size in parity.batch_sizes)
    how = (
        f"{parity.samples:,} observations in batches of {sizes}, against {parity.reference}; "
        f"allowed: {parity.rtol:g} relative, {parity.atol:g} absolute"
    )
    if parity.rule:
        how += f" ({parity.rule})"
    return Group(shown, Text(how))


def _evaluation_table(evaluations: Sequence[Evaluation]) -> RenderableType:
    right = ("episodes", "first seed", "return", "success")
    title = "Closed loop on the same seeds: bundle / checkpoint"
    table, shown = _table(title, "environment", "disturbance", *right, right=right, fold=("environment", "disturbance"))
    for one in evaluations:
        table.add_row(
            one.env_id,
            one.disturbance or "-",
            str(one.episodes),
            str(one.first_seed),
            f"{one.return_bundle:.4g} / {'-' if one.return_checkpoint is None else f'{one.return_checkpoint:.4g}'}",
            f"{_rate(one.success_rate_bundle)} / {_rate(one.success_rate_checkpoint)}",
        )
    return shown


def _rate(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.1%}"
