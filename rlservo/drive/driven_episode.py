"""One episode of a policy in a Gymnasium environment: the loop of `rollout` and `rlservo verify`.

```python
for index in range(20):
    episode = run_episode(env, policy, index=index, seed=index)  # episode.episode_return, .success, .steps
```
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from rlservo.bundle.contract import REWARD, Contract
from rlservo.drive.fallback import StoppedError
from rlservo.drive.success import status_of, success_of
from rlservo.errors import RlservoError, UsageError


class EpisodeEnv(Protocol):
    """The part of `gymnasium.Env` that an episode needs."""

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]: ...

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]: ...


class EpisodePolicy(Protocol):
    """The part of `ActingPolicy` that an episode needs; one whose contract has a reward input also takes `reward`."""

    @property
    def contract(self) -> Contract: ...

    def act(self, obs: Any, *, explore: bool = False, seed: int | None = None) -> Any: ...

    def reset(self) -> None: ...


@dataclass(frozen=True)
class DrivenEpisode:
    """One finished episode."""

    index: int
    seed: int | None
    steps: int
    episode_return: float
    success: bool | None  # None: the environment did not report it in this episode
    final_status: str | None


def run_episode(
    env: EpisodeEnv, policy: EpisodePolicy, *, index: int, seed: int | None, explore: bool = False
) -> DrivenEpisode:
    """Run one episode: reset both, then observe, act and step until the environment ends it.

    The environment is reset with `seed`; with `explore` it also seeds the draws of actions. `index` only names the
    episode, in the result and in errors.

    Raises UsageError when the environment fails, StoppedError when its robot waits for a person, and whatever
    `policy.act` raises, preceded by episode and step.
    """
    contract = policy.contract
    draws = np.random.default_rng(seed)  # one seed per exploratory action; unused otherwise
    policy.reset()
    obs, _ = _call(env.reset, index, 0, seed=seed)
    steps, total, reward, is_over = 0, 0.0, 0.0, False
    info: Mapping[str, Any] = {}
    while not is_over:
        action_seed = int(draws.integers(2**31)) if explore else None
        try:
            action = policy.act(obs, explore=explore, seed=action_seed, **reward_input(contract, reward))
        except RlservoError as error:
            error.prefix(f"episode {index}, step {steps}")
            raise
        obs, gain, terminated, truncated, info = _call(env.step, index, steps, _command(action))
        reward, is_over, steps = float(gain), terminated or truncated, steps + 1
        total += reward
    status = info.get("final_status")
    return DrivenEpisode(index, seed, steps, total, success_of(info), None if status is None else str(status))


def reward_input(contract: Contract, reward: float) -> dict[str, Any]:
    """Return the reward of the last action as an argument of `act`, if the policy was trained to see it."""
    return {REWARD: reward} if contract.has_reward else {}


def report_step(policy: Any, step: tuple[Any, Any, bool, bool, dict[str, Any]]) -> None:
    """Report what a step brought to a policy that takes its `outcome`: a recording, or a server that counts."""
    obs, reward, terminated, truncated, info = step
    is_over = bool(terminated or truncated)
    if hasattr(policy, "robot"):  # a recording's
        policy.robot = info.get("robot")
    if report := getattr(policy, "outcome", None):
        report(
            float(reward), terminated=bool(terminated), truncated=bool(truncated),
            final_status=status_of(info) if is_over else None, final_obs=obs if is_over else None,
        )  # fmt: skip


def _call(method: Callable[..., Any], index: int, step: int, *arguments: Any, **options: Any) -> Any:
    try:
        return method(*arguments, **options)
    except UsageError as error:
        error.prefix(f"episode {index}, step {step}")
        raise
    except Exception as error:  # an environment is third-party code
        if getattr(error, "ends_run", False):  # a real robot that waits for a person
            raise StoppedError(f"episode {index}, step {step}: {error}") from error
        is_ours = type(error).__module__.startswith("rlservo.")  # whose sentences stand alone
        reason = str(error) if is_ours else f"the environment failed with {type(error).__name__}: {error}"
        raise UsageError(f"episode {index}, step {step}: {reason}") from error


def _command(action: Any) -> Any:
    """Return the action with plain numbers for choices, also in nested parts: most environments expect them."""
    if isinstance(action, dict):
        return {key: _command(part) for key, part in action.items()}
    if isinstance(action, tuple):
        return tuple(_command(part) for part in action)
    return int(action) if action.ndim == 0 and action.dtype.kind in "iu" else action
