"""A module's own actions in a recorded episode: what RLlib's learners learn from.

A record has the own action where it explored. Where it has none, or the robot did something else (a fallback, a step
limit), the executed action is taken back through unsquash and clip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.action_transform import to_own, to_sent, transform_of
from rlservo.export.contract.spaces import BoxSpec, leaf_specs
from rlservo.serve_app.recording.episodes import Columns, Episode

ROUNDING = 1e-5  # of a Box's span: an own action that is sent as what was executed, but for its float32


@dataclass(frozen=True)
class OwnActions:
    """Own actions of an episode's decisions, of what the robot executed."""

    leaves: Columns
    """By tensor name, `[rows, *shape]`."""
    recorded: NDArray[np.bool_]
    """Rows whose own action was recorded; the others' are computed."""
    clipped: NDArray[np.bool_]
    """Rows whose own action is computed and lies at the bound or anywhere beyond it: the bound stands for it."""


def own_actions(episode: Episode) -> OwnActions:
    """Return the own action of every row; rows in which nothing was executed hold some number."""
    contract = episode.policy.contract
    transform = transform_of(contract)
    leaves: Columns = {}
    recorded = np.isfinite(episode.logp)
    clipped = np.zeros(len(episode), np.bool_)
    specs = leaf_specs(contract.action_space, "action")
    for name, leaf in specs.items():
        executed = episode.executed[name]
        sent = to_sent(episode.own_action[name], transform, leaf)
        slack = 0.0
        if isinstance(leaf, BoxSpec):
            low, high = leaf.bounds()
            slack = ROUNDING * np.where(np.isfinite(high - low), high - low, np.maximum(1.0, np.abs(executed)))
        same = np.abs(sent.astype(np.float64) - executed.astype(np.float64)) <= slack
        recorded &= same.reshape(len(episode), -1).all(axis=1)
    for name, leaf in specs.items():
        inverse, at_bound = to_own(episode.executed[name], transform, leaf)
        own = episode.own_action[name]
        leaves[name] = np.where(recorded.reshape(-1, *[1] * (own.ndim - 1)), own, inverse)
        clipped |= at_bound & ~recorded
    return OwnActions(leaves, recorded, clipped)
