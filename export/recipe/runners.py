"""Functions from observations to named outputs, step by step or row by row, which the parity gate compares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

Inputs: TypeAlias = dict[str, NDArray[Any]]
"""Arrays `[batch, ...]` by the graph's input names."""
Outputs: TypeAlias = dict[str, NDArray[Any]]
Runner: TypeAlias = Callable[[Inputs], Outputs]
"""Every input of the graph by name to every output by name."""


class Loop(Protocol):
    """Something that acts step after step and keeps its state."""

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the outputs for one step of every row; rows in `restart` begin an episode with it."""
        ...


def first_step(loop: Loop, inputs: Inputs) -> Outputs:
    """Return a loop's outputs for the first step of an episode in every row."""
    rows = len(next(iter(inputs.values())))
    return loop.step(inputs, np.ones(rows, np.bool_))
