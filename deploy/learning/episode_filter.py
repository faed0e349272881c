"""Admission of recorded episodes to learning: whole, explored, of a known version and within its contract.

Others are dropped and counted by reason. A client cannot pass off its own action as the policy's: the server records
its draws, and the graph and contract they came from must be this run's.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.action_transform import to_sent, transform_of
from rlservo.bundle.spaces import leaf_specs
from rlservo.deploy.learning.rllib_episodes import row_of, why_not_whole, why_without_reward
from rlservo.errors import UsageError, first_line
from rlservo.recording.episodes import Columns, RecordedEpisode
from rlservo.recording.unsquashed_actions import is_sent_as

LOGP_TOLERANCE = 1e-4
"""Tolerance of a recorded log-probability against its own distribution's: both come from the same float32."""

Reward: TypeAlias = Callable[[Any, Any, Any], "float | tuple[float, bool]"]
"""Reward of an action: `reward(obs, action, next_obs)`, each in its space's own form; optionally with whether the
episode ends there."""


@dataclass(frozen=True)
class KnownVersion:
    """A version made by this run, with its identity in a server's recordings."""

    version: str
    graph_sha256: str
    contract_sha256: str


@dataclass(frozen=True)
class Admitted:
    """An episode to learn from."""

    episode: RecordedEpisode
    version: KnownVersion
    age: int
    """Number of versions released since the one that acted."""
    rewards: NDArray[np.float64]


class EpisodeFilter:
    """Judges episodes one by one."""

    def __init__(self, policy: str, *, max_age: int, reward: Reward | None = None) -> None:
        """Take the settings; `reward` replaces the rewards that clients report."""
        self._policy, self.max_age, self._reward = policy, max_age, reward

    def judge(
        self, episode: RecordedEpisode, versions: Sequence[KnownVersion], *, any_age: bool = False
    ) -> list[Admitted | str]:
        """Return a recorded episode, or the reason to drop it; nothing of another policy. `versions`: newest last.

        It is in parts where the reward function ends one.
        """
        contract = episode.policy.contract
        if contract.name != self._policy:
            return []
        place = next((i for i, known in enumerate(versions) if known.version == contract.version), None)
        if place is None:
            return ["of a version that this run did not make"]
        known, age = versions[place], len(versions) - 1 - place
        if (episode.policy.graph_hash, episode.policy.contract_hash) != (known.graph_sha256, known.contract_sha256):
            return ["whose graph or contract is not the version's"]
        if age > self.max_age and not any_age:
            return ["of a version that is too old"]
        not_drawn, parts = _why_not_drawn(episode), [(episode, episode.reward)]
        if self._reward is not None and not (not_drawn or episode.goes_on or episode.gap is not None):
            parts = _rewarded(episode, self._reward)
        verdicts: list[Admitted | str] = []
        for part, rewards in parts:
            reason = why_not_whole(part) or not_drawn or why_without_reward(part, rewards)
            verdicts.append(reason or Admitted(part, known, age, rewards))
        return verdicts


def _why_not_drawn(episode: RecordedEpisode) -> str | None:
    """Return the reason why an episode's actions are not the policy's own draws from its observations."""
    if not episode.may_teach:
        return "with reports from a key without the role explore"
    if not episode.explored.all():
        return "in which not every action explored"
    if not episode.acted.all() or episode.fell_back.any():
        return "in which a fallback acted"
    seen = [*episode.obs.values(), *(() if episode.final_obs is None else episode.final_obs.values())]
    if not all(np.isfinite(leaf).all() for leaf in seen):
        return "with an observation that is not finite"
    if not np.isfinite(episode.logp).all():
        return "without every log-probability"
    logp = episode.policy.log_probability(episode.dist_inputs, episode.own_action)
    if logp is None or not (np.abs(logp - episode.logp) <= LOGP_TOLERANCE * np.maximum(1.0, np.abs(logp))).all():
        return "whose log-probabilities do not match their distributions"
    return _why_not_sent(episode)


def _why_not_sent(episode: RecordedEpisode) -> str | None:
    """Return the fault of the sent actions. A step limit may have changed them: it counts as part of the environment,
    like clipping, and the own action is learned.
    """
    contract = episode.policy.contract
    transform, is_limited = transform_of(contract), "max_action_step" in episode.policy.options
    for name, leaf in leaf_specs(contract.action_space, "action").items():
        sent = episode.action[name]
        low, high = leaf.bounds()
        if not ((sent >= low.astype(sent.dtype)) & (sent <= high.astype(sent.dtype))).all():
            return "with an action outside the contract's bounds"
        if not is_limited and not is_sent_as(to_sent(episode.own_action[name], transform, leaf), sent, leaf).all():
            return "whose actions are not the policy's draws"
    return None


def _rewarded(episode: RecordedEpisode, reward: Reward) -> list[tuple[RecordedEpisode, NDArray[np.float64]]]:
    """Return the parts of an episode that the reward function ends, with their rewards.

    Without an end, the last decision only serves as the observation after the previous one.
    """
    contract = episode.policy.contract
    final: Columns | None = episode.final_obs
    seen = [row_of(contract.observation_space, episode.obs, row, "obs") for row in range(len(episode))]
    if final is not None:
        seen.append(row_of(contract.observation_space, final, 0, "obs"))
    rewards, ends = np.full(len(episode), np.nan), []  # the last reward needs the observation after it
    try:
        for row, after in enumerate(seen[1:]):
            result = reward(seen[row], row_of(contract.action_space, episode.action, row, "action"), after)
            rewards[row], is_end = result if isinstance(result, tuple) else (result, False)
            ends += [row + 1] if is_end else []
    except Exception as error:  # the user's own code
        raise UsageError(f"the reward function failed: {first_line(error)}") from error
    length = len(episode) if episode.ended else len(episode) - 1
    if not ends and (episode.ended or length < 1):
        return [(episode, rewards)]
    begins = [0, *ends]
    pieces = [(begin, end, True) for begin, end in zip(begins, ends, strict=False)]
    if begins[-1] < length:
        pieces.append((begins[-1], length, episode.terminated))
    return [(episode.part(i, j, terminated=terminated), rewards[i:j]) for i, j, terminated in pieces]


def reward_of(source: str, name: str) -> Reward:
    """Return the function `reward` of a Python file's text. Raises UsageError if it has none."""
    namespace: dict[str, Any] = {"__name__": "rlservo_reward"}
    try:
        exec(compile(source, name, "exec"), namespace)
    except Exception as error:
        raise UsageError(f"--reward {name} cannot be loaded: {first_line(error)}") from error
    return _function(namespace.get("reward"), f"--reward {name}", "reward")


def named_reward(name: str, modules: Collection[str]) -> Reward:
    """Return the function that a contract names, `module:function`, if it is one of these modules' own.

    No other module is imported, since a contract is data that a publisher wrote. Raises UsageError.
    """
    module, _, function = name.partition(":")
    if module not in modules:
        named = f"only {', '.join(modules)} may be used" if modules else "the command names no module"
        raise UsageError(f"the contract's reward function {name}: {named}; if you trust it, add --reward-from {module}")
    try:
        found = getattr(importlib.import_module(module), function, None)
    except Exception as error:
        raise UsageError(f"the contract's reward function {name} cannot be loaded: {first_line(error)}") from error
    if not inspect.isfunction(found) or found.__module__ != module:  # such as one that it imports
        found = None
    return _function(found, f"the contract's reward function {name}", function)


def _function(found: Any, where: str, name: str) -> Reward:
    if not callable(found):
        raise UsageError(f"{where}: expected a function {name}(obs, action, next_obs) in it")
    return cast(Reward, found)
