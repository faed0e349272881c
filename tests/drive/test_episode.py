"""`run_episode`: one episode of anything that acts, as `rollout` and `rlservo verify` run it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rlservo.bundle.contract import REWARD, Contract, TensorSpec
from rlservo.drive.driven_episode import DrivenEpisode, run_episode
from rlservo.errors import ActionError, UsageError
from rlservo.robots.argument_checks import InvalidResetError


class Countdown:
    """An environment of Gymnasium's form and none of its classes: three steps, each worth its number."""

    def __init__(self, broken: type[Exception] | None = None) -> None:
        self.seed: int | None = None
        self.actions: list[Any] = []
        self.broken = broken

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        self.seed, self.actions = seed, []
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.broken is not None:
            raise self.broken("the floor gave way")
        self.actions.append(action)
        count = len(self.actions)
        return np.zeros(3, np.float32), np.float64(count), count == 3, False, {"final_status": "success"}


class Damper:
    """Brakes a pendulum."""

    contract = Contract.model_construct(inputs=())

    def act(self, obs: Any, *, explore: bool = False, seed: int | None = None) -> Any:
        return np.clip(-obs[2:], -2.0, 2.0)

    def reset(self) -> None: ...


class Chooser:
    """A policy that sees its reward and chooses."""

    contract = Contract.model_construct(inputs=(TensorSpec(name=REWARD, dtype="float32", shape=(-1,)),))

    def __init__(self) -> None:
        self.rewards: list[float] = []
        self.seeds: list[int | None] = []

    def act(self, obs: Any, *, explore: bool = False, seed: int | None = None, reward: float = -1.0) -> Any:
        self.rewards.append(reward)
        self.seeds.append(seed)
        return np.array(len(self.rewards), np.int64)

    def reset(self) -> None:
        self.rewards, self.seeds = [], []


def test_episode_passes_rewards_on_and_gives_choices_as_plain_numbers() -> None:
    env, policy = Countdown(), Chooser()
    episode = run_episode(env, policy, index=4, seed=11)
    assert episode == DrivenEpisode(4, 11, steps=3, episode_return=6.0, success=True, final_status="success")
    assert policy.rewards == [0.0, 1.0, 2.0]
    assert policy.seeds == [None, None, None]
    assert (env.seed, env.actions, type(env.actions[0])) == (11, [1, 2, 3], int)


def test_exploring_draws_follow_from_the_episodes_seed() -> None:
    def seeds(seed: int) -> list[int | None]:
        policy = Chooser()
        run_episode(Countdown(), policy, index=0, seed=seed, explore=True)
        return policy.seeds

    assert seeds(5) == seeds(5) != seeds(6)
    assert len(set(seeds(5))) == 3


def test_errors_name_episode_and_step_and_stay_what_they_are() -> None:
    error = ActionError("it is not finite", {"element": [0]})

    class Refuser(Damper):
        def act(self, obs: Any, *, explore: bool = False, seed: int | None = None) -> Any:
            raise error

    with pytest.raises(ActionError, match=r"^episode 2, step 0: it is not finite$") as caught:
        run_episode(Countdown(), Refuser(), index=2, seed=0)
    assert caught.value is error and error.details == {"element": [0]}
    with pytest.raises(UsageError, match="episode 0, step 0: the environment failed with OSError: the floor gave way"):
        run_episode(Countdown(OSError), Chooser(), index=0, seed=0)
    with pytest.raises(UsageError, match=r"^episode 0, step 0: the floor gave way$"):
        run_episode(Countdown(InvalidResetError), Chooser(), index=0, seed=0)


def test_return_is_gymnasiums_own_sum() -> None:
    policy, env = Damper(), gym.make("Pendulum-v1")
    obs, _ = env.reset(seed=3)
    total, ended = 0.0, False
    while not ended:
        obs, reward, terminated, truncated, _ = env.step(policy.act(obs))
        total, ended = total + float(reward), terminated or truncated
    assert run_episode(env, policy, index=0, seed=3).episode_return == pytest.approx(total, rel=1e-12)
