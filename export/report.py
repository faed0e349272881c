"""`rlservo inspect`: a contract as tables a roboticist can read.

It lays out what the contract says and judges nothing. Needs rich; no torch, ray or onnxruntime.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rlservo.export.bundle import (
    BakedStep,
    Contract,
    DiscreteSpec,
    Element,
    Evaluation,
    LeafSpec,
    Parity,
    SpaceSpec,
    StateSpec,
    leaf_specs,
)

MANY = 64  # elements shown one by one; of more, the first and the last few
ENDS = 8


def contract_report(contract: Contract) -> RenderableType:
    """Return the whole contract: what it is, what goes in, what is baked in, what comes out, how it was proven."""
    parts: list[RenderableType] = [
        _summary(contract),
        *_space_tables("Goes in: observation", "obs", contract.observation_space, _filter(contract)),
        _baked_table(contract.baked_in),
        *_space_tables("Comes out: action", "action", contract.action_space, None),
        *([_state_table(contract.state)] if contract.state else []),
        _tensor_table(contract),
        _proof(contract.parity),
    ]
    if contract.evaluations:
        parts.append(_evaluation_table(contract.evaluations))
    return Group(*(item for part in parts for item in (part, Text(""))))


def export_report(contract: Contract) -> Text:
    """Return the same in four lines, for the end of an export."""
    observation, action = contract.observation_space, contract.action_space
    differences = ", ".join(f"{name} {result.max_rel:.1e}" for name, result in contract.parity.formats.items())
    rate = f" at {contract.control_rate_hz:g} Hz" if contract.control_rate_hz else ""
    outcome = f"one of {action.n} actions" if isinstance(action, DiscreteSpec) else f"{action.size} action elements"
    if contract.state:
        outcome += f", remembering {', '.join(state.name for state in contract.state)}"
    return Text(
        f"policy    {contract.name} version {contract.version}\n"
        f"graph     {observation.size} observation elements to {outcome}{rate}\n"
        f"baked in  {', '.join(step.step for step in contract.baked_in)}\n"
        f"proven    {contract.parity.samples:,} observations; largest relative difference to RLlib: {differences}"
    )


def peak_memory_mb() -> float:
    """Return the most memory this process has held so far [MB]."""
    # Linux counts in KiB, macOS in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def verification_report(parity: Parity, evaluation: Evaluation | None) -> RenderableType:
    """Return what `rlservo verify` found: the parity and, where episodes were run, both sides of the closed loop."""
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
    rows = {
        "description": contract.description,
        "algorithm": f"{origin.algorithm} ({origin.api_stack} API stack), module {origin.module_id}",
        "environment": origin.env_id or "not known",
        "environment arguments": ", ".join(f"{key}={value}" for key, value in origin.env_config.items()),
        "trained for": ", ".join(progress) or "not known",
        "control rate": rate,
        "explores by": _exploration(contract),
        "made with": f"ray {origin.ray_version}, torch {origin.torch_version}, rlservo {origin.rlservo_version}",
        "exported": origin.exported_at,
        "checkpoint sha256": origin.checkpoint_sha256,
    }
    for key, value in rows.items():
        if value:
            table.add_row(key, Text(value))
    return table


def _exploration(contract: Contract) -> str:
    if contract.distribution is None:
        return "nothing: this policy has no action distribution"
    transform = {"none": "", "unsquash": ", then unsquashed and clipped", "clip": ", then clipped"}
    kind = contract.distribution.kind.replace("_", " ")
    return f"sampling a {kind}{transform[contract.distribution.transform]}"


def _space_tables(title: str, root: str, space: SpaceSpec, frozen: BakedStep | None) -> list[Table]:
    leaves = leaf_specs(space, root)
    return [
        _space_table(title if len(leaves) == 1 else f"{title}, {name}", leaf, frozen) for name, leaf in leaves.items()
    ]


def _space_table(title: str, space: LeafSpec, frozen: BakedStep | None) -> Table:
    """Return one row an element: index, name, unit, bounds and, behind a filter, its numbers."""
    if isinstance(space, DiscreteSpec):
        table = Table(title=f"{title} (one of {space.n} choices)", title_justify="left")
        table.add_column("value", justify="right")
        table.add_column("name")
        table.add_row(
            f"{space.start} .. {space.start + space.n - 1}", space.elements[0].name if space.elements else "-"
        )
        return table
    shape = "x".join(str(size) for size in space.shape) or "scalar"
    table = Table(title=f"{title} ({shape}, {space.dtype})", title_justify="left")
    table.add_column("#", justify="right", no_wrap=True)
    table.add_column("name", overflow="fold")
    table.add_column("unit", no_wrap=True)
    table.add_column("low", justify="right", no_wrap=True)
    table.add_column("high", justify="right", no_wrap=True)
    mean, std = _seen(frozen, space.size)
    if mean:
        table.add_column("filter mean", justify="right", no_wrap=True)
        table.add_column("filter std", justify="right", no_wrap=True)
    low, high = (bound.ravel().tolist() for bound in space.bounds())
    for index in _shown(space.size):
        if index is None:
            table.add_row("...", f"{space.size - 2 * ENDS} more")
            continue
        element = space.elements[index] if space.elements else Element(name="-", unit="")
        row = [str(index), element.name, element.unit or "-", _number(low[index]), _number(high[index])]
        table.add_row(*row, *([_number(mean[index]), _number(std[index])] if mean else []))
    return table


def _state_table(state: Sequence[StateSpec]) -> Table:
    table = Table(title="Remembered from step to step", title_justify="left")
    for column in ("name", "kind", "type", "shape", "at an episode's start"):
        table.add_column(column, overflow="fold")
    for one in state:
        shape = "x".join(str(size) for size in one.shape) or "scalar"
        start = _number(one.initial) if isinstance(one.initial, float) else "as in contract.json"
        table.add_row(one.name, one.kind.replace("_", " "), one.dtype, shape, start)
    return table


def _shown(size: int) -> list[int | None]:
    if size <= MANY:
        return list(range(size))
    return [*range(ENDS), None, *range(size - ENDS, size)]


def _filter(contract: Contract) -> BakedStep | None:
    return next((step for step in contract.baked_in if step.step == "mean_std_filter"), None)


def _seen(frozen: BakedStep | None, size: int) -> tuple[Sequence[Any], Sequence[Any]]:
    """Return the filter's (mean, std) where they fit the observation, else two empty lists."""
    if frozen is None:
        return (), ()
    mean, std = frozen.values.get("mean"), frozen.values.get("std")
    fits = isinstance(mean, list) and isinstance(std, list) and len(mean) == len(std) == size
    return (mean, std) if fits and mean and std else ((), ())


def _number(value: Any) -> str:
    if value in (float("inf"), float("-inf")):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _baked_table(steps: Sequence[BakedStep]) -> Table:
    table = Table(title="Baked in, in this order", title_justify="left")
    table.add_column("#", justify="right")
    table.add_column("step", no_wrap=True)
    table.add_column("what it does", overflow="fold")
    for number, step in enumerate(steps, start=1):
        table.add_row(str(number), step.step, Text(step.detail))
    return table


def _tensor_table(contract: Contract) -> Table:
    table = Table(title="Tensors of the graph", title_justify="left")
    for column in ("direction", "name", "type", "shape"):
        table.add_column(column, no_wrap=True)
    for direction, tensors in (("in", contract.inputs), ("out", contract.outputs)):
        for tensor in tensors:
            shape = ", ".join("batch" if size == -1 else str(size) for size in tensor.shape)
            table.add_row(direction, tensor.name, tensor.dtype, Text(f"[{shape}]"))
    return table


def _proof(parity: Parity) -> RenderableType:
    table = Table(title="Proven", title_justify="left")
    table.add_column("format", no_wrap=True)
    table.add_column("largest difference", justify="right", no_wrap=True)
    table.add_column("relative", justify="right", no_wrap=True)
    for name, result in parity.formats.items():
        table.add_row(name, f"{result.max_abs:.2e}", f"{result.max_rel:.2e}")
    sizes = ", ".join(str(size) for size in parity.batch_sizes)
    how = (
        f"{parity.samples:,} observations in batches of {sizes}, against {parity.reference}; "
        f"allowed: {parity.rtol:g} relative, {parity.atol:g} absolute"
    )
    return Group(table, Text(how))


def _evaluation_table(evaluations: Sequence[Evaluation]) -> Table:
    table = Table(title="Closed loop on the same seeds: bundle / checkpoint", title_justify="left")
    table.add_column("environment", overflow="fold")
    for column in ("episodes", "first seed", "return", "success"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in evaluations:
        table.add_row(
            one.env_id,
            str(one.episodes),
            str(one.first_seed),
            f"{one.return_bundle:.4g} / {one.return_checkpoint:.4g}",
            f"{_rate(one.success_rate_bundle)} / {_rate(one.success_rate_checkpoint)}",
        )
    return table


def _rate(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.1%}"
