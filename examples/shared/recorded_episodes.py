"""Whole recorded episodes in memory: chosen, and drawn from as RLlib's offline learners do.

RLlib's `OfflineData` (ray 2.60) cuts what it reads into single steps, so that MARWIL's advantages are errors of one
step under a value function that is hardly ever renewed, starts every sequence of a recurrent module from zeros, and
takes two more processes. `RecordedEpisodes` stands in for it: the learner's own connectors see whole episodes, under
the weights as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.offline.offline_data import OfflineData
from ray.rllib.utils import flatten_dict

from rlservo import errors
from rlservo.deploy.learning.rllib_episodes import single_agent_episode, why_not_whole, why_without_reward
from rlservo.recording.conversion.common import episodes_of_one
from rlservo.recording.episodes import RecordedEpisode
from rlservo.recording.reader import Recording
from rlservo.recording.unsquashed_actions import OwnActions, modes, own_actions

assert ray_settings
AT_ONCE = 256  # episodes from which minibatches are drawn


@dataclass
class Recorded:
    """Episodes for a learner: observations as the environment gave them, the module's own actions."""

    contract: Any
    episodes: list[SingleAgentEpisode] = field(default_factory=list)
    """In the form that `env.step` gives; not yet passed through connectors."""
    not_used: dict[str, int] = field(default_factory=dict)
    """Unusable episodes, by reason."""
    own: int = 0
    """Decisions whose own action was recorded."""
    inverted: int = 0
    """Decisions whose own action is the inverse of the executed one."""
    clipped: int = 0
    """Number of those at or beyond a bound."""

    @property
    def decisions(self) -> int:
        return self.own + self.inverted

    @property
    def mean_return(self) -> float:
        return float(np.mean([episode.get_return() for episode in self.episodes]))

    def add(self, episode: RecordedEpisode, own: OwnActions, ahead: int) -> None:
        """Add an episode."""
        self.own += int(own.recorded.sum())
        self.inverted += int((~own.recorded).sum())
        self.clipped += int(own.clipped.sum())
        id_ = f"{len(self.episodes)}"  # RLlib numbers episodes with "_" behind their ids
        self.episodes.append(single_agent_episode(episode, own.leaves, episode.reward, id_=id_, ahead=ahead))


@dataclass(frozen=True)
class Choice:
    """Selection of episodes, and of the actions to learn from them."""

    rewards: bool
    """Whether the learner needs rewards, and the observation after the end of a truncated episode."""
    status: str | None
    """Only episodes with this final status."""
    modes: bool
    """Whether to learn the most likely action of a recorded distribution instead of the drawn one."""
    ahead: int
    """Number of cycles by which the action learned for an observation comes later."""


def read_recordings(recording: Recording, choice: Choice, *, name: str | None) -> Recorded:
    """Return the whole episodes of one policy that are usable for learning.

    Raises UsageError if none can be used, and RecordingError.
    """
    recorded: Recorded | None = None
    for episode in episodes_of_one(recording, name):
        recorded = recorded or Recorded(episode.policy.contract)
        own = modes(episode) if choice.modes else own_actions(episode)
        reason = _why_not(episode, own, choice)
        if reason is None:
            recorded.add(episode, own, choice.ahead)
        else:
            recorded.not_used[reason] = recorded.not_used.get(reason, 0) + 1
    assert recorded is not None, "episodes_of_one raises if there are none"
    if not recorded.episodes:
        reasons = ", ".join(f"{count} {reason}" for reason, count in recorded.not_used.items())
        raise errors.UsageError(f"no recorded episode can be learned from: {reasons}")
    return recorded


def _why_not(episode: RecordedEpisode, own: OwnActions, choice: Choice) -> str | None:
    if (reason := why_not_whole(episode)) is not None:
        return reason
    if choice.status is not None and episode.final_status != choice.status:
        return f"that did not end in {choice.status!r}"
    if not own.known.all():
        return "without all of the module's own actions"
    return why_without_reward(episode, episode.reward) if choice.rewards else None


class RecordedEpisodes(OfflineData):
    """Source of minibatches for RLlib's offline algorithms; `episodes` are to be given once it is built."""

    def __init__(self, config: Any) -> None:  # not RLlib's own: that reads files
        self.config = config
        self.episodes: list[SingleAgentEpisode] = []
        self.iter_batches_kwargs: dict[str, Any] = {}
        self.learner_handles: Any = []  # these four are set by the algorithm
        self.locality_hints = self.module_spec = self.spaces = None
        self._rng = np.random.default_rng(config.seed)

    def sample(
        self,
        num_samples: int,
        return_iterator: bool = False,
        num_shards: int = 1,
        module_state: Any = None,
    ) -> Any:
        """Return what the one learner in this process iterates over."""
        assert return_iterator, "dataset_num_iters_per_learner is more than 1"
        assert num_shards <= 1, "the learner is in this process"
        return [self]

    def iter_torch_batches(self, *, batch_size: int, **_: Any) -> _Epochs:
        """Return an iterable over minibatches that begins an epoch each time it is iterated over."""
        return _Epochs(self, batch_size)

    def epoch(self, batch_size: int) -> Iterator[dict[str, Any]]:
        """Yield each recorded decision once, in minibatches: of a recurrent module, whole sequences."""
        module = self.learner_handles[0].module
        spaces = cast(Any, self.spaces)
        connector = self.config.build_learner_connector(*spaces["__env__"])
        order = self._rng.permutation(len(self.episodes))
        for begin in range(0, len(order), AT_ONCE):
            group = [copy.deepcopy(self.episodes[index]) for index in order[begin : begin + AT_ONCE]]
            batch = connector(rl_module=module, batch={}, episodes=group, shared_data={}, metrics=None)
            columns = flatten_dict(batch)
            rows = len(next(iter(columns.values())))
            states = [name for name in columns if Columns.STATE_IN in name]
            length = next(leaf.shape[1] for name, leaf in columns.items() if Columns.REWARDS in name) if states else 1
            parts = min(rows, max(1, round(rows * length / batch_size)))
            for chosen in np.array_split(self._rng.permutation(rows), parts):
                yield {name: leaf[torch.as_tensor(chosen)] for name, leaf in columns.items()}


@dataclass(frozen=True)
class _Epochs:
    data: RecordedEpisodes
    batch_size: int

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return self.data.epoch(self.batch_size)
