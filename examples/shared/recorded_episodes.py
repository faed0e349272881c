"""Recordings as RLlib's own episodes, and the learners' way to them: whole episodes in memory.

RLlib's `OfflineData` (ray 2.60) cuts what it reads into single steps, so that MARWIL's advantages are errors of one
step under a value function that is hardly ever renewed, starts every sequence of a recurrent module from zeros, and
takes two more processes. `RecordedEpisodes` stands in for it: the learner's own connectors see whole episodes, under
the weights as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
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
from rlservo.export.contract.nested import build_action
from rlservo.export.rllib import private_names
from rlservo.export.rllib.new_connectors import PLUMBING
from rlservo.serve_app.recording.conversion import episodes_of_one
from rlservo.serve_app.recording.episodes import Episode
from rlservo.serve_app.recording.own_actions import OwnActions, modes, own_actions
from rlservo.serve_app.recording.reader import Recording

assert ray_settings
AT_ONCE = 256  # episodes in a pipeline's pass, and of which minibatches are drawn
CANNOT_LEARN = ("FrameStacking",)
"""Pieces that put nothing into the episode: a learner would need a second one of its own."""


@dataclass
class Recorded:
    """What recordings hold for a learner: observations as the environment gave them, the module's own actions."""

    contract: Any
    episodes: list[SingleAgentEpisode] = field(default_factory=list)
    """As `env.step` fills them; not through connectors yet."""
    not_used: dict[str, int] = field(default_factory=dict)
    """Episodes that could not be used, by the reason."""
    own: int = 0
    """Decisions whose own action was recorded."""
    inverted: int = 0
    """Decisions whose own action is the inverse of the executed one."""
    clipped: int = 0
    """Of those, how many lie at a bound, or anywhere beyond it."""

    @property
    def decisions(self) -> int:
        return self.own + self.inverted

    @property
    def mean_return(self) -> float:
        return float(np.mean([episode.get_return() for episode in self.episodes]))


@dataclass(frozen=True)
class Choice:
    """Which episodes are learned from, and what of them is learned."""

    rewards: bool = True
    """Whether the learner needs rewards, and the observation after an episode that was cut off."""
    status: str | None = None
    """Only episodes that ended so."""
    modes: bool = False
    """Whether the most likely action of a recorded distribution is learned, not the one that was drawn."""
    ahead: int = 0
    """Learn for an observation what was done so many cycles later."""


def read_recordings(recording: Recording, choice: Choice | None = None, *, name: str | None = None) -> Recorded:
    """Return the whole episodes of one policy that can be learned from.

    Raises UsageError where none can be used, and RecordingError.
    """
    chosen = choice or Choice()
    recorded: Recorded | None = None
    for episode in episodes_of_one(recording, name):
        recorded = recorded or Recorded(episode.policy.contract)
        own = modes(episode) if chosen.modes else own_actions(episode)
        reason = _why_not(episode, own, chosen)
        if reason is None:
            _add(recorded, episode, own, chosen.ahead)
        else:
            recorded.not_used[reason] = recorded.not_used.get(reason, 0) + 1
    assert recorded is not None, "episodes_of_one raises where there are none"
    if not recorded.episodes:
        reasons = ", ".join(f"{count} {reason}" for reason, count in recorded.not_used.items())
        raise errors.UsageError(f"no recorded episode can be learned from: {reasons}")
    return recorded


def _why_not(episode: Episode, own: OwnActions, choice: Choice) -> str | None:
    if not episode.id or not episode.begins or episode.gap is not None:
        return "without their beginning or with a gap"
    if episode.goes_on:
        return "too long to be read in one piece"
    if not episode.ended:
        return "without an end"
    if choice.status is not None and episode.final_status != choice.status:
        return f"that did not end in {choice.status!r}"
    if not own.known.all():
        return "in which the module's own actions are not all known"
    if choice.rewards and not np.isfinite(episode.reward).all():
        return "without every reward"
    if choice.rewards and not episode.terminated and episode.final_obs is None:
        return "cut off, without the observation after the last action"
    return None


def _add(recorded: Recorded, episode: Episode, own: OwnActions, ahead: int) -> None:
    contract = episode.policy.contract
    recorded.own += int(own.recorded.sum())
    recorded.inverted += int((~own.recorded).sum())
    recorded.clipped += int(own.clipped.sum())
    rows = range(len(episode))
    later = [min(row + ahead, len(episode) - 1) for row in rows]
    final = episode.final_obs
    seen = [_row(contract.observation_space, episode.obs, row, "obs") for row in rows]
    # The value of what follows a terminated episode is 0, whatever it looks like.
    seen.append(seen[-1] if final is None else _row(contract.observation_space, final, 0, "obs"))
    recorded.episodes.append(
        SingleAgentEpisode(
            id_=f"{len(recorded.episodes)}",  # RLlib numbers episodes with "_" behind their ids
            observations=seen,
            actions=[_row(contract.action_space, own.leaves, row, "action") for row in later],
            rewards=[float(reward) for reward in np.nan_to_num(episode.reward)],
            infos=[{} for _ in seen],
            terminated=episode.terminated,
            truncated=not episode.terminated,
            len_lookback_buffer=0,
        )
    )


def _row(space: Any, columns: Mapping[str, Any], row: int, name: str) -> Any:
    return build_action(space, {key: leaf[row] for key, leaf in columns.items()}, name)


def through_connectors(
    episodes: Sequence[SingleAgentEpisode], env_to_module: Any, *, learn: bool = False
) -> list[SingleAgentEpisode]:
    """Return the episodes as RLlib's environment runner would have left them: what the network saw is in them.

    The pipeline's own pieces run step by step, and filters change only to `learn`. Raises UsageError for a piece that
    leaves nothing in the episode.
    """
    pieces = [piece for piece in env_to_module.connectors if type(piece).__name__ not in PLUMBING]
    for piece in pieces:
        if type(piece).__name__ in CANNOT_LEARN:
            raise errors.UsageError(f"policies behind {type(piece).__name__} cannot be learned from recordings")
        if type(piece).__name__ == "MeanStdFilter":
            private_names.replace(piece, "_update_stats", learn)
    done: list[SingleAgentEpisode] = []
    for begin in range(0, len(episodes), AT_ONCE):
        raw = episodes[begin : begin + AT_ONCE]
        if not pieces:
            done += [copy.deepcopy(episode).to_numpy() for episode in raw]
            continue
        grown = [SingleAgentEpisode(id_=one.id_) for one in raw]
        for step in range(max(map(len, raw)) + 1):
            alive = [(one, new) for one, new in zip(raw, grown, strict=True) if step <= len(one)]
            for one, new in alive:
                if step == 0:
                    new.add_env_reset(observation=one.get_observations(0), infos={})
                else:
                    last = step == len(one)
                    new.add_env_step(
                        observation=one.get_observations(step),
                        action=one.get_actions(step - 1),
                        reward=one.get_rewards(step - 1),
                        infos={},
                        terminated=last and one.is_terminated,
                        truncated=last and one.is_truncated,
                    )
            for piece in pieces:
                piece(rl_module=None, batch={}, episodes=[new for _, new in alive], explore=False, shared_data={})
        done += [episode.to_numpy() for episode in grown]
    return done


class RecordedEpisodes(OfflineData):
    """What RLlib's offline algorithms draw their minibatches from; `episodes` are to be given once it is built."""

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
