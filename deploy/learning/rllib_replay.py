"""Replay buffer of an off-policy learner: transitions of the newest episodes, drawn as in RLlib's own algorithms.

Transitions are drawn uniformly, even if the checkpoint's configuration asks for priorities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.replay_buffers.episode_replay_buffer import EpisodeReplayBuffer


class ReplayBuffer:
    """Episodes as the network saw them, up to the configuration's capacity in steps."""

    def __init__(self, config: Any) -> None:
        """Take the sizes from an off-policy algorithm's configuration."""
        self._config = config
        self._buffer = EpisodeReplayBuffer(capacity=int(config.replay_buffer_config["capacity"]))

    @property
    def missing(self) -> int:
        """Number of steps still missing before learning starts, by the configuration."""
        return max(0, int(self._config.num_steps_sampled_before_learning_starts) - self._buffer.get_num_timesteps())

    def add(self, episodes: Sequence[SingleAgentEpisode]) -> None:
        """Add the newest episodes; the oldest beyond the capacity are dropped."""
        self._buffer.add(list(episodes))

    def forget(self, count: int) -> None:
        """Drop the newest `count` episodes."""
        kept = list(self._buffer.episodes)[:-count]
        self._buffer = EpisodeReplayBuffer(capacity=self._buffer.capacity)
        self._buffer.add(kept)

    def updates(self, steps: int) -> int:
        """Return the number of updates for this many new steps: by `training_intensity`, or one per sampling."""
        config = self._config
        sampled = config.get_rollout_fragment_length() * config.num_envs_per_env_runner * max(1, config.num_env_runners)
        per_step: float = (config.training_intensity or 0) / config.total_train_batch_size or 1 / sampled
        return max(1, round(steps * per_step))

    def draw(self) -> Any:
        """Return the transitions of one update, each an episode of one step."""
        config = self._config
        drawn: Any = self._buffer.sample(
            num_items=config.total_train_batch_size, n_step=config.n_step, batch_length_T=0, gamma=config.gamma,
            sample_episodes=True,
        )  # fmt: skip
        return drawn
