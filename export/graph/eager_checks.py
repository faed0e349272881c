"""A policy graph run as plain torch before it is traced, to find what tracing would freeze without a word.

Tracing records one run. Numbers that the network reads in Python, changes of its own between two runs and random
numbers are constants in the record, and samples that do not meet the difference do not show it.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlservo.errors import UnsupportedError, first_line
from rlservo.export.graph.number_reads import number_reads
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.graph.why_not_exportable import raised_at
from rlservo.export.recipe.kept_values import changed, kept_values
from rlservo.export.recipe.runners import Inputs

BATCHES = (*range(3, 10), 12, 16, 32, 64, 100, 301)
"""Sizes of batches that are tried, beside those of the proof."""
LARGE, LARGE_BATCH = 4096, 32
"""Numbers of an observation above which it is large, and the largest batch of those."""
SAME = 1e-3
"""Difference between rows of two batches, relative to the largest number, above which it is no rounding."""
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
    reads, tries = number_reads(graph, tensors)
    if tries:
        raise UnsupportedError(
            f"the network goes on otherwise where an operator of torch fails, at {', '.join(tries[:3])}, and a graph "
            "keeps one way: check the numbers with torch's own operations there (torch.where) in place of 'except'"
        )
    if reads:
        raise UnsupportedError(
            f"the network reads numbers of the observation in Python at {', '.join(reads[:3])}, where a graph would "
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
