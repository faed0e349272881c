"""Fallback actions for a late or unreachable policy server.

It wraps any object that acts. A control loop that failed because of a lost packet would leave the robot with its last
command and without control. Which command is safe depends on the robot: holding a position setpoint stops an arm,
holding a velocity drives a vehicle into a wall. So there is no default.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from rlservo.bundle.contract import Contract
from rlservo.bundle.nested import action_leaves, build_action
from rlservo.bundle.spaces import SpaceSpec, leaf_specs
from rlservo.errors import (
    DeadlineError,
    RequestError,
    RlservoError,
    SessionLostError,
    UnavailableError,
    UsageError,
)
from rlservo.policy.acting_policy import ActingPolicy, Observation

logger = logging.getLogger(__name__)

LOG_EVERY_S = 10.0
FIRST_TRIES = 10  # attempts for an episode's first action, while there is none to hold


class StoppedError(RlservoError):
    """The policy did not answer, and the fallback is 'stop'; or a real robot has stopped and waits for a person."""

    code = "stopped"


@dataclass
class LinkCounts:
    """Counts of late, failed and replaced actions."""

    late: int = 0  # no answer within the deadline
    unavailable: int = 0  # the server could not be reached, or refused temporarily
    lost: int = 0  # the server has lost the episode's memory
    fallback: int = 0  # steps that got the fallback's action


class WithFallback(ActingPolicy):
    """A policy that always gives an action in time, as long as the wrapped policy keeps its deadline.

    ```python
    policy = WithFallback(StreamClient(url, "ur5", deadline_ms=50), "hold")
    ```
    """

    def __init__(
        self,
        policy: ActingPolicy,
        fallback: Literal["hold", "zero", "stop"] | ArrayLike | dict[str, Any],
        *,
        on_fallback: Callable[[RlservoError], None] | None = None,
    ) -> None:
        """`fallback`: 'hold' repeats the last action, 'zero' sends zeros, 'stop' raises StoppedError; or an action.

        `on_fallback` gets the reason each time. Raises UsageError if the action does not fit the policy's space.
        """
        self._policy = policy
        self._fallback = fallback
        self._constant: Any = None
        if not isinstance(fallback, str):
            self._constant = _parse_action(policy.contract, fallback)
        elif fallback == "zero":
            self._constant = _zero(policy.contract)
        elif fallback not in ("hold", "stop"):
            raise UsageError(f"fallback {fallback!r} does not exist: expected hold, zero, stop or an action")
        self._on_fallback = on_fallback
        self._last: Any = None
        self._logged_at = -LOG_EVERY_S
        self.counts = LinkCounts()
        self.failure: RlservoError | None = None
        """Reason for the fallback in the last step; None if the policy gave the action."""

    @property
    def name(self) -> str:
        """Name of the fallback."""
        return self._fallback if isinstance(self._fallback, str) else "given action"

    @property
    def policy(self) -> ActingPolicy:
        """The wrapped policy."""
        return self._policy

    @property
    def contract(self) -> Contract:
        return self._policy.contract

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the policy's action, or the fallback's when it did not answer in time or at all.

        If there is nothing to hold yet, an episode's first action is requested several times.

        Raises StoppedError if the fallback is 'stop', or 'hold' before there was an action, and errors that waiting
        cannot cure: a wrong observation, an unsafe action.
        """
        more: dict[str, Any] = {} if reward is None else {"reward": reward}
        for tries_left in reversed(range(FIRST_TRIES)):
            try:
                action = self._policy.act(obs, explore=explore, seed=seed, **more)
            except (DeadlineError, UnavailableError, SessionLostError) as error:
                if (
                    tries_left
                    and self._fallback_is("hold")
                    and self._last is None
                    and not isinstance(error, SessionLostError)
                ):
                    self._count(error)
                    continue  # the robot has not been commanded yet, so its observation is still valid
                return self._fall_back(error)
            self._last, self.failure = deepcopy(action), None  # the loop may overwrite the action that it got
            return action
        raise AssertionError("the last try returns or raises")

    def reset(self) -> None:
        """Start an episode. There is nothing to hold before the policy's first action in it."""
        self._last = None
        self._policy.reset()

    def outcome(self, reward: float | None = None, **brought: Any) -> None:
        """Pass the last action's outcome on to a policy that accepts it (`RemotePolicy.outcome`)."""
        pass_on = getattr(self._policy, "outcome", None)
        if pass_on is not None:
            pass_on(reward, **brought)

    def close(self) -> None:
        """Close the wrapped policy."""
        self._policy.close()

    def _fall_back(self, error: DeadlineError | UnavailableError | SessionLostError) -> Any:
        self._count(error)
        self.failure = error
        if self._fallback_is("stop"):
            raise StoppedError(f"stopped: {error.message}", error.details) from error
        action = self._constant if self._constant is not None else self._last
        if action is None:
            raise StoppedError(f"there is no action to hold yet: {error.message}", error.details) from error
        self.counts.fallback += 1
        now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY_S:
            self._logged_at = now
            logger.warning("fallback (%s), %d times so far: %s", self.name, self.counts.fallback, error.message)
        if isinstance(self._policy, LastActionPolicy):  # a limit on the step counts from the robot's actual command
            self._policy.set_last_action(deepcopy(action))
        return deepcopy(action)

    def _fallback_is(self, word: str) -> bool:
        return isinstance(self._fallback, str) and self._fallback == word

    def _count(self, error: DeadlineError | UnavailableError | SessionLostError) -> None:
        if isinstance(error, DeadlineError):
            self.counts.late += 1
        elif isinstance(error, SessionLostError):
            self.counts.lost += 1
        else:
            self.counts.unavailable += 1
        if self._on_fallback is not None:
            self._on_fallback(error)


@runtime_checkable
class LastActionPolicy(Protocol):
    """A client whose server may keep the last action."""

    def set_last_action(self, action: Any) -> None: ...


def _zero(contract: Contract) -> Any:
    leaves = leaf_specs(contract.action_space, "action")
    choice = next((name for name, leaf in leaves.items() if np.dtype(leaf.dtype).kind != "f"), None)
    if choice is not None:
        raise UsageError(
            f"{choice} of policy '{contract.name}' is discrete, and 0 is one of its choices, not a stop: give an action"
        )
    zeros = {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in leaves.items()}
    return _parse_action(contract, build_action(contract.action_space, zeros))


def _parse_action(contract: Contract, action: Any) -> Any:
    """Return a given action in the space's form. Raises UsageError if it is not an action of the space."""
    space: SpaceSpec = contract.action_space
    leaves: dict[str, Any] = {}
    try:
        for name, value in action_leaves(space, action).items():
            leaf = leaf_specs(space, "action")[name]
            array = np.asarray(value)
            low, high = leaf.bounds()
            cast = array.astype(leaf.dtype)
            inside = array.shape == leaf.shape and bool(((cast >= low) & (cast <= high)).all())
            if not inside or not np.isfinite(array).all() or not np.allclose(cast, array, rtol=1e-6):
                raise UsageError(
                    f"the fallback's {name} is {str(value)[:80]}: policy '{contract.name}' expects shape {leaf.shape} "
                    f"within {leaf.bounds()[0].min():g} to {leaf.bounds()[1].max():g}"
                )
            leaves[name] = cast
    except (RequestError, ValueError, TypeError) as error:
        raise UsageError(f"the fallback is not an action of policy '{contract.name}': {error}") from error
    return build_action(space, leaves)
