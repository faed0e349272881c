"""The batched connectors beside RLlib's own: what a runner samples, and what it keeps."""

from __future__ import annotations

import random
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from ray.rllib.algorithms import DQNConfig, PPOConfig, SACConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from rlservo.export.contract.errors import UsageError
from rlservo.export.rllib.batched_connectors import batched_connectors, fit


def runner(config: Any, env: str, envs: int, **connectors: Any) -> Any:
    config.environment(env).env_runners(num_env_runners=0, num_envs_per_env_runner=envs, **connectors).debugging(seed=3)
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(3)
    return SingleAgentEnvRunner(config=config, worker_index=0)


def sampled(one: Any, explore: bool) -> list[Any]:
    episodes = [episode for _ in range(2) for episode in one.sample(num_timesteps=250, explore=explore)]
    columns = [
        (each.get_observations(), each.get_actions(), each.get_rewards(), each.extra_model_outputs) for each in episodes
    ]
    spaces = [each.observation_space for each in episodes]
    state = one._env_to_module.get_state()
    return [spaces, *columns, state]


def in_bytes(tree: Any) -> Any:
    """Return a structure that is equal only where types, shapes and all bits are."""
    if isinstance(tree, dict):
        return {key: in_bytes(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [in_bytes(one) for one in tree]
    if isinstance(tree, np.ndarray | np.generic):
        return (str(tree.dtype), tree.shape, tree.tobytes())
    return in_bytes(np.asarray(tree.data)) if hasattr(tree, "lookback") else tree


@pytest.mark.parametrize(
    ("kind", "env", "envs", "filtered", "explore"),
    [
        (PPOConfig, "Pendulum-v1", 3, True, True),
        (PPOConfig, "Pendulum-v1", 1, False, False),
        (PPOConfig, "CartPole-v1", 3, True, True),
        (SACConfig, "Pendulum-v1", 2, True, True),
        (DQNConfig, "CartPole-v1", 2, False, True),
    ],
)
def test_a_runner_samples_the_same_bit_by_bit(kind: Any, env: str, envs: int, filtered: bool, explore: bool) -> None:
    rllib: dict[str, Any] = {"env_to_module_connector": lambda *_: MeanStdFilter()} if filtered else {}
    theirs = sampled(runner(kind(), env, envs, **rllib), explore)
    ours = sampled(runner(kind(), env, envs, **batched_connectors(observation_filter=filtered)), explore)
    assert in_bytes(ours) == in_bytes(theirs)
    assert filtered == ("MeanStdFilter" in ours[-1])


def test_actions_are_clipped_where_they_are_not_scaled() -> None:
    settings = {"normalize_actions": False, "clip_actions": True}
    theirs = sampled(runner(PPOConfig().environment(**settings), "Pendulum-v1", 2), True)
    ours = batched_connectors(observation_filter=False, **settings)
    assert in_bytes(sampled(runner(PPOConfig(), "Pendulum-v1", 2, **ours), True)) == in_bytes(theirs)


def test_what_does_not_fit_is_refused_by_name() -> None:
    spaces = gymnasium.spaces
    assert fit(spaces.Box(-1, 1, (3,)), spaces.Discrete(2))
    assert not fit(spaces.Dict(), spaces.Discrete(2)) and not fit(spaces.Box(-1, 1, (3,)), spaces.Dict())
    own = batched_connectors(observation_filter=True)
    with pytest.raises(UsageError, match=r"observations are Discrete\(16\): the batched connectors take a Box"):
        runner(PPOConfig(), "FrozenLake-v1", 1, **own)
    memory = PPOConfig().rl_module(model_config=DefaultModelConfig(use_lstm=True, max_seq_len=4))
    with pytest.raises(UsageError, match="has a memory"):
        runner(memory, "CartPole-v1", 1, **own).sample(num_timesteps=2)


def test_a_ray_whose_filter_is_another_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MeanStdFilter, "__init__", lambda self, **_: None)
    with pytest.raises(UsageError, match=r"^Ray [\d.]+'s filter has no _filters and no _update_stats: use RLlib's"):
        runner(PPOConfig(), "Pendulum-v1", 1, **batched_connectors(observation_filter=True))
