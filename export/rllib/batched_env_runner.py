"""RLlib's env runner for the batched connectors, without the bookkeeping that takes as long per step as they do.

RLlib (2.60) smooths eight timers at each step, counts it for Prometheus, and calls callbacks that do nothing. This one
logs, per sample, the count and the mean times of the network, the environments and the two pipelines. Episodes are the
same, bit for bit.

Checkpoints name this module and its class: under other names they could not be read.
"""

from __future__ import annotations

import logging
import time
from typing import Any

from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core.columns import Columns
from ray.rllib.env.env_errors import StepFailedRecreateEnvError
from ray.rllib.env.env_runner import NUM_ENV_STEP_FAILURES_LIFETIME
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import (
    CONNECTOR_PIPELINE_TIMER,
    ENV_STEP_TIMER,
    ENV_TO_MODULE_CONNECTOR,
    ENV_TO_MODULE_SUM_EPISODES_LENGTH_IN,
    ENV_TO_MODULE_SUM_EPISODES_LENGTH_OUT,
    MODULE_TO_ENV_CONNECTOR,
    RLMODULE_INFERENCE_TIMER,
    WEIGHTS_SEQ_NO,
)

logger = logging.getLogger(__name__)

REPLACED = (
    RLMODULE_INFERENCE_TIMER,
    ENV_STEP_TIMER,
    ENV_TO_MODULE_CONNECTOR,
    MODULE_TO_ENV_CONNECTOR,
    ENV_TO_MODULE_SUM_EPISODES_LENGTH_IN,
    ENV_TO_MODULE_SUM_EPISODES_LENGTH_OUT,
)
"""RLlib's measurements while it resets the environments; without further ones here they would never be cleared."""


class BatchedEnvRunner(SingleAgentEnvRunner):
    """Samples a number of steps with the network's actions; RLlib's own class does everything else."""

    env: Any  # typed as optional by RLlib, but not None while it samples
    module: Any
    _cached_to_module: Any
    _ongoing_episodes: list[Any]

    def _sample(
        self,
        *,
        num_timesteps: int | None = None,
        explore: bool,
        random_actions: bool = False,
        force_reset: bool = False,
        **others: Any,
    ) -> list[SingleAgentEpisode]:
        """Return episodes, or parts of them, of at least `num_timesteps` steps."""
        if num_timesteps is None or random_actions:
            return super()._sample(
                num_timesteps=num_timesteps,
                explore=explore,
                random_actions=random_actions,
                force_reset=force_reset,
                **others,
            )
        if force_reset or self._needs_initial_reset:
            self._reset_envs_and_episodes(explore)
        calls_back = self._calls_back_each_step()
        clock = time.perf_counter
        network_s = after_s = environments_s = before_s = 0.0
        rounds = steps = 0
        done: list[SingleAgentEpisode] = []
        while steps < num_timesteps:
            began = clock()
            outputs = self._infer(steps, explore)
            inferred = clock()
            outputs = self._through(self._module_to_env, outputs, explore)
            actions = outputs.pop(Columns.ACTIONS)
            for_environments = outputs.pop(Columns.ACTIONS_FOR_ENV, actions)
            decided = clock()
            results = self._step(for_environments)
            stepped = clock()
            if results is None:
                steps = 0
                self._reset_envs_and_episodes(explore)
                continue
            episodes = self._ongoing_episodes
            started = [index for index, episode in enumerate(episodes) if not episode.is_reset]
            self._add(episodes, actions, outputs, results)
            steps += len(episodes) - len(started)
            rounds += 1
            added = clock()
            self._cached_to_module = self._through(self._env_to_module, {}, explore)
            before_s += clock() - added
            network_s += inferred - began
            after_s += decided - inferred
            environments_s += stepped - decided
            for index in range(len(episodes)):
                if index in started:
                    self._make_on_episode_callback("on_episode_start", index, episodes)
                elif calls_back:
                    self._make_on_episode_callback("on_episode_step", index, episodes)
                if episodes[index].is_done:
                    self._make_on_episode_callback("on_episode_end", index, episodes)
                    done.append(self._to_return(episodes[index]))
                    self._new_episode(index, episodes)  # type: ignore[no-untyped-call]
        for key in REPLACED:
            self.metrics.delete((key,), key_error=False)
        for path, seconds in (
            ((RLMODULE_INFERENCE_TIMER,), network_s),
            ((MODULE_TO_ENV_CONNECTOR, CONNECTOR_PIPELINE_TIMER), after_s),
            ((ENV_STEP_TIMER,), environments_s),
            ((ENV_TO_MODULE_CONNECTOR, CONNECTOR_PIPELINE_TIMER), before_s),
        ):
            self.metrics.log_value(path, seconds / max(rounds, 1))
        self._done_episodes_for_metrics.extend(done)
        self._log_env_steps(metric=self._metrics_num_try_env_step, num_steps=rounds)
        self._log_env_steps(metric=self._metrics_num_env_steps_sampled, num_steps=steps)
        self._increase_sampled_metrics(steps, len(done))  # type: ignore[no-untyped-call]
        return done + self._cut()

    def _infer(self, steps: int, explore: bool) -> dict[str, Any]:
        if not explore:
            return self.module.forward_inference(self._cached_to_module)  # type: ignore[no-any-return]
        runners = self.config.num_env_runners or 1
        of_all_runners = (self.num_env_steps_sampled_lifetime // runners + steps) * runners
        return self.module.forward_exploration(self._cached_to_module, t=of_all_runners)  # type: ignore[no-any-return]

    def _step(self, actions: Any) -> Any:
        """Return the environments' results, or None if one failed and all are recreated, as RLlib does it."""
        try:
            return self.env.step(actions)
        except Exception as error:
            self.metrics.log_value(NUM_ENV_STEP_FAILURES_LIFETIME, 1, reduce="lifetime_sum")
            if not self.config.restart_failed_sub_environments:
                raise
            if not isinstance(error, StepFailedRecreateEnvError):
                logger.exception("an environment's step failed: all environments of this runner are recreated")
            self.make_env()
            return None

    def _through(self, pipeline: Any, batch: dict[str, Any], explore: bool) -> dict[str, Any]:
        for piece in pipeline.connectors:
            batch = piece(
                rl_module=self.module,
                batch=batch,
                episodes=self._ongoing_episodes,
                explore=explore,
                shared_data=self._shared_data,
            )
        return batch

    def _add(self, episodes: list[Any], actions: Any, outputs: dict[str, Any], results: Any) -> None:
        observations, rewards, terminateds, truncateds, infos = results
        for index, episode in enumerate(episodes):
            if not episode.is_reset:  # the vector has reset this one instead of stepping it
                episode.add_env_reset(observation=observations[index], infos=infos[index])
                continue
            of_module = {name: values[index] for name, values in outputs.items()}
            of_module[WEIGHTS_SEQ_NO] = self._weights_seq_no
            episode.add_env_step(
                observation=observations[index],
                action=actions[index],
                reward=rewards[index],
                infos=infos[index],
                terminated=terminateds[index],
                truncated=truncateds[index],
                extra_model_outputs=of_module,
            )

    def _cut(self) -> list[SingleAgentEpisode]:
        """Return the present parts of unfinished episodes, and let them continue."""
        parts = self._ongoing_episodes
        lookback = self.config.episode_lookback_horizon
        self._ongoing_episodes = [part.cut(len_lookback_buffer=lookback) for part in parts]
        parts = [part for part in parts if part.t > 0]
        for part in parts:
            part.validate()
            self._ongoing_episodes_for_metrics[part.id_].append(part)
        return [self._to_return(part) for part in parts]

    def _to_return(self, episode: SingleAgentEpisode) -> SingleAgentEpisode:
        return episode.to_numpy() if self.episodes_to_numpy else episode

    def _calls_back_each_step(self) -> bool:
        """Return whether `on_episode_step` does anything."""
        return bool(self.config.callbacks_on_episode_step) or any(
            type(one).on_episode_step is not RLlibCallback.on_episode_step for one in self._callbacks
        )
