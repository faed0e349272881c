"""RLlib's unsquash and clip in numpy, and their inverse: between a module's own action and the one that is sent.

RLlib's episodes, and so its learners, hold the module's own action. A robot, a server and most of a recording hold the
one that was sent. Formulas: `unsquash_action` and `clip_action` in ray/rllib/utils/spaces/space_utils.py, ray 2.60.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec, DiscreteSpec, LeafSpec, MultiDiscreteSpec

Transform: TypeAlias = Literal["none", "unsquash", "clip"]


def transform_of(contract: Contract) -> Transform:
    """Return the transform of the policy's own actions; choices are always counted from the space's start."""
    if contract.distribution is not None:
        return contract.distribution.transform
    steps = {step.step for step in contract.baked_in}  # a module that computes its actions itself has no distribution
    return "unsquash" if "unsquash" in steps else "clip" if "clip" in steps else "none"


def is_invertible(contract: Contract) -> bool:
    """Return whether own actions can be recovered from sent ones: not if something else also changes them."""
    steps = [step.step for step in contract.baked_in]
    after = steps[steps.index("mode") :] if "mode" in steps else []
    return not {"user_connector", "scale"} & set(after)


def to_sent(own: NDArray[Any], transform: Transform, leaf: LeafSpec) -> NDArray[Any]:
    """Return the sent actions for own ones, both `[rows, *leaf.shape]`, of float64 for a Box."""
    if not isinstance(leaf, BoxSpec):
        return own + _start(leaf)
    effect = _effect(transform, leaf)
    low, high = leaf.bounds()
    if effect == "unsquash":
        return np.clip(low + (own + 1.0) * (high - low) / 2.0, low, high)
    if effect == "shift":
        return own + low
    return np.clip(own, low, high) if effect == "clip" else own


def to_own(sent: NDArray[Any], transform: Transform, leaf: LeafSpec) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return (own actions, which rows were clipped) for actions that were sent, `[rows, *leaf.shape]`.

    An element at a bound may have been clipped: then the result is the bound, the nearest own action that is sent
    so, and the row is flagged. All others are exact to rounding.
    """
    rows = len(sent)
    clipped = np.zeros(rows, np.bool_)
    if not isinstance(leaf, BoxSpec):
        return sent - _start(leaf).astype(sent.dtype), clipped
    effect = _effect(transform, leaf)
    if effect == "none":
        return sent, clipped
    low, high = leaf.bounds()
    if effect == "shift":
        return (sent - low).astype(sent.dtype), clipped
    # The bounds as the sent action's type has them: in float32 an action at the bound is not above it in float64.
    at_bound = (sent <= low.astype(sent.dtype)) | (sent >= high.astype(sent.dtype))
    clipped = np.asarray(at_bound.reshape(rows, -1).any(axis=1), np.bool_)
    if effect == "clip":
        return sent, clipped
    span = np.where(high > low, high - low, 1.0)
    scaled = 2.0 * (sent.astype(np.float64) - low) / span - 1.0
    return np.where(high > low, np.clip(scaled, -1.0, 1.0), 0.0).astype(sent.dtype), clipped


def _effect(transform: Transform, leaf: BoxSpec) -> Literal["none", "unsquash", "clip", "shift"]:
    """Return the transform of one Box: unsquashed only if bounded on all sides, and an integer is only shifted."""
    low, high = leaf.bounds()
    if transform == "unsquash":
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return "none"
        return "unsquash" if np.dtype(leaf.dtype).kind == "f" else "shift"
    return transform


def _start(leaf: LeafSpec) -> NDArray[np.int64]:
    if isinstance(leaf, DiscreteSpec):
        return np.array(leaf.start, np.int64)
    if isinstance(leaf, MultiDiscreteSpec):
        return np.array(leaf.start, np.int64).reshape(leaf.shape)
    return np.zeros(leaf.shape, np.int64)
