"""Functions from observations to named outputs, which the parity gate compares."""

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
    """Something that acts step after step and remembers."""

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return the outputs for one step of every row; rows in `restart` begin an episode with it."""
        ...
