"""The batched connectors' env runner against RLlib's own: episodes, callbacks, failures, timers."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from ray.rllib.algorithms import PPOConfig
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from rlservo.export.rllib import batched_connectors
from rlservo.export.rllib.batched_connectors import use_batched_connectors
from rlservo.export.rllib.batched_env_runner import BatchedEnvRunner

STEPS = 130  # of a sample: CartPole's episodes end and are cut in it


class Slippery(CartPoleEnv):
    """CartPole whose 40th step fails, once."""

    steps = 0

    def __init__(self, **_arguments: Any) -> None:
        super().__init__()

    def step(self, action: Any) -> Any:
        Slippery.steps += 1
        if Slippery.steps == 40:
            raise OSError("the cart slipped")
        return super().step(action)  # type: ignore[no-untyped-call]


gymnasium.register("Slippery-v0", Slippery)


def runner(kind: type, config: Any | None = None, env: str = "CartPole-v1") -> Any:
    """Return a runner of either kind with the batched connectors, with fresh random state."""
    config = config or PPOConfig()
    config.environment(env).env_runners(num_env_runners=0, num_envs_per_env_runner=2, env_runner_cls=kind)
    use_batched_connectors(config.debugging(seed=3), observation_filter=True)
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(3)
    Slippery.steps = 0
    assert config.env_runner_cls is kind
    return kind(config=config, worker_index=0)


def in_bytes(episodes: list[Any]) -> list[Any]:
    return [
        (each.t_started, each.is_done, *(np.asarray(part).tobytes() for part in parts))
        for each in episodes
        for parts in [
            (
                each.get_observations(),
                each.get_actions(),
                each.get_rewards(),
                *(np.asarray(values.data) for _, values in sorted(each.extra_model_outputs.items())),
            )
        ]
    ]


def test_the_connectors_bring_their_runner_unless_the_configuration_has_one() -> None:
    config = PPOConfig()
    use_batched_connectors(config, observation_filter=False)
    assert config.env_runner_cls is BatchedEnvRunner
    assert type(runner(SingleAgentEnvRunner)) is SingleAgentEnvRunner


@pytest.mark.parametrize(
    "asked",
    [
        {"num_timesteps": STEPS, "explore": True},
        {"num_timesteps": STEPS, "explore": False},
        {"num_timesteps": STEPS, "explore": True, "force_reset": True},
        {"num_timesteps": STEPS, "random_actions": True},
        {"num_episodes": 3, "explore": True},
    ],
)
def test_whatever_is_asked_for_is_sampled_as_rllib_does(asked: dict[str, Any]) -> None:
    sampled = []
    for kind in (SingleAgentEnvRunner, BatchedEnvRunner):
        one = runner(kind)
        if asked.get("random_actions"):
            one.env.action_space.seed(3)
        sampled.append([in_bytes(one.sample(**asked)) for _ in range(3)])
    theirs, ours = sampled
    assert ours == theirs
    assert sum(map(len, ours)) > 6


def test_the_check_of_how_actions_are_drawn_leaves_the_random_numbers_as_they_are() -> None:
    torch.manual_seed(5)
    expected = torch.randn(4)
    torch.manual_seed(5)
    batched_connectors.draws_the_same.__wrapped__()
    assert torch.equal(torch.randn(4), expected)


def test_callbacks_are_called_as_by_rllib() -> None:
    def noting(calls: list[Any]) -> type[RLlibCallback]:
        def note(which: str) -> Callable[..., None]:
            def called(_self: Any, *, episode: Any, env_index: int, **_: Any) -> None:
                calls.append((which, env_index, episode.t, episode.is_done))

            return called

        events = ("created", "start", "step", "end")
        return type("Noting", (RLlibCallback,), {f"on_episode_{event}": note(event) for event in events})

    heard: list[list[Any]] = [[], []]
    for calls, kind in zip(heard, (SingleAgentEnvRunner, BatchedEnvRunner), strict=True):
        one = runner(kind, PPOConfig().callbacks(noting(calls)))
        one.sample(num_timesteps=STEPS, explore=True)
        one.sample(num_timesteps=STEPS, explore=True)
    assert heard[0] == heard[1]
    assert {which for which, *_ in heard[1]} == {"created", "start", "step", "end"}


def test_after_a_failed_step_the_environments_are_made_anew_as_by_rllib() -> None:
    sampled = []
    for kind in (SingleAgentEnvRunner, BatchedEnvRunner):
        config = PPOConfig().fault_tolerance(restart_failed_sub_environments=True)
        one = runner(kind, config, "Slippery-v0")
        sampled.append([in_bytes(one.sample(num_timesteps=STEPS, explore=True)) for _ in range(2)])
        assert one.metrics.peek("num_env_step_failures") == 1
    assert sampled[0] == sampled[1]


def test_a_failed_step_ends_the_sampling_where_rllib_is_not_to_go_on() -> None:
    with pytest.raises(OSError, match="the cart slipped"):
        runner(BatchedEnvRunner, None, "Slippery-v0").sample(num_timesteps=STEPS, explore=True)


def test_its_metrics_are_those_of_rllib_without_the_pieces_times() -> None:
    found = []
    for kind in (SingleAgentEnvRunner, BatchedEnvRunner):
        one = runner(kind)
        one.sample(num_timesteps=STEPS, explore=True)
        one.sample(num_timesteps=STEPS, explore=True)
        found.append(one.get_metrics())
    theirs, ours = found
    assert set(theirs) - set(ours) == {"env_to_module_sum_episodes_length_in", "env_to_module_sum_episodes_length_out"}
    assert set(ours) <= set(theirs)
    for name in ("num_env_steps_sampled", "num_episodes", "episode_return_mean", "episode_len_mean"):
        assert float(ours[name].peek()) == float(theirs[name].peek()), name
    for name in ("rlmodule_inference_timer", "env_step_timer"):
        assert 0.0 < float(ours[name].peek()) < 0.1, name
    for name in ("env_to_module_connector", "module_to_env_connector"):
        assert list(ours[name]) == ["connector_pipeline_timer"], "a reset's times would stay"
        assert 0.0 < float(ours[name]["connector_pipeline_timer"].peek()) < 0.1, name
