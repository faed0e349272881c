"""LEAPP's stages as one torch module for any number of rows.

LEAPP traces a stage with one row, and nothing says how it treats several: a constant stays one row, an LSTM's state
`[layers, 1, n]` has the batch elsewhere, a mean may be over all. The stages therefore get all rows at once only if that
gives what they give for each row alone, and if their graph joins no rows (`graph/joined_rows.py`); otherwise one row
after the other, in a loop that is part of the graph.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.errors import UnsupportedError
from rlservo.export.recipe.trees import Tree, tree_leaves
from rlservo.export.sources.leapp_description import Description, LeappStage, StageTensor
from rlservo.export.sources.onnx_stage import OnnxStage

PROBE_ROWS = 11
CRASHES = re.compile(r"aten::(quantized_)?(lstm|gru|rnn_tanh|rnn_relu)\(")
"""Operators that write out of bounds when a state has more rows than they were traced with (torch 2.13)."""


class Pipeline(nn.Module):
    """The network that is exported: observation and state `[batch, ...]` to the action's leaves and the next state."""

    names: tuple[str, ...] = ()

    def __init__(self, description: Description, first: Mapping[str, Tensor]) -> None:
        """`first` are the values that inputs begin with, of all that keep one or that nothing writes to.

        Raises UnsupportedError for a stage with a memory of its own.
        """
        super().__init__()
        carried, unfed = description.carried()
        takes = [*_in_order(description.given), *carried]
        gives = [*_in_order(description.results), *carried]
        self.module = nn.ModuleList(_load(stage) for stage in description.stages)
        answers = [*(f"={tensor.key}" for tensor in _in_order(description.results)), *(t.key for t in carried)]
        constants = {tensor.key: first[tensor.key] for tensor in unfed}
        step = _Step(description, self.module, [tensor.key for tensor in takes], answers, constants)
        step.eval().requires_grad_(False)
        rows, wanted = _probe(description, step, takes, gives, first)
        self.constants: dict[str, NDArray[Any]] = {
            tensor.key: value[0].numpy()
            for tensor, value in zip(gives, wanted, strict=True)
            if torch.equal(value, value[:1].expand_as(value))
        }
        """The outputs that no input changes."""
        self._one_by_one = partial(_OneByOne, step, takes, gives, rows)
        self.step = _at_once(step, takes, gives, rows, wanted) or self._one_by_one()

    def one_by_one(self) -> None:
        """Compute one row after the other."""
        self.step = self._one_by_one()

    def forward(self, obs: Tree, state: Sequence[Tensor] = ()) -> tuple[Tensor, ...]:
        results: tuple[Tensor, ...] = self.step(*tree_leaves(obs), *state)
        return results


def _in_order(tensors: Mapping[str | None, StageTensor]) -> list[StageTensor]:
    """Return the tensors in the order of a space's leaves."""
    return [tensors[name] for name in sorted(tensors, key=str)]


def _load(stage: LeappStage) -> Any:
    if stage.backend == "jit":
        return torch.jit.load(str(stage.file), map_location="cpu")  # type: ignore[no-untyped-call]
    return OnnxStage(stage.file)


def _probe(
    description: Description,
    step: nn.Module,
    takes: Sequence[StageTensor],
    gives: Sequence[StageTensor],
    first: Mapping[str, Tensor],
) -> tuple[list[Tensor], list[Tensor]]:
    """Return random rows and what the step gives for each of them alone."""
    numbers = np.random.default_rng(0)
    rows = [_draw(tensor, first.get(tensor.key), numbers) for tensor in takes]
    before = {name: buffer.clone() for name, buffer in step.named_buffers()}
    alone: list[list[Tensor]] = []
    with torch.no_grad():
        for row in range(PROBE_ROWS):
            results = step(*(values[row].reshape(tensor.shape) for values, tensor in zip(rows, takes, strict=True)))
            alone.append([value.reshape(tensor.row) for value, tensor in zip(results, gives, strict=True)])
    for name, buffer in step.named_buffers():
        if not torch.equal(buffer, before[name]):
            _, number, own = name.split(".", 2)
            raise UnsupportedError(
                f"stage '{description.stages[int(number)].name}' changes its own buffer '{own}' when it runs, and "
                "LEAPP restores no buffer at an episode's start: declare it with annotate.state_tensors and "
                "annotate.update_state"
            )
    return rows, [torch.stack(each) for each in zip(*alone, strict=True)]


def _draw(tensor: StageTensor, first: Tensor | None, numbers: np.random.Generator) -> Tensor:
    """Return random values of several magnitudes; integers stay what they begin with."""
    shape = (PROBE_ROWS, *tensor.row)
    begin = torch.zeros(shape) if first is None else first.reshape(tensor.row).expand(shape)
    if first is not None and not first.is_floating_point():
        return begin.clone()
    spread = 10.0 ** numbers.uniform(-1.0, 1.0, (PROBE_ROWS, *[1] * len(tensor.row)))
    return begin + torch.from_numpy(spread * numbers.standard_normal(shape)).to(begin.dtype)


def _at_once(
    step: nn.Module,
    takes: Sequence[StageTensor],
    gives: Sequence[StageTensor],
    rows: Sequence[Tensor],
    wanted: Sequence[Tensor],
) -> nn.Module | None:
    """Return the step of all rows at once, or None if it does not give what it gives for each alone."""
    scripts = [part for part in step.modules() if isinstance(part, torch.jit.ScriptModule)]
    if any(CRASHES.search(str(script.inlined_graph)) for script in scripts):
        return None
    layered = {tensor.key for tensor in takes if tensor in gives and len(tensor.shape) == 3 and tensor.shape[1] == 1}
    choices: list[set[str]] = [set(), layered] if layered else [set()]
    for layers in choices:
        try:
            with torch.no_grad():
                module = _AtOnce(step, takes, gives, layers, rows, wanted)
                results = module(*rows)
        except Exception:  # sizes of one row are in the stage
            continue
        same = (torch.allclose(a, b, 1e-4, 1e-5, equal_nan=True) for a, b in zip(results, wanted, strict=True))
        if all(same):
            return module
    return None


class _Step(nn.Module):
    """All stages once, in their order; a value stays until another is written over it."""

    def __init__(
        self,
        description: Description,
        stages: nn.ModuleList,
        takes: Sequence[str],
        answers: Sequence[str],
        constants: Mapping[str, Tensor],
    ) -> None:
        super().__init__()
        self.stages = stages
        self._description, self._takes, self._answers, self._constants = description, takes, answers, constants

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        values: dict[str, Tensor] = {**self._constants, **dict(zip(self._takes, given, strict=True))}
        for stage, module in zip(self._description.stages, self.stages, strict=True):
            results = module(*(values[tensor.key] for tensor in stage.inputs))
            results = results if isinstance(results, tuple | list) else (results,)
            for tensor, result in zip(stage.outputs, results, strict=True):
                values[f"={tensor.key}"] = result
                for name in self._description.flows.get(tensor.key, ()):
                    values[name] = result
        return tuple(values[name] for name in self._answers)


class _AtOnce(nn.Module):
    """A step of all rows at once."""

    def __init__(
        self,
        step: nn.Module,
        takes: Sequence[StageTensor],
        gives: Sequence[StageTensor],
        layered: Collection[str],
        rows: Sequence[Tensor],
        wanted: Sequence[Tensor],
    ) -> None:
        """`layered` are the states `[layers, batch, n]` of an LSTM or a GRU; the others have the batch first."""
        super().__init__()
        self.step = step
        self._takes, self._gives, self._layered = takes, gives, layered
        self._repeated = [False] * len(gives)
        shapes = [value.shape for value in self(*rows)]
        self._repeated = [shape != value.shape for shape, value in zip(shapes, wanted, strict=True)]

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        count = given[0].shape[0]
        values = (
            value.reshape(count, tensor.shape[0], -1).transpose(0, 1) if tensor.key in self._layered else value
            for value, tensor in zip(given, self._takes, strict=True)
        )
        return tuple(
            value.expand(count, *tensor.row)  # one row for all
            if repeated
            else value.transpose(0, 1).reshape(count, *tensor.row)
            if tensor.key in self._layered
            else value
            for value, tensor, repeated in zip(self.step(*values), self._gives, self._repeated, strict=True)
        )


class _OneByOne(nn.Module):
    """A step of one row after the other, each as one tensor of all its numbers."""

    def __init__(
        self, step: nn.Module, takes: Sequence[StageTensor], gives: Sequence[StageTensor], rows: Sequence[Tensor]
    ) -> None:
        super().__init__()
        self._gives = gives
        # Single precision, or what also holds integers and double precision.
        self._dtype = torch.float64 if {each.dtype for each in (*takes, *gives)} - {"float32"} else torch.float32
        self._dtypes = [getattr(torch, tensor.dtype) for tensor in gives]
        row = _OneRow(step, takes, self._dtype)
        example = torch.cat([values[0].reshape(-1).to(self._dtype) for values in rows])
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a stage always gets the sizes that the trace sees
            traced: Any = torch.jit.trace(row, (example,), check_trace=False)  # type: ignore[no-untyped-call]
            self.loop = torch.jit.script(_Loop(traced))

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        results = self.loop(torch.cat([value.reshape(value.shape[0], -1).to(self._dtype) for value in given], 1))
        parts = results.split([int(np.prod(tensor.row)) for tensor in self._gives], 1)
        return tuple(
            part.reshape(-1, *tensor.row).to(dtype)
            for part, tensor, dtype in zip(parts, self._gives, self._dtypes, strict=True)
        )


class _OneRow(nn.Module):
    """A step of one row: numbers in, numbers out."""

    def __init__(self, step: nn.Module, takes: Sequence[StageTensor], dtype: torch.dtype) -> None:
        super().__init__()
        self.step = step
        self._takes, self._dtype = takes, dtype

    def forward(self, row: Tensor) -> Tensor:
        ends = np.cumsum([int(np.prod(tensor.shape)) for tensor in self._takes]).tolist()
        given = (
            row[start:end].reshape(tensor.shape).to(getattr(torch, tensor.dtype))
            for start, end, tensor in zip([0, *ends], ends, self._takes, strict=False)
        )
        return torch.cat([value.reshape(-1).to(self._dtype) for value in self.step(*given)])


class _Loop(nn.Module):
    """A function of one row for all rows."""

    def __init__(self, row: nn.Module) -> None:
        super().__init__()
        self.row = row

    def forward(self, rows: Tensor) -> Tensor:
        done: list[Tensor] = []
        for number in range(rows.shape[0]):
            done.append(self.row(rows[number]))
        return torch.stack(done)
