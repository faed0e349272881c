"""Whole recorded episodes in memory, as what RLlib's offline learners draw their minibatches from.

RLlib's `OfflineData` (ray 2.60) cuts what it reads into single steps, so that MARWIL's advantages are errors of one
step under a value function that is hardly ever renewed, starts every sequence of a recurrent module from zeros, and
takes two more processes. `RecordedEpisodes` stands in for it: the learner's own connectors see whole episodes, under
the weights as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.offline.offline_data import OfflineData
from ray.rllib.utils import flatten_dict

assert ray_settings
AT_ONCE = 256  # episodes from which minibatches are drawn


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
