"""Exploring actions: a sample of the policy's action distribution, drawn in numpy, as RLlib would draw it in torch.

The graph gives the distribution's parameters (`action_dist_inputs`); this file knows the three distributions RLlib's
PPO, APPO, IMPALA and SAC use and what RLlib does to a sample before `env.step`. It knows nothing of graphs or files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlservo.export.bundle import BoxSpec, DiscreteSpec, Distribution

# RLlib clamps the log of a squashed Gaussian's scale to this range: ray/rllib/utils/numpy.py, ray 2.60.
MIN_LOG_STD = -5.0
MAX_LOG_STD = 2.0


def distribution_size(distribution: Distribution, space: BoxSpec | DiscreteSpec) -> int:
    """Return how many numbers per action `action_dist_inputs` must hold."""
    if distribution.kind == "categorical":
        return space.n if isinstance(space, DiscreteSpec) else 0
    return 2 * space.size


def sample_action(
    inputs: NDArray[np.floating], distribution: Distribution, space: BoxSpec | DiscreteSpec, rng: np.random.Generator
) -> NDArray[np.float64] | NDArray[np.int64]:
    """Draw one action per row of `inputs` `[batch, distribution_size]`, in environment units: `[batch, *space.shape]`.

    'diag_gaussian' rows are [mean, log_std]; 'squashed_gaussian' rows are too, with the sample through tanh;
    'categorical' rows are logits, sampled by the Gumbel-max trick (Gumbel 1954; Maddison et al. 2014,
    arXiv:1411.0030).
    """
    rows = inputs.astype(np.float64)
    if isinstance(space, DiscreteSpec):
        choice: NDArray[np.int64] = np.argmax(rows + rng.gumbel(size=rows.shape), axis=-1).astype(np.int64)
        return choice + space.start
    mean, log_std = np.split(rows, 2, axis=-1)
    if distribution.kind == "squashed_gaussian":
        log_std = np.clip(log_std, MIN_LOG_STD, MAX_LOG_STD)
    sample = mean + np.exp(log_std) * rng.standard_normal(mean.shape)
    if distribution.kind == "squashed_gaussian":
        sample = np.tanh(sample)
    sample = sample.reshape((-1, *space.shape))
    if distribution.transform == "none":
        return sample
    low, high = space.bounds()
    if distribution.transform == "unsquash":
        sample = low + (sample + 1.0) * (high - low) / 2.0
    return np.clip(sample, low, high)
