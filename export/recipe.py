"""What RLlib does around the network, in plain numbers: the observation steps before it and the action rule after it.

`checkpoint.py` fills a `Recipe` in from RLlib's saved connector pipelines and `actor.py` turns it into a graph. This
file knows neither of them: numpy and Gymnasium spaces only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

# ray/rllib/utils/numpy.py (ray 2.60): keeps the filter from dividing by zero.
SMALL_NUMBER = 1e-6


AnyDiscrete: TypeAlias = "Discrete[Any]"
"""A Discrete of whichever integer type; quoted because only newer Gymnasium can index the class."""


@dataclass(frozen=True)
class ObservationFilter:
    """RLlib's MeanStdFilter, frozen: `clip((x - mean) / (std + 1e-6), -clip, clip)` (ray/rllib/utils/filter.py)."""

    count: int
    """How many observations the statistics were gathered from."""
    mean: NDArray[np.float64]
    """Of the observation's shape, in its units."""
    std: NDArray[np.float32]
    """Unbiased (n - 1), zero for n <= 1, and single precision because RLlib computes it so."""
    clip: float | None
    demean: bool = True
    """Whether the mean is subtracted at all (`de_mean_to_zero`)."""
    destd: bool = True
    """Whether the standard deviation divides at all (`de_std_to_one`)."""

    def offset(self) -> NDArray[np.float64]:
        """Return what is subtracted, of the observation's shape."""
        return self.mean if self.demean else np.zeros_like(self.mean)

    def divisor(self) -> NDArray[np.float32]:
        """Return what divides, of the observation's shape."""
        return self.std + np.float32(SMALL_NUMBER) if self.destd else np.ones_like(self.std)


@dataclass(frozen=True)
class Flatten:
    """RLlib's FlattenObservations on a Box: one row, as float32."""


@dataclass(frozen=True)
class Rescale:
    """`(x - offset) / divisor` in float32, the same for every element: an old-stack preprocessor."""

    offset: float
    divisor: float


ObservationStep: TypeAlias = ObservationFilter | Flatten | Rescale

Mode: TypeAlias = Literal["mean", "tanh_mean", "argmax"]
"""How the deterministic action comes out of the distribution's parameters (or, for argmax, of Q-values)."""

Transform: TypeAlias = Literal["none", "unsquash", "clip"]
"""What RLlib does to that action before `env.step`."""

DistributionKind: TypeAlias = Literal["diag_gaussian", "squashed_gaussian", "categorical"]


@dataclass(frozen=True)
class Recipe:
    """Everything between a raw observation and `env.step`, except the network."""

    observation_space: Box
    action_space: Box | AnyDiscrete
    steps: tuple[ObservationStep, ...]
    mode: Mode
    transform: Transform
    distribution: DistributionKind | None
    """None where the module picks its action itself and offers no distribution (DQN)."""

    @property
    def filter(self) -> ObservationFilter | None:
        """The observation filter, if there is one."""
        return next((step for step in self.steps if isinstance(step, ObservationFilter)), None)
