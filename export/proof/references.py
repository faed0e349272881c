"""The framework's own answers, which an exported graph must reproduce."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rlservo.bundle.contract import REWARD
from rlservo.errors import UnsupportedError, first_line
from rlservo.export.recipe.recipe import ObservationFilter, Recipe
from rlservo.export.recipe.runners import Loop, Outputs, first_step
from rlservo.export.recipe.samples import Batch


@dataclass(frozen=True)
class Reference:
    """One batch and what the framework computed for it."""

    batch: Batch
    outputs: Outputs
    framework: str = "RLlib"
    """Name of the framework, for messages."""


def record(start_loop: Callable[[], Loop], batches: Sequence[Batch], framework: str = "RLlib") -> list[Reference]:
    """Run the framework on every batch; `start_loop` starts it acting step after step.

    The observations are copied: a connector may write into what it is given. Raises UnsupportedError when its own
    pipeline fails on an observation of the policy's own space.
    """
    try:
        return list(_record(start_loop, batches, framework))
    except UnsupportedError:
        raise
    except Exception as error:  # the framework's code and the user's raise anything
        raise UnsupportedError(
            f"{framework}'s own pipeline fails on an observation of the policy's space: {first_line(error)}"
        ) from error


def _record(start_loop: Callable[[], Loop], batches: Sequence[Batch], framework: str) -> Iterator[Reference]:
    loop: Loop | None = None
    rows = 0
    for batch in batches:
        inputs = {name: values.copy() for name, values in batch.inputs.items()}
        if batch.restart is None:
            outputs = first_step(start_loop(), inputs)
        else:
            if batch.reward is not None:
                inputs[REWARD] = batch.reward.copy()
            if loop is None or rows != len(batch):
                loop, rows = start_loop(), len(batch)
            outputs = loop.step(inputs, batch.restart)
        yield Reference(batch, outputs, framework)


def record_perturbed(
    start_loop: Callable[[], Loop], references: Sequence[Reference], recipe: Recipe
) -> list[Reference]:
    """Return the framework's answers when every floating-point observation moves up or down by its last bit.

    It is the last bit of the first number that is single precision: the observation, or behind a filter in double
    precision the filtered one.
    """
    rng = np.random.default_rng(0)
    filters = recipe.first_filters

    def move(name: str, values: NDArray[Any]) -> NDArray[Any]:
        is_double = isinstance(recipe.observation_leaves.get(name), Box) and values.dtype == np.float64
        return _by_last_bit(values, filters.get(name) if is_double else None, rng)

    batches = [
        replace(each.batch, inputs={name: move(name, values) for name, values in each.batch.inputs.items()})
        for each in references
    ]
    return list(_record(start_loop, batches, references[0].framework))


def _by_last_bit(values: NDArray[Any], before: ObservationFilter | None, rng: np.random.Generator) -> NDArray[Any]:
    if values.dtype.kind != "f":
        return values
    if before is not None:
        divisor = before.divisor().astype(np.float64)
        filtered = ((values - before.offset()) / divisor).astype(np.float32)
        step = np.maximum(np.spacing(np.abs(values)), np.spacing(np.abs(filtered)) * divisor)
        return np.asarray(np.where(rng.random(values.shape) < 0.5, values + step, values - step), values.dtype)
    single = values.astype(np.float32)  # the network's precision
    towards = np.where(rng.random(values.shape) < 0.5, np.float32(np.inf), np.float32(-np.inf))
    return np.asarray(np.nextafter(single, towards), values.dtype)
