"""Recorded episodes followed by another policy, decision by decision.

A stateless policy computes an episode's observations at once. A batch may sum in another order, so that last bits
differ: if an action is close to the recorded one but not equal, its observation is computed again on its own, as it was
when the robot was driven. Recurrent state and step limits start with the episode.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rlservo.bundle.contract import Contract
from rlservo.bundle.nested import build_action
from rlservo.errors import ActionError, UsageError
from rlservo.policy.compiled_policy import open_policy
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.policy.recurrent_state import State
from rlservo.recording.episodes import RecordedEpisode, episodes
from rlservo.recording.policy_format import PolicyFormat, element_differences
from rlservo.recording.reader import Recording

SHOWN_DIFFERENCES = 10
ROUNDING = 1e-4  # relative: a larger difference is not a batch's rounding


class OtherContractError(UsageError):
    """The recording is of a policy with different observations or actions."""


@dataclass(frozen=True)
class FollowedEpisode:
    """An episode and the bundle's decisions in it. Unknown rows hold zeros."""

    episode: RecordedEpisode
    known: NDArray[np.bool_]
    """Whether the bundle's action is known: not without a recorded one, nor after a gap if it is recurrent."""
    unsafe: NDArray[np.bool_]
    """Whether the bundle's action was outside its space."""
    action: dict[str, NDArray[Any]]
    inputs: NDArray[Any] | None
    """The bundle's `action_dist_inputs`, `[rows, n]`."""


class Follower:
    """A bundle that follows recordings."""

    def __init__(self, bundle: str | Path) -> None:
        """Load and prove the bundle."""
        self.policy = open_policy(bundle)
        self._loaded: dict[str, Policy] = {"{}": self.policy}
        self._checked: set[int] = set()
        self._carried: dict[tuple[int, str], tuple[State | None, dict[str, NDArray[Any]] | None]] = {}
        self.skipped: dict[str, int] = {}
        """Number of decisions of other policies, by name."""

    @property
    def contract(self) -> Contract:
        return self.policy.contract

    def follow(self, recording: Recording, name: str | None = None) -> Iterator[FollowedEpisode]:
        """Yield every episode of the policy `name`; by default of the bundle's name, or of the only policy.

        Raises OtherContractError if its observations or actions differ from the bundle's.
        """
        wanted = self.contract.name if name is None else name
        found = False
        for episode in episodes(recording):
            recorded = episode.policy
            if recorded.contract.name != wanted:
                self.skipped[recorded.title] = self.skipped.get(recorded.title, 0) + len(episode)
                continue
            found = True
            self._check(recorded)
            yield self._follow(episode)
        names = {policy.contract.name for policy in recording.policies}
        if not found and name is None and len(names) == 1:
            self.skipped.clear()
            yield from self.follow(recording, names.pop())

    def _follow(self, episode: RecordedEpisode) -> FollowedEpisode:
        policy = self._policy_of(episode.policy)
        if not policy.is_stateful and not policy.contract.has_reward:
            at_once = _follow_at_once(policy, episode)
            if at_once is not None:
                return at_once
        rows = len(episode)
        known = episode.acted.copy()
        unsafe = np.zeros(rows, np.bool_)
        action = {name: np.zeros_like(leaf) for name, leaf in episode.action.items()}
        inputs: NDArray[Any] | None = None
        key = (id(episode.policy), episode.id)
        before, last = (None, None) if episode.begins else self._carried.pop(key, (None, None))
        if policy.is_stateful:
            end = _end_of_memory(episode, before, last)
            known[end:] = False
        rewarded = policy.contract.has_reward
        space, seen = policy.contract.observation_space, episode.obs
        executed = episode.executed
        moved = episode.acted | episode.fell_back
        for row in range(rows):
            done = {name: leaf[row : row + 1] for name, leaf in executed.items()}
            if known[row]:
                gave = {name: leaf[row : row + 1] for name, leaf in episode.action.items()}
                obs = build_action(space, {name: leaf[row] for name, leaf in seen.items()}, "obs")
                reward = episode.reward_input[row] if rewarded else None
                last = episode.last_action_input.get(row, last)
                try:
                    answer = policy.follow(obs, gave, before=before, last=last, reward=reward)
                except ActionError:
                    known[row], unsafe[row] = False, True
                    if policy.is_stateful:  # then its memory is unknown as well
                        known[row + 1 :] = False
                    continue
                for name, leaf in answer.leaves.items():
                    action[name][row] = leaf[0].reshape(action[name].shape[1:])
                if answer.inputs is not None:
                    inputs = np.zeros((rows, answer.inputs.shape[1]), answer.inputs.dtype) if inputs is None else inputs
                    inputs[row] = answer.inputs[0]
                before = answer.state or None
            if policy.has_step_limit and moved[row]:
                last = done
        if episode.goes_on:
            self._carried[key] = (before, last)
        return FollowedEpisode(episode, known, unsafe, action, inputs)

    def _policy_of(self, recorded: PolicyFormat) -> Policy:
        """Return the bundle under the options that the recorded policy had."""
        try:
            options = PolicyOptions.model_validate(recorded.options)
        except ValidationError:  # from a newer version
            options = PolicyOptions()
        key = options.model_dump_json(exclude_defaults=True)
        if key not in self._loaded:
            self._loaded[key] = open_policy(self.policy.path, check_golden=False, options=options)
        return self._loaded[key]

    def _check(self, recorded: PolicyFormat) -> None:
        if id(recorded) in self._checked:
            return
        found = list(element_differences(recorded.contract, self.contract))
        if found:
            shown = "; ".join(found[:SHOWN_DIFFERENCES])
            more = f"; and {len(found) - SHOWN_DIFFERENCES} more" if len(found) > SHOWN_DIFFERENCES else ""
            raise OtherContractError(
                f"the recording of {recorded.title} does not fit the bundle {self.contract.name}/"
                f"{self.contract.version}: {shown}{more}",
                {"differences": found},
            )
        self._checked.add(id(recorded))


def _follow_at_once(policy: Policy, episode: RecordedEpisode) -> FollowedEpisode | None:
    """Follow an episode with a stateless policy; None if a row must be computed alone."""
    known = np.flatnonzero(episode.acted)
    action = {name: np.zeros_like(leaf) for name, leaf in episode.action.items()}
    inputs: NDArray[Any] | None = None
    space = policy.contract.observation_space
    if len(known):
        try:
            answer = policy.follow(
                build_action(space, {name: leaf[known] for name, leaf in episode.obs.items()}, "obs"), {}
            )
        except ActionError:
            return None
        for name, leaf in answer.leaves.items():
            action[name][known] = leaf.reshape(action[name][known].shape)
        if answer.inputs is not None:
            inputs = np.zeros((len(episode), answer.inputs.shape[1]), answer.inputs.dtype)
            inputs[known] = answer.inputs
        for row in known[_is_close_only(episode, action, inputs, known)]:
            obs = build_action(space, {name: leaf[row] for name, leaf in episode.obs.items()}, "obs")
            answer = policy.follow(obs, {})
            for name, leaf in answer.leaves.items():
                action[name][row] = leaf[0].reshape(action[name].shape[1:])
            if inputs is not None and answer.inputs is not None:
                inputs[row] = answer.inputs[0]
    return FollowedEpisode(episode, episode.acted.copy(), np.zeros(len(episode), np.bool_), action, inputs)


def _is_close_only(
    episode: RecordedEpisode, action: dict[str, NDArray[Any]], inputs: NDArray[Any] | None, rows: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return the rows that differ from the recorded ones only by rounding errors."""
    pairs = [(leaf[rows], action[name][rows]) for name, leaf in episode.action.items()]
    explored = episode.explored[rows]
    close = np.zeros(len(rows), np.bool_)
    far = np.zeros(len(rows), np.bool_)
    for recorded, replayed in pairs:
        _add_closeness(recorded, replayed, ~explored, close, far)
    if inputs is not None and explored.any() and episode.dist_inputs.shape == inputs.shape:
        _add_closeness(episode.dist_inputs[rows], inputs[rows], explored, close, far)
    return close & ~far


def _add_closeness(
    recorded: NDArray[Any],
    replayed: NDArray[Any],
    rows: NDArray[np.bool_],
    close: NDArray[np.bool_],
    far: NDArray[np.bool_],
) -> None:
    ours, theirs = (array.reshape(len(array), -1).astype(np.float64) for array in (recorded, replayed))
    with np.errstate(invalid="ignore"):
        difference = np.abs(ours - theirs)
        limit = ROUNDING * np.maximum(1.0, np.abs(ours))
        close |= rows & (difference > 0).any(axis=1)
        far |= rows & (difference > limit).any(axis=1)


def _end_of_memory(episode: RecordedEpisode, before: State | None, last: dict[str, NDArray[Any]] | None) -> int:
    """Return the first row at which the policy's memory of the episode is unknown."""
    if not episode.id or (not episode.begins and before is None and last is None):
        return 0
    return len(episode) if episode.gap is None else episode.gap
