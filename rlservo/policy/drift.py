"""Drift of a policy's observations from those of its training.

The exporter bakes RLlib's running filter into the graph and writes its mean and standard deviation into the contract;
nothing more is needed. One observation in `EVERY` is checked (in a batch, its first rows), and running means of z =
(obs - mean) / std are kept with a limited memory: for familiar observations the shift is near 0 and the spread near 1
for every element. No observation is kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec, element_label

FILTER = "mean_std_filter"
EVERY = 16  # the arithmetic costs a few microseconds: too much for every step of a control loop
ROWS = 64  # of a batch
MEMORY = 512  # observations; older ones fade
LARGEST = 100.0  # an element that never moved in training has no scale
SMALLEST_STD = 1e-6


class Drift:
    """Running statistics of one policy's observations, in standard deviations of its training."""

    def __init__(self, elements: tuple[str, ...], mean: NDArray[np.float64], std: NDArray[np.float64]) -> None:
        self.elements = elements
        self._mean = mean
        self._scale = 1.0 / np.maximum(std, SMALLEST_STD)
        self.looks = 0
        self._shift = np.zeros(len(mean))
        self._square = np.zeros(len(mean))

    @classmethod
    def of(cls, contract: Contract) -> Self | None:
        """Return the statistics for a policy, or None if its contract has no filter of the raw observation."""
        space, moments = contract.observation_space, training_moments(contract)
        if moments is None or not isinstance(space, BoxSpec):
            return None
        names = [element.name for element in space.elements]
        if len(set(names)) != space.size:
            names = [element_label(space, index) for index in range(space.size)]
        return cls(tuple(names), *moments)

    def add(self, obs: NDArray[Any]) -> None:
        """Include checked observations `[batch, ...]`; a parser does this once in `EVERY` calls."""
        self.looks += 1
        z: NDArray[np.float64] = (obs[:ROWS].reshape(min(len(obs), ROWS), -1) - self._mean) * self._scale
        np.clip(z, -LARGEST, LARGEST, out=z)
        weight = max(1.0 / self.looks, 1.0 / MEMORY)
        self._shift += weight * (z.mean(axis=0) - self._shift)
        self._square += weight * ((z * z).mean(axis=0) - self._square)

    @property
    def shift(self) -> NDArray[np.float64]:
        """Mean of z per element: shift of the observations, in standard deviations of the training."""
        shift: NDArray[np.float64] = self._shift.copy()
        return shift

    @property
    def spread(self) -> NDArray[np.float64]:
        """Standard deviation of z per element: 1 if the observations vary as they did in training."""
        spread: NDArray[np.float64] = np.sqrt(np.maximum(self._square - self._shift**2, 0.0))
        return spread


def training_moments(contract: Contract) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the mean and standard deviation of each observation element in training, flat.

    None if the contract has no filter of the raw observation.
    """
    space = contract.observation_space
    step = contract.baked_in[0] if contract.baked_in else None
    if step is None or step.step != FILTER or not isinstance(space, BoxSpec):
        return None
    mean, std = (np.asarray(step.values.get(name, ()), np.float64).ravel() for name in ("mean", "std"))
    if not mean.size == std.size == space.size or not (np.isfinite(mean).all() and np.isfinite(std).all()):
        return None
    return mean, std
