"""A policy graph run as plain torch before it is traced, to find what tracing would freeze without a word.

Tracing records one run. Numbers that the network reads in Python, changes of its own between two runs and random
numbers are constants in the record, and samples that do not meet the difference do not show it.
"""

from __future__ import annotations

import ast
import contextlib
import random
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from rlservo.errors import UnsupportedError, first_line
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.why_not_exportable import raised_at
from rlservo.export.recipe.kept_values import FRAMEWORKS, INSTALLED, changed, kept_values
from rlservo.export.recipe.runners import Inputs

READS = frozenset({
    Tensor.__bool__, Tensor.__int__, Tensor.__float__, Tensor.__complex__, Tensor.__index__, Tensor.__contains__,
    Tensor.__array__, Tensor.numpy, Tensor.item, Tensor.tolist, Tensor.equal, Tensor.allclose, Tensor.is_nonzero,
    Tensor.__format__, Tensor.__dlpack__, Tensor.storage, Tensor.untyped_storage, Tensor.data_ptr, Tensor.new_tensor,
    torch.equal, torch.allclose, torch.is_nonzero, torch.tensor,
})  # fmt: skip
"""Functions that take a tensor's numbers out of torch. `print` does too, and decides nothing."""
SELECTS = frozenset({
    torch.nonzero, torch.argwhere, torch.masked_select, torch.unique, torch.unique_consecutive, torch.bincount,
    Tensor.nonzero, Tensor.argwhere, Tensor.masked_select, Tensor.unique, Tensor.unique_consecutive, Tensor.bincount,
    torch.zeros, torch.ones, torch.empty, torch.arange,
})  # fmt: skip
"""Functions whose results have as many numbers as the observation's say."""
SIZES = frozenset({
    Tensor.__len__, Tensor.__iter__, Tensor.unbind, torch.unbind, Tensor.numel, Tensor.nelement, Tensor.size,
    Tensor.shape.__get__,  # type: ignore[attr-defined]
})  # fmt: skip
"""Functions that take a tensor's size out of torch."""
BATCHES = (*range(3, 10), 12, 16, 32, 64, 100, 301)
"""Sizes of batches that are tried, beside those of the proof."""
LARGE, LARGE_BATCH = 4096, 32
"""Numbers of an observation above which it is large, and the largest batch of those."""
SAME = 1e-3
"""Difference between rows of two batches, relative to the largest number, above which it is no rounding."""
TENSORS_OWN = ("_tensor.py", "overrides.py")
"""Files of torch through which a tensor's methods are called."""
WRAPPERS = ".network.module."
"""Names of what the exporter puts around a network."""


def check_eager(graph: PolicyGraph, example: Inputs) -> None:
    """Raise UnsupportedError for a network that draws random numbers, changes itself or reads numbers in Python.

    `example` is two rows of every input of the graph.
    """
    tensors = tuple(torch.from_numpy(example[name]) for name in graph.input_names)
    given = [tensor.clone() for tensor in tensors]
    try:
        with torch.no_grad(), _other_random_numbers() as before:
            graph(*given)
            drawn = _generators() != before
            first = dict(kept_values(graph))
            graph(*(tensor.clone() for tensor in tensors))
            second = dict(kept_values(graph))
    except Exception as error:  # the network's own forward may raise anything
        raise UnsupportedError(f"the network does not run: {first_line(error)}{raised_at(error)}") from error
    if drawn:
        raise UnsupportedError(
            "the network draws random numbers even without exploring, which an exported policy cannot do: remove the "
            "noise"
        )
    for name, tensor, after in zip(graph.input_names, tensors, given, strict=True):
        if not torch.equal(tensor, after):
            raise UnsupportedError(
                f"the network writes into its input '{name}', which is the caller's: compute a new tensor (obs * 2 in "
                "place of obs.mul_(2)), or clone it first"
            )
    if kept := changed(first, second).removeprefix(WRAPPERS):
        raise UnsupportedError(
            f"the network changes its '{kept}' each time it acts, so its action depends on how often it has acted, "
            "which cannot be exported: what it remembers must be its recurrent state"
        )
    _check_sizes(graph, tensors)
    if places := _reads(graph, tensors):
        raise UnsupportedError(
            f"the network reads numbers of the observation in Python at {', '.join(places[:3])}, where a graph would "
            "keep those of one example: use torch's own operations there (torch.where for an 'if')"
        )


def _check_sizes(graph: PolicyGraph, tensors: Sequence[Tensor]) -> None:
    """Raise UnsupportedError for a network that does otherwise in batches of some size: a graph keeps one way."""
    is_large = sum(tensor[0].numel() for tensor in tensors) > LARGE
    with torch.no_grad():
        ones = [value[:1].double() for value in graph(*_alike(tensors, 2))]
        for size in (size for size in BATCHES if size <= LARGE_BATCH or not is_large):
            try:
                outputs = graph(*_alike(tensors, size))
            except Exception as error:  # the network's own forward may raise anything
                raise UnsupportedError(
                    f"the network does not run on {size} observations: {first_line(error)}{raised_at(error)}"
                ) from error
            for expected, found in zip(ones, outputs, strict=True):
                scale = SAME * max(1.0, float(expected.nan_to_num(0.0, 0.0, 0.0).abs().max()))
                if found.shape[0] != size or not torch.allclose(
                    found.double(), expected.expand_as(found), rtol=SAME, atol=scale, equal_nan=True
                ):
                    raise UnsupportedError(
                        f"the network's result for the same observation changes in a batch of {size}: it depends on "
                        "the other observations of the batch, or on their number, which cannot be exported"
                    )


def _alike(tensors: Sequence[Tensor], size: int) -> list[Tensor]:
    """Return the first row `size` times."""
    return [tensor[:1].repeat(size, *[1] * (tensor.dim() - 1)) for tensor in tensors]


@contextlib.contextmanager
def _other_random_numbers() -> Iterator[tuple[Any, ...]]:
    """Give the states of the generators after numbers that no seed begins with, and restore those before."""
    kept = torch.get_rng_state(), np.random.get_state(), random.getstate()
    try:
        torch.rand(3)
        np.random.random(3)
        random.random()
        yield _generators()
    finally:
        torch.set_rng_state(kept[0])
        np.random.set_state(kept[1])
        random.setstate(kept[2])


def _generators() -> tuple[Any, ...]:
    """Return the states of the generators of random numbers."""
    kind, keys, *position = np.random.get_state()
    return torch.get_rng_state().numpy().tobytes(), np.asarray(keys).tobytes(), kind, position, random.getstate()


class _Follower(TorchFunctionMode):
    """Calls `report` where Python reads numbers of a tensor that was computed from the observation.

    Such a tensor is known by its memory: a buffer that was filled with the observation, and a view of it, are others'
    objects. The size of some depends on numbers of the observation too: to read it is to read those.
    """

    def __init__(self, tensors: Sequence[Tensor], report: Callable[[], None]) -> None:
        super().__init__()
        self._report = report
        self._kept: list[Tensor] = []  # kept alive, so that no other tensor gets their memory
        self._memory: set[int] = set()
        self._sized: set[int] = set()
        for tensor in tensors:
            self._follow(tensor)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None) -> Any:
        options = kwargs or {}
        given = [one for one in _tensors((args, options)) if not self._memory.isdisjoint(_memory(one))]
        is_sized = any(id(one) in self._sized for one in given)
        if given and (func in READS or (is_sized and func in SIZES)):
            self._report()
        result = func(*args, **options)
        if given:
            for one in _tensors((result, options.get("out"), args[0] if _writes(func) else None)):
                self._follow(one)
            selects = func in SELECTS or (func is Tensor.__getitem__ and _is_mask(args[1]))
            if is_sized or selects or (func is torch.where and len(args) + len(options) == 1):
                self._sized.update(id(one) for one in _tensors(result) if one.dim())
        return result

    def _follow(self, tensor: Tensor) -> None:
        self._kept.append(tensor)
        self._memory.update(_memory(tensor))


def _memory(tensor: Tensor) -> set[int]:
    """Return what a tensor shares with its views: the address of its numbers; and its own, as it may have none."""
    try:
        return {id(tensor), tensor.untyped_storage().data_ptr() or id(tensor)}
    except (RuntimeError, NotImplementedError):  # a kind of tensor without a storage
        return {id(tensor)}


def _writes(func: Any) -> bool:
    """Return whether a function of torch writes into its first argument."""
    name = getattr(func, "__name__", "")
    return name in ("__setitem__", "__set__") or (name.endswith("_") and not name.endswith("__"))


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors among arguments or results."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors(item)


def _is_mask(index: Any) -> bool:
    return any(one.dtype == torch.bool for one in _tensors(index))


def _reads(graph: PolicyGraph, tensors: Sequence[Tensor]) -> list[str]:
    """Return the places in the user's own code, but for assertions, that read the observation's numbers in Python."""
    places: set[str] = set()

    def report() -> None:
        frames = traceback.extract_stack()[:-2]
        reader = next(frame for frame in reversed(frames) if Path(frame.filename).name not in TENSORS_OWN)
        # The frameworks' reads are checks, such as those of torch's distributions.
        if not _is_of_a_framework(reader.filename) and not _asserts(reader.filename, reader.lineno or 0):
            places.add(f"{reader.filename}:{reader.lineno}")

    given = [tensor.clone() for tensor in tensors]
    try:
        with torch.no_grad(), _Follower(given, report):
            graph(*given)
    except Exception as error:  # torch's higher order operators do not take a mode
        raise UnsupportedError(
            "the network does not run under a TorchFunctionMode, with which the export looks for numbers that are "
            f"read in Python: {first_line(error)}{raised_at(error)}"
        ) from error
    return sorted(places)


def _is_of_a_framework(file: str) -> bool:
    """Return whether a file is of an installed package that trains policies, or of what that stands on."""
    parts = Path(file).parts
    return any(part in INSTALLED and parts[index + 1] in FRAMEWORKS for index, part in enumerate(parts[:-1]))


def _asserts(file: str, line: int) -> bool:
    """Return whether a line is part of an assertion, which changes no number."""
    try:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return False
    return any(
        isinstance(node, ast.Assert) and node.lineno <= line <= (node.end_lineno or 0) for node in ast.walk(tree)
    )
