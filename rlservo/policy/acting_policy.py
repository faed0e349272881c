"""Interface of everything that acts: a control loop sees `Policy` and `PolicyClient` alike."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, TypeAlias

from numpy.typing import ArrayLike
from typing_extensions import Self

from rlservo.bundle.contract import Contract
from rlservo.bundle.production import PRODUCTION as PRODUCTION

Observation: TypeAlias = ArrayLike | Mapping[str, Any] | tuple[Any, ...]
"""An array of the observation space's shape, a batch of them, a map from element name to value (or batch), or for a
nested space maps and tuples of such."""


class Closeable(Protocol):
    """Something that holds resources until `close`, as a context manager until the block ends."""

    def close(self) -> None:
        """Free what it holds (a session, a connection, a file). It cannot be used any more."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class ActingPolicy(Closeable, Protocol):
    """Something that turns an observation into an action.

    ```python
    with Policy.load("policies/ur5") as policy:  # or PolicyClient("http://127.0.0.1:8000", "ur5")
        policy.reset()
        action = policy.act(obs)
    ```
    """

    @property
    def contract(self) -> Contract:
        """Inputs and outputs: spaces, element names and units, control rate."""
        ...

    def act(self, obs: Observation, *, explore: bool = False, seed: int | None = None) -> Any:
        """Return the action for `obs`, ready for `env.step`.

        One observation gives one action of the action space's shape and dtype (Discrete: an integer array of shape
        `()`); a batch `(B, *obs_shape)` gives a batch `(B, *action_shape)`. A nested (Dict or Tuple) observation is
        given in the space's own form, and a nested action is returned so, a batch with its axis on every leaf.

        `explore` samples the policy's action distribution instead of taking its mode; the same `seed` draws the same
        sample, None draws a fresh one.

        Raises ObservationError when the observation does not fit the contract, ActionError when the policy's answer
        must not reach a robot, and, over a network, UnavailableError or DeadlineError.
        """
        ...

    def reset(self) -> None:
        """Start an episode: recurrent state back to its initial value. Nothing to do for a stateless policy."""
        ...
