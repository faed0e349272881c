"""Recorded episodes as RLlib's `SingleAgentEpisode`, passed through a checkpoint's own connectors.

Used by offline training (`examples/learn_from_recordings.py`) and by `rlservo learn`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns as Column
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from rlservo.bundle.nested import build_action
from rlservo.errors import UsageError
from rlservo.export.rllib import private_names
from rlservo.export.rllib.new_stack.connectors import PLUMBING
from rlservo.recording.episodes import Columns, RecordedEpisode

AT_ONCE = 256  # episodes per pass of a pipeline
CANNOT_LEARN = ("FrameStacking",)
"""Connector pieces that add nothing to the episode, so that a learner would need a second one."""


def why_not_whole(episode: RecordedEpisode) -> str | None:
    """Return the missing part of an episode; None if it is whole."""
    if not episode.id or not episode.begins or episode.gap is not None:
        return "without their beginning or with a gap"
    if episode.goes_on:
        return "too long to be read in one piece"
    return None if episode.ended else "without an end"


def why_without_reward(episode: RecordedEpisode, rewards: NDArray[np.float64]) -> str | None:
    """Return the reason why an episode's return is unknown, or None."""
    if not (np.abs(rewards) <= np.finfo(np.float32).max).all():  # the learner computes in float32
        return "without every reward"
    if not episode.terminated and episode.final_obs is None:
        return "cut off, without the observation after the last action"
    return None


def single_agent_episode(
    episode: RecordedEpisode,
    own: Columns,
    rewards: NDArray[np.float64],
    *,
    id_: str,
    ahead: int = 0,
    with_distribution: bool = False,
) -> SingleAgentEpisode:
    """Return a whole episode in RLlib's form as from `env.step`, not yet passed through connectors.

    `own` are the module's own actions, leaves `[rows, *shape]`; row i + `ahead` belongs to observation i. With
    `with_distribution` the episode also has the acting module's other outputs: `action_logp`, `action_dist_inputs`.
    """
    contract = episode.policy.contract
    rows = range(len(episode))
    final = episode.final_obs
    seen = [row_of(contract.observation_space, episode.obs, row, "obs") for row in rows]
    # The value after a terminated episode is 0, whatever the observation.
    seen.append(seen[-1] if final is None else row_of(contract.observation_space, final, 0, "obs"))
    extra: dict[str, Any] = {}
    if with_distribution:
        extra = {
            Column.ACTION_LOGP: list(episode.logp.astype(np.float32)),
            Column.ACTION_DIST_INPUTS: list(episode.dist_inputs),
        }
    later = [min(row + ahead, len(episode) - 1) for row in rows]
    return SingleAgentEpisode(
        id_=id_,
        observations=seen,
        actions=[row_of(contract.action_space, own, row, "action") for row in later],
        rewards=[float(reward) for reward in np.nan_to_num(rewards)],
        infos=[{} for _ in seen],
        extra_model_outputs=extra,
        terminated=episode.terminated,
        truncated=not episode.terminated,
        len_lookback_buffer=0,
    )


def row_of(space: Any, columns: Mapping[str, Any], row: int, name: str) -> Any:
    """Return one row of a space's leaves in the space's own form."""
    return build_action(space, {key: leaf[row] for key, leaf in columns.items()}, name)


def through_connectors(
    episodes: Sequence[SingleAgentEpisode], env_to_module: Any, *, learn: bool = False
) -> list[SingleAgentEpisode]:
    """Return the episodes in the form that RLlib's environment runner gives, with the network's observations.

    The pipeline's own pieces run step by step, and filters are updated only with `learn`. Raises UsageError for a piece
    that adds nothing to the episode.
    """
    pieces = [piece for piece in env_to_module.connectors if type(piece).__name__ not in PLUMBING]
    for piece in pieces:
        if type(piece).__name__ in CANNOT_LEARN:
            raise UsageError(f"policies with the connector {type(piece).__name__} cannot learn from recordings")
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
                        extra_model_outputs={
                            name: one.get_extra_model_outputs(name, step - 1) for name in one.extra_model_outputs
                        },
                    )
            for piece in pieces:
                piece(rl_module=None, batch={}, episodes=[new for _, new in alive], explore=False, shared_data={})
        done += [episode.to_numpy() for episode in grown]
    return done
