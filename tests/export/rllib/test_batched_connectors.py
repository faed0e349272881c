"""The batched connectors against RLlib's own: samples and state of a runner."""

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
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.filter import RunningStat

from rlservo.errors import UsageError
from rlservo.export.rllib import batched_connectors
from rlservo.export.rllib.batched_connectors import check_filter, supports, use_batched_connectors


def runner(config: Any, env: str, envs: int, *, batched: bool, filtered: bool = False, **frames: int) -> Any:
    config.environment(env).env_runners(num_env_runners=0, num_envs_per_env_runner=envs).debugging(seed=3)
    if batched:
        use_batched_connectors(config, observation_filter=filtered, **frames)
    elif filtered:
        config.env_runners(env_to_module_connector=lambda *_: MeanStdFilter())
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(3)
    return (config.env_runner_cls or SingleAgentEnvRunner)(config=config, worker_index=0)


def connectors_of(one: Any) -> Any:
    """Return the state of a runner's pipeline before its network."""
    return one.get_state(components="env_to_module_connector")["env_to_module_connector"]


def filter_state(one: Any) -> dict[str, Any]:
    """Return what a runner's pipeline keeps, but for what is new in it: RLlib's is wrong (below)."""
    state = connectors_of(one)
    for stats in (stats for piece in state.values() for stats in piece.get(None, {}).get("running_stats", ())):
        for name in [name for name in stats if "delta" in name]:
            del stats[name]
    return state  # type: ignore[no-any-return]


def sampled(one: Any, explore: bool) -> list[Any]:
    episodes = [episode for _ in range(2) for episode in one.sample(num_timesteps=250, explore=explore)]
    columns = [
        (each.get_observations(), each.get_actions(), each.get_rewards(), each.extra_model_outputs) for each in episodes
    ]
    spaces = [each.observation_space for each in episodes]
    return [spaces, *columns, filter_state(one)]


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
    theirs, ours = (
        sampled(runner(kind(), env, envs, batched=batched, filtered=filtered), explore) for batched in (False, True)
    )
    assert in_bytes(ours) == in_bytes(theirs)
    assert filtered == ("MeanStdFilter" in ours[-1])


def test_actions_are_drawn_by_rllib_where_its_arithmetic_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    assert batched_connectors.draws_the_same()
    expected = in_bytes(sampled(runner(PPOConfig(), "Pendulum-v1", 2, batched=True), True))
    monkeypatch.setattr(batched_connectors, "HALF_LOG_OF_TWO_PI", 1.0)
    batched_connectors.draws_the_same.cache_clear()
    try:
        assert not batched_connectors.draws_the_same()
        assert in_bytes(sampled(runner(PPOConfig(), "Pendulum-v1", 2, batched=True), True)) == expected
    finally:
        batched_connectors.draws_the_same.cache_clear()


def test_runners_are_merged_to_the_statistics_of_all_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    check_filter()  # which pushes numbers of its own
    seen: list[Any] = []
    push = batched_connectors.push

    def noting(stats: RunningStat, row: Any) -> None:
        seen.append(np.array(row, np.float64))
        push(stats, row)

    monkeypatch.setattr(batched_connectors, "push", noting)
    runners = [runner(PPOConfig(), "MountainCarContinuous-v0", 2, batched=True, filtered=True) for _ in range(2)]
    pipeline = runners[0].config.build_env_to_module_connector(env=runners[0].env, spaces=runners[0].spaces)
    for count in (50, 200, 3, 1000):
        for one in runners:
            one.sample(num_timesteps=count)
        merged = pipeline.merge_states([connectors_of(one) for one in runners])
        pipeline.set_state(merged)
        for one in runners:
            one.set_state({"env_to_module_connector": merged})
        (state,) = merged["MeanStdFilter"][None]["running_stats"]
        stats = RunningStat.from_state(state)
        assert stats.num_pushes == len(seen)
        np.testing.assert_allclose(stats.mean_array, np.mean(seen, axis=0), rtol=1e-9)
        np.testing.assert_allclose(stats.std, np.std(seen, axis=0, ddof=1), rtol=1e-6)


@pytest.mark.parametrize("filtered", [True, False])
def test_frames_are_those_of_the_episode_so_far_also_where_it_is_cut(filtered: bool) -> None:
    one = runner(PPOConfig(), "CartPole-v1", 3, batched=True, filtered=filtered, num_frames=3, every=2)
    chunks: dict[str, list[Any]] = {}
    for _ in range(30):
        for chunk in one.sample(num_timesteps=7):
            rows = chunk.get_observations()
            chunks.setdefault(chunk.id_, []).append(rows if chunk.t_started == 0 else rows[1:])
    compared = 0
    for parts in chunks.values():
        rows = np.concatenate(parts)
        assert rows.shape[1] == 12 and rows.dtype == np.float32
        frames = np.vstack([np.zeros((4, 4), np.float32), rows[:, 8:]])
        np.testing.assert_array_equal(rows, np.hstack([frames[:-4], frames[2:-2], frames[4:]]))
        compared += len(parts) > 2
    assert compared > 3, "too few episodes were cut"
    assert one.module.observation_space.shape == (12,)


def test_logarithms_are_taken_of_the_elements_that_were_asked_for() -> None:
    space = gymnasium.spaces.Box(np.array([-1, 0, 0], np.float32), np.array([1, 29, np.inf], np.float32))
    piece = batched_connectors.Logarithm(space, gymnasium.spaces.Discrete(2), elements=(1, 2))
    low, high = piece.observation_space.low, piece.observation_space.high
    np.testing.assert_allclose(low, [-1.0, np.log(0.05), np.log(0.05)], rtol=1e-6)
    np.testing.assert_allclose(high, [1.0, np.log(29.0), np.inf], rtol=1e-6)
    episode = SingleAgentEpisode(observation_space=space, observations=[np.array([0.5, 2.0, 0.01], np.float32)])
    piece(batch={}, episodes=[episode])
    np.testing.assert_allclose(episode.get_observations(-1), [0.5, np.log(2.0), np.log(0.05)], rtol=1e-6)
    with pytest.raises(UsageError, match="logarithm of element 3: observations have elements 0 to 2"):
        batched_connectors.Logarithm(space, gymnasium.spaces.Discrete(2), elements=(1, 3))


def test_angles_become_sines_in_their_place_and_cosines_at_the_end() -> None:
    space = gymnasium.spaces.Box(np.array([-np.pi, 0, -np.pi], np.float32), np.array([np.pi, 29, np.pi], np.float32))
    piece = batched_connectors.SineAndCosine(space, gymnasium.spaces.Discrete(2), elements=(0, 2))
    np.testing.assert_array_equal(piece.observation_space.low, np.float32([-1, 0, -1, -1, -1]))
    np.testing.assert_array_equal(piece.observation_space.high, np.float32([1, 29, 1, 1, 1]))
    seen = np.array([3.0, 7.0, -0.5], np.float32)
    episode = SingleAgentEpisode(observation_space=space, observations=[seen.copy()])
    piece(batch={}, episodes=[episode])
    expected = [np.sin(3.0), 7.0, np.sin(-0.5), np.cos(3.0), np.cos(-0.5)]
    np.testing.assert_allclose(episode.get_observations(-1), expected, rtol=1e-6)
    assert episode.get_observations(-1).dtype == np.float32
    behind = [piece.changed(np.array([angle, 7.0, 0.0], np.float32)) for angle in (np.pi, -np.pi)]
    np.testing.assert_allclose(*behind, atol=1e-6)
    with pytest.raises(UsageError, match="sine of element 3: observations have elements 0 to 2"):
        batched_connectors.SineAndCosine(space, gymnasium.spaces.Discrete(2), elements=(3,))


def test_images_are_not_stacked_as_vectors() -> None:
    image = gymnasium.spaces.Box(0.0, 1.0, (8, 8, 1))
    with pytest.raises(UsageError, match=r"only frames of vectors are stacked here; RLlib's FrameStacking stacks"):
        batched_connectors.FrameStacking(image, gymnasium.spaces.Discrete(2), num_frames=2)


def test_actions_are_clipped_where_they_are_not_scaled() -> None:
    theirs, ours = (
        sampled(
            runner(
                PPOConfig().environment(normalize_actions=False, clip_actions=True), "Pendulum-v1", 2, batched=batched
            ),
            True,
        )
        for batched in (False, True)
    )
    assert in_bytes(ours) == in_bytes(theirs)


def test_what_does_not_fit_is_refused_by_name() -> None:
    spaces = gymnasium.spaces
    assert supports(spaces.Box(-1, 1, (3,)), spaces.Discrete(2))
    assert not supports(spaces.Dict(), spaces.Discrete(2)) and not supports(spaces.Box(-1, 1, (3,)), spaces.Dict())
    with pytest.raises(UsageError, match=r"observations are Discrete\(16\): the batched connectors take a Box"):
        runner(PPOConfig(), "FrozenLake-v1", 1, batched=True, filtered=True)
    memory = PPOConfig().rl_module(model_config=DefaultModelConfig(use_lstm=True, max_seq_len=4))
    with pytest.raises(UsageError, match="has memory"):
        runner(memory, "CartPole-v1", 1, batched=True).sample(num_timesteps=2)


@pytest.mark.parametrize("change", ["push", "std"])
def test_a_ray_that_filters_in_another_way_is_refused(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RunningStat, change, lambda *_: 1.0)
    check_filter.cache_clear()
    try:
        with pytest.raises(UsageError, match=r"^Ray [\d.]+ filters observations differently"):
            runner(PPOConfig(), "Pendulum-v1", 1, batched=True, filtered=True)
    finally:
        check_filter.cache_clear()
