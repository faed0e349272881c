"""A module's own actions in a recorded episode, for RLlib's learners.

A record has the own action if it explored. If it has none, or the robot did something else (a fallback, a step limit),
unsquash and clip are inverted on the executed action.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.action_transform import is_invertible, to_own, to_sent, transform_of
from rlservo.bundle.scores import split_parameters
from rlservo.bundle.spaces import BoxSpec, DiscreteSpec, LeafSpec, MultiDiscreteSpec, leaf_specs
from rlservo.recording.episodes import Columns, RecordedEpisode

ROUNDING = 1e-5  # of a Box's span: allowed float32 difference between an own action as sent and the executed one


@dataclass(frozen=True)
class OwnActions:
    """Own actions of an episode's executed decisions."""

    leaves: Columns
    """By tensor name, `[rows, *shape]`."""
    known: NDArray[np.bool_]
    """Rows whose own action is known; other rows are undefined."""
    recorded: NDArray[np.bool_]
    """Rows whose own action, or its distribution, was recorded; other known ones are computed."""
    clipped: NDArray[np.bool_]
    """Rows whose own action is computed and lies at the bound or beyond it: the bound represents it."""


def own_actions(episode: RecordedEpisode) -> OwnActions:
    """Return the own action of every row where it can be determined."""
    contract = episode.policy.contract
    transform = transform_of(contract)
    specs = leaf_specs(contract.action_space, "action")
    recorded = np.isfinite(episode.logp) & episode.acted & ~episode.fell_back
    if not is_invertible(contract):
        return OwnActions(episode.own_action, recorded, recorded, np.zeros_like(recorded))
    for name, leaf in specs.items():
        recorded &= is_sent_as(to_sent(episode.own_action[name], transform, leaf), episode.executed[name], leaf)
    leaves: Columns = {}
    clipped = np.zeros(len(episode), np.bool_)
    for name, leaf in specs.items():
        inverse, at_bound = to_own(episode.executed[name], transform, leaf)
        own = episode.own_action[name]
        leaves[name] = np.where(recorded.reshape(-1, *[1] * (own.ndim - 1)), own, inverse)
        clipped |= at_bound & ~recorded
    known = episode.acted | episode.fell_back
    return OwnActions(leaves, known, recorded, clipped & known)


def modes(episode: RecordedEpisode) -> OwnActions:
    """Return the policy's actions without exploring: its distributions' most likely ones.

    Rows that did not explore have their own action; rows with a fallback's are not `known`.
    """
    own = own_actions(episode)
    distribution = episode.policy.contract.distribution
    drawn = np.isfinite(episode.logp)
    if distribution is None or not drawn.any():
        return replace(own, known=own.known & ~episode.fell_back)
    leaves: Columns = {}
    for name, leaf, inputs in split_parameters(episode.dist_inputs, episode.policy.contract.action_space):
        if isinstance(leaf, DiscreteSpec):
            mode = inputs.argmax(axis=-1)
        elif isinstance(leaf, MultiDiscreteSpec):
            parts = np.split(inputs, np.cumsum(leaf.nvec)[:-1], axis=-1)
            mode = np.stack([part.argmax(axis=-1) for part in parts], axis=-1)
        else:
            mode = np.split(inputs, 2, axis=-1)[0]
            mode = np.tanh(mode) if distribution.kind == "squashed_gaussian" else mode
        before = own.leaves[name]
        shape = (-1, *[1] * (before.ndim - 1))
        leaves[name] = np.where(drawn.reshape(shape), mode.reshape(before.shape).astype(before.dtype), before)
    known = own.known & ~episode.fell_back
    return OwnActions(leaves, known, own.recorded | drawn, own.clipped & ~drawn)


def is_sent_as(sent: NDArray[Any], executed: NDArray[Any], leaf: LeafSpec) -> NDArray[np.bool_]:
    """Return the rows whose own action, when sent, equals the executed one up to float32: no step limit applied."""
    slack: NDArray[np.float64] | float = 0.0
    if isinstance(leaf, BoxSpec):
        low, high = leaf.bounds()
        span = high - low
        slack = ROUNDING * np.where(np.isfinite(span), span, np.maximum(1.0, np.abs(executed)))
    same = np.abs(sent.astype(np.float64) - executed.astype(np.float64)) <= slack
    return np.asarray(same.reshape(len(same), -1).all(axis=1), np.bool_)
