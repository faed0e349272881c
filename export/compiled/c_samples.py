"""Observations beyond the golden vectors: usual ones, corners of the space, far outside, zeros and tiny numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import REWARD, Contract
from rlservo.bundle.spaces import BoxSpec, LeafSpec, leaf_specs

ROWS = 100  # episodes side by side


def sample_inputs(
    contract: Contract, golden: Mapping[str, NDArray[Any]], steps: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield `steps` times ROWS observations (and rewards) by tensor name; always the same for one contract."""
    rng = np.random.default_rng(0)
    leaves: dict[str, LeafSpec] = leaf_specs(contract.observation_space, "obs")
    if contract.has_reward:
        leaves = {**leaves, REWARD: BoxSpec(shape=(1,), dtype="float32", low=None, high=None, elements=())}
    for _ in range(steps):
        kinds = rng.choice(6, ROWS, p=[0.4, 0.25, 0.15, 0.1, 0.05, 0.05])
        inputs = {name: _leaf(leaf, golden[name], kinds, rng) for name, leaf in leaves.items()}
        yield {name: array.reshape(ROWS) if name == REWARD else array for name, array in inputs.items()}


def _leaf(leaf: LeafSpec, golden: NDArray[Any], kinds: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    dtype, shape = np.dtype(leaf.dtype), (ROWS, *leaf.shape)
    low, high = leaf.bounds()
    if dtype.kind != "f":
        info = np.iinfo(np.int8 if dtype == np.bool_ else dtype)
        first = np.maximum(low, -1000.0 if info.min < -1000 else float(info.min)).astype(np.int64)
        last = np.minimum(high, 1000.0 if info.max > 1000 else float(info.max)).astype(np.int64)
        usual = rng.integers(np.minimum(first, last), np.maximum(first, last) + 1, shape)
        corner = np.where(rng.random(shape) < 0.5, first, np.maximum(first, last))
        drawn = np.where((kinds >= 2).reshape(-1, *[1] * len(leaf.shape)), corner, usual)
        return drawn.astype(dtype)
    recorded = golden.reshape(len(golden), *leaf.shape).astype(np.float64)
    spread = np.nan_to_num(np.minimum(recorded.std(axis=0), 1e6)) + 1e-3
    bounded = np.isfinite(low) & np.isfinite(high)
    span = np.where(bounded, high, 0.0) - np.where(bounded, low, 0.0)
    sizes = 10.0 ** rng.uniform(-3, 4, shape)
    signs = np.where(rng.random(shape) < 0.5, -1.0, 1.0)
    near = np.median(recorded, axis=0) + spread * rng.standard_normal(shape)
    usual = np.where(bounded, np.where(bounded, low, 0.0) + span * rng.random(shape), near)
    corner = np.where(bounded, np.where(signs < 0, low, high), signs * sizes)
    one_huge = np.where(rng.random(shape) < 1.0 / max(leaf.size, 1), signs * 10.0 ** rng.uniform(4, 38, shape), usual)
    picked = recorded[rng.integers(len(recorded), size=ROWS)] + 0.1 * spread * rng.standard_normal(shape)
    tiny = np.where(rng.random(shape) < 0.5, signs * 0.0, signs * 1e-41)
    by_kind = np.stack([usual, picked, corner, signs * sizes, one_huge, tiny])
    limit = float(np.finfo(dtype).max)
    values: NDArray[Any] = np.clip(by_kind[kinds, np.arange(ROWS)], -limit, limit).astype(dtype)
    return values
