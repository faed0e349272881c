"""Recurrent state as the graph's tensors: network state, frames, previous actions, reward.

The caller keeps it: `Policy` keeps one, a server's clients may send theirs with each request.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.bundle.contract import REWARD, Contract, StateSpec
from rlservo.bundle.spaces import DiscreteSpec
from rlservo.errors import RequestError
from rlservo.policy.input_numbers import parse_array

State: TypeAlias = dict[str, NDArray[Any]]
"""Arrays `[batch, *shape]` by state name."""


class StateTensors:
    """The graph's tensors for the recurrent state of one policy; none for a stateless one."""

    def __init__(self, contract: Contract) -> None:
        self._policy = contract.name
        self._specs: dict[str, StateSpec] = {state.name: state for state in contract.state}
        self.has_reward = contract.has_reward
        self._choices = contract.action_space if isinstance(contract.action_space, DiscreteSpec) else None
        self.outputs = [f"state_out.{name}" for name in self._specs]
        """The graph's outputs needed besides the action."""

    def inputs(self, state: State | None, rows: int, reward: ArrayLike | None) -> dict[str, NDArray[Any]]:
        """Return the graph's inputs besides the observation; a state of None begins an episode in every row.

        Raises RequestError when the policy needs a reward, and none or an unsuitable one is given.
        """
        now = {name: spec.initial_value(rows) for name, spec in self._specs.items()} if state is None else state
        inputs = {f"state_in.{name}": value for name, value in now.items()}
        if self.has_reward:
            inputs[REWARD] = self._reward(state is None, rows, reward)
        return inputs

    def next_state(self, computed: Mapping[str, NDArray[Any]], sampled: Mapping[str, NDArray[Any]] | None) -> State:
        """Return the next state from the graph's outputs; `sampled` is the action if it was not the graph's own."""
        after = {name: computed[f"state_out.{name}"] for name in self._specs}
        if sampled is not None and self._choices is not None:
            for name, spec in self._specs.items():
                if spec.kind == "previous_actions":
                    width = self._choices.n
                    codes = after[name].copy()
                    codes[:, -width:] = np.eye(width, dtype=codes.dtype)[sampled["action"] - self._choices.start]
                    after[name] = codes
        return after

    def parse(self, state: Mapping[str, ArrayLike], rows: int, *, batch: bool) -> State:
        """Return a caller's state as the graph's arrays. Raises RequestError, which names the unfit part."""
        missing = [name for name in self._specs if name not in state]
        unknown = [str(name)[:64] for name in state if name not in self._specs]
        if missing or unknown:
            parts = [f"missing {', '.join(missing)}"] if missing else []
            parts += [f"unknown {', '.join(unknown[:8])}"] if unknown else []
            known = ", ".join(self._specs) or "none: it is stateless"
            raise RequestError(
                f"the state does not fit policy '{self._policy}' (its state: {known}): {'; '.join(parts)}"
            )
        found: State = {}
        for name, spec in self._specs.items():
            expected = (rows, *spec.shape) if batch else spec.shape
            array = parse_array(state[name], spec.dtype, f"state '{name}' of policy '{self._policy}'")
            if array.shape != expected:
                raise RequestError(
                    f"policy '{self._policy}' expects state '{name}' of shape {expected}, got {array.shape}"
                )
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise RequestError(f"state '{name}' of policy '{self._policy}' has a number that is not finite")
            found[name] = array if batch else array[None]
        return found

    def _reward(self, starting: bool, rows: int, reward: ArrayLike | None) -> NDArray[np.float32]:
        if starting and self._specs:  # without other memory, an episode's start cannot be recognised
            return np.zeros(rows, np.float32)  # no reward yet, even if the caller sent one
        if reward is None:
            start = "" if self._specs else ", 0 at an episode's start"
            raise RequestError(
                f"policy '{self._policy}' was trained to see the reward of its last action: pass act(obs, reward=...), "
                f"or in a request 'reward'{start}"
            )
        array = parse_array(reward, "float32", f"the reward for policy '{self._policy}'").reshape(-1)
        if len(array) != rows or not np.isfinite(array).all():
            raise RequestError(
                f"policy '{self._policy}' expects {rows} finite reward{'s' if rows > 1 else ''}, got {reward!r:.80}"
            )
        return array
