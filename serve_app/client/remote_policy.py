"""What the HTTP and the WebSocket client of a policy have in common: contract, episode, arguments of a request."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from rlservo.export.contract.contract import Contract, first_fault
from rlservo.export.contract.errors import DeadlineError, UnavailableError, UsageError
from rlservo.serve_app.client.episode_state import EpisodeState
from rlservo.serve_app.client.observations import encode_observation
from rlservo.serve_app.interface import ActingPolicy, Observation

POLL_S = 0.1  # between two looks at a server that is starting
LONGEST_TRY_S = 5.0  # of one such look


class RemotePolicy(ActingPolicy):
    """A policy on a server. A transport adds `act`, `close` and `_fetch_contract`."""

    url: str

    def __init__(
        self,
        policy: str | None,
        *,
        version: str | None,
        timeout_s: float,
        deadline_ms: float | None,
        episode: EpisodeState,
    ) -> None:
        if not timeout_s > 0:
            raise UsageError(f"timeout_s must be above 0 seconds, got {timeout_s}")
        if deadline_ms is not None and not deadline_ms > 0:
            raise UsageError(f"deadline_ms must be above 0, got {deadline_ms}")
        if policy == "":
            raise UsageError("the policy's name is empty: give a name, or None where the server has only one policy")
        if version is not None and policy is None:
            raise UsageError(f"version {version!r} was given without the policy's name")
        self._name = policy
        self._version = version
        self._timeout_s = timeout_s
        self._deadline_ms = 1e3 * timeout_s if deadline_ms is None else deadline_ms
        self._episode = episode
        self._contract: Contract | None = None
        self._numbers = itertools.count(1)  # next() is atomic: no two requests share a number

    @property
    def contract(self) -> Contract:
        """The policy's contract, fetched once.

        Raises UnavailableError, DeadlineError, UnknownPolicyError, or UsageError when no policy was named and the
        server has several.
        """
        if self._contract is None:
            self._contract = self._fetch_contract(None)
        return self._contract

    def set_last_action(self, action: Any) -> None:
        """Take note of what the robot was commanded instead of an answer that did not come. Sends nothing.

        The next request says so, and a limit on the step from one action to the next (`max_action_step`) counts from
        there. `action` is as `act` returns it.
        """
        self._episode.set_last_action(action)

    def reset(self) -> None:
        """Start an episode: the next request says so. Sends nothing."""
        self._episode.reset()

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Return as soon as the server offers the policy.

        Raises UnavailableError with the last reason after `timeout_s`, and at once what waiting cannot cure, such as
        UnknownPolicyError.
        """
        deadline = time.monotonic() + timeout_s
        while self._contract is None:
            remaining = deadline - time.monotonic()
            try:
                self._contract = self._fetch_contract(max(min(remaining, LONGEST_TRY_S), 0.01))
            except (UnavailableError, DeadlineError) as error:
                if time.monotonic() + POLL_S >= deadline:
                    raise UnavailableError(
                        f"{self.url} was not ready within {timeout_s:g} s: {error.message}", error.details
                    ) from error
                time.sleep(POLL_S)

    def _fetch_contract(self, timeout_s: float | None) -> Contract:
        """Ask the server for the contract: with a time-out once, else as often as the client asks anything."""
        raise NotImplementedError

    def _encode_request(
        self, obs: Observation, *, explore: bool, seed: int | None, reward: ArrayLike | None
    ) -> tuple[dict[str, Any], tuple[int, ...]]:
        """Return (the arguments of `act` as a request has them, the batch axis as () or (B,))."""
        encoded, batch = encode_observation(obs, self.contract)
        request: dict[str, Any] = {"obs": encoded}
        if explore:
            request["explore"] = True
        if seed is not None:
            request["seed"] = seed
        if reward is not None:
            request["reward"] = np.asarray(reward)
        return request, batch

    def _parse_contract(self, document: Any) -> Contract:
        """Return the contract that the server sent; raise UnavailableError where it cannot be one."""
        try:
            return Contract.model_validate(document)
        except ValidationError as error:
            raise UnavailableError(
                f"{self.url} sent a contract that this client cannot read: {first_fault(error)} "
                "(is the server another version of rlservo?)"
            ) from error
