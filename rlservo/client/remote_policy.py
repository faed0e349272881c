"""Base of the HTTP and the WebSocket client of a policy: all but how a request for an action travels."""

from __future__ import annotations

import itertools
import logging
import secrets
import time
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from rlservo.bundle.compatibility import harmless_differences
from rlservo.bundle.contract import Contract, first_fault
from rlservo.client.client_episode import ClientEpisode
from rlservo.client.formats.request_names import LONGEST_STATUS
from rlservo.client.http_transport import SCHEMES, Transport
from rlservo.client.observation_encoding import encode_observation
from rlservo.client.replies import answering_version, check_successor, decode_action
from rlservo.errors import (
    DeadlineError,
    RlservoError,
    StateNeededError,
    UnavailableError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.policy.acting_policy import ActingPolicy, Observation
from rlservo.recording.start import record_policy

if TYPE_CHECKING:
    from rlservo.recording.recorder import Recorder

logger = logging.getLogger(__name__)

POLL_S = 0.1  # between two checks of a server that is starting
LONGEST_TRY_S = 5.0  # of one such check
FOLLOWED_S = 2.0  # until all processes of a server have loaded a version
ASK_AGAIN_S = 0.01  # another process may answer next


class RemotePolicy(ActingPolicy):
    """A policy on a server. Contracts come over HTTP; a client adds the way of a request for an action."""

    _is_stream = False
    _schemes = SCHEMES

    def __init__(
        self,
        url: str,
        policy: str | None = None,
        *,
        version: str | None = None,
        timeout_s: float = 5.0,
        retries: int = 2,
        api_key: str | None = None,
        deadline_ms: float | None = None,
        server_state: bool = False,
        record: str | Path | Recorder | None = None,
        label: str | None = None,
    ) -> None:
        """Check the arguments; the first request is sent when `contract` or `act` needs it.

        `policy` may be None if the server has exactly one. `timeout_s` bounds the first contact including its retries,
        `deadline_ms` (by default the same) each `act`. `retries` counts further attempts of an HTTP request after a
        failed connection or a 503; nothing else is ever sent twice. `record` keeps every decision: a new .mcap file, a
        folder, or a Recorder. `label` names this loop in the server's own recording, by default a random name does.
        """
        if label is not None and not (label and label.isascii() and label.isprintable() and len(label) <= 100):
            raise UsageError(f"label must be 1 to 100 printable ASCII characters, got {label[:100]!r}")
        if deadline_ms is not None and not deadline_ms > 0:
            raise UsageError(f"deadline_ms must be above 0, got {deadline_ms}")
        if policy == "":
            raise UsageError("the policy name is empty: give a name, or None if the server has only one policy")
        if version is not None and policy is None:
            raise UsageError(f"version {version!r} was given without the policy's name")
        self._transport = Transport(url, timeout_s=timeout_s, retries=retries, api_key=api_key, schemes=self._schemes)
        self.url = self._transport.url
        self._name = policy
        self._version = version
        self._label = label
        self._timeout_s = timeout_s
        self._deadline_ms = 1e3 * timeout_s if deadline_ms is None else deadline_ms
        self._episode = ClientEpisode(server_state=server_state, is_stream=self._is_stream)
        self._contract: Contract | None = None
        self._looks_up = False
        """Whether the contract is fetched again before the next request, because its alias may have moved."""
        self._contracts: dict[str, Contract] = {}
        """Contracts of all versions that have answered."""
        self._reward: float | None = None
        """Outcome of the last action, for the next request."""
        self._numbers = itertools.count(1)  # next() is atomic: no two requests share a number
        self.last_reply: dict[str, Any] = {}
        """The server's reply to the last request that got an action."""
        self._renew_label()
        # Last, so that a failing constructor leaves no file behind.
        self._recording = None if record is None else record_policy(self, record, act=self._act)

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return self._transport.reconnects

    @property
    def contract(self) -> Contract:
        """The contract of the version that answered last or, before the first answer, of the server's default.

        Raises UnavailableError, DeadlineError, UnknownPolicyError, or UsageError when no policy was named and the
        server has several.
        """
        if self._contract is None or self._looks_up:
            self._meet(self._fetch_contract(self._version, None))
            assert self._contract is not None
        return self._contract

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the action for `obs`, as `ActingPolicy.act` describes; `reward` as `Policy.act` does.

        Raises ObservationError (non-finite numbers are refused here, the rest by the server), ActionError when the
        answer is not an action of this policy, DeadlineError after `deadline_ms`, UnavailableError when the server
        cannot be reached, is not ready, or answers a different request, and SessionLostError when it has lost the
        episode's state.
        """
        act = self._act if self._recording is None else self._recording.act
        return act(obs, explore=explore, seed=seed, reward=reward)

    def outcome(
        self,
        reward: float | None = None,
        *,
        terminated: bool = False,
        truncated: bool = False,
        final_status: str | None = None,
        final_obs: Observation | None = None,
    ) -> None:
        """Report the last action's reward and the episode's end to the server and the client's recording.

        A reward is sent with the next request, an episode's end in a request of its own if `final_obs`, the observation
        after the last action, is given: a server that records keeps them, and `rlservo policy promote` counts ends in
        `success`. If the server refuses it, that is only logged. Does nothing before the first action.
        """
        if self._recording is not None:
            self._recording.record_outcome(
                reward, terminated=terminated, truncated=truncated, final_status=final_status, final_obs=final_obs
            )
        self._reward = None if reward is None else float(reward)
        is_over = terminated or truncated or final_status is not None
        if not is_over or final_obs is None or self._contract is None:
            return
        word = "truncated" if truncated else "terminated"
        end = {"final_status": (final_status or word)[:LONGEST_STATUS], "truncated": truncated and not terminated}
        try:
            request, batch = self._encode_request(final_obs, reward=self._reward, **end)
            if self._episode.steps:
                deadline = time.monotonic() + self._deadline_ms / 1e3
                reply = self._exchange(request, batch, deadline)
                answering_version(self.url, reply, request["seq"], self._contract)
        except RlservoError as error:
            logger.warning("the end of the episode was not reported to %s: %s", self.url, error.message)
        self._reward = None
        self._episode.end()

    def set_last_action(self, action: Any) -> None:
        """Note the robot's command instead of a missing answer. Sends nothing.

        It is sent with the next request, and a limit on the step from one action to the next (`max_action_step`) counts
        from it. `action` has the form that `act` returns.
        """
        self._episode.set_last_action(action)
        if self._recording is not None:
            self._recording.record_command(action)

    def reset(self) -> None:
        """Start an episode. Nothing is sent until the next request."""
        self._episode.reset()
        self._reward = None
        if not self._is_stream:  # which has the label that it was opened with
            self._renew_label()
        # A version number needs no lookup.
        self._looks_up = self._version not in (None, self._contract and self._contract.version)
        if self._recording is not None:
            self._recording.begin()

    def close(self) -> None:
        """End the recording and close the connections to the server; later calls raise UsageError."""
        if self._recording is not None:
            self._recording.end()
        self._disconnect()
        self._transport.close()

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Wait until the server offers the policy.

        Raises UnavailableError with the last reason after `timeout_s`; errors that waiting cannot cure, such as
        UnknownPolicyError, are raised at once.
        """
        deadline = time.monotonic() + timeout_s
        while self._contract is None:
            remaining = deadline - time.monotonic()
            try:
                self._meet(self._fetch_contract(self._version, max(min(remaining, LONGEST_TRY_S), 0.01)))
            except (UnavailableError, DeadlineError) as error:
                if time.monotonic() + POLL_S >= deadline:
                    raise UnavailableError(
                        f"{self.url} was not ready within {timeout_s:g} s: {error.message}", error.details
                    ) from error
                time.sleep(POLL_S)

    def _act(self, obs: Observation, *, explore: bool, seed: int | None, reward: ArrayLike | None = None) -> Any:
        """Request the action, and keep the reply as `last_reply`."""
        _ = self.contract  # the first contact has its own time-out
        deadline = time.monotonic() + self._deadline_ms / 1e3
        reward = self._reward if reward is None else np.asarray(reward)
        request, batch = self._encode_request(obs, explore=explore or None, seed=seed, reward=reward)
        reply = self._exchange(request, batch, deadline)
        contract = self._answering_contract(reply, request["seq"], deadline)
        action = decode_action(reply, batch, contract)
        self._episode.advance(reply, action, contract)
        self.last_reply, self._reward = reply, None
        return action

    def _exchange(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float) -> Any:
        """Send a request with the episode's fields by `deadline` (`time.monotonic`), and return the reply."""
        try:
            return self._send(request, batch, deadline)
        except StateNeededError:
            # Another version answers now; or the step from one action to the next is limited, which no contract says.
            self._episode.carry()
            self._disconnect()  # only a new stream has a memory
            self._meet(self._fetch_contract(self._version, max(deadline - time.monotonic(), 0.001)))
            return self._send(request, batch, deadline)

    @abstractmethod
    def _send(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float) -> Any:
        """Send a request once with the episode's fields, and return the reply."""
        ...

    def _disconnect(self) -> None:
        """End the stream, if there is one."""

    def _renew_label(self) -> None:
        number = secrets.token_hex(8 if self._label is None else 4)
        self._transport.label = number if self._label is None else f"{self._label}.{number}"

    def _fetch_contract(self, version: str | None, timeout_s: float | None) -> Contract:
        """Request a contract, by default with the client's usual time-out."""
        name = self._name or (self._contract.name if self._contract else None)
        if name is None:
            name = _only_policy(self._transport.get("v1", "policies", timeout_s=timeout_s))
        path = ("v1", "policies", name, *(() if version is None else ("versions", version)))
        document = self._transport.get(*path, timeout_s=timeout_s)
        try:
            return Contract.model_validate(document)
        except ValidationError as error:
            raise UnavailableError(
                f"{self.url} sent a contract that this client cannot read: {first_fault(error)} "
                "(does the server run another version of rlservo?)"
            ) from error

    def _meet(self, contract: Contract) -> None:
        """Use this contract from now on; warn of names, units or a control rate that differ.

        Raises UnavailableError if this client cannot use its version.
        """
        known, is_new = self._contract, contract.version not in self._contracts
        self._contracts.setdefault(contract.version, contract)  # also if it is refused: it is fetched once
        if known is not None and contract is not known:
            check_successor(contract, known)
            if is_new and (different := harmless_differences(contract, known)):
                logger.warning(
                    "version %s of policy '%s' differs from version %s: %s",
                    contract.version, contract.name, known.version, different,
                )  # fmt: skip
        self._contract, self._looks_up = contract, False

    def _answering_contract(self, reply: Any, number: int, deadline: float) -> Contract:
        """Return the contract of the version that answered request `number`.

        Raises UnavailableError if it answers another request, or comes from a version that this client was not made
        for, and DeadlineError.
        """
        contract = self.contract
        version = answering_version(self.url, reply, number, contract)
        if version == contract.version:
            return contract
        refusal = f"{self.url} answered for version {version[:32]!r} of policy '{contract.name}'"
        if self._version is not None:
            raise UnavailableError(f"{refusal}, expected {contract.version!r}: the action was dropped")
        known = self._contracts.get(version) or self._fetch_new_version(version, deadline)
        if (known.name, known.version) != (contract.name, version):
            raise UnavailableError(f"{refusal}, but has no contract for that version: the action was dropped")
        self._meet(known)
        return known

    def _fetch_new_version(self, version: str, deadline: float) -> Contract:
        """Return the contract of a version that has answered, even if other processes do not serve it yet."""
        until = min(deadline, time.monotonic() + FOLLOWED_S)
        while True:
            try:
                return self._fetch_contract(version, max(deadline - time.monotonic(), 0.001))
            except UnknownVersionError as error:
                if time.monotonic() + ASK_AGAIN_S >= until:
                    raise UnavailableError(f"{error.message}: the action was dropped", error.details) from error
                time.sleep(ASK_AGAIN_S)

    def _encode_request(self, obs: Observation, **fields: Any) -> tuple[dict[str, Any], tuple[int, ...]]:
        """Return (a numbered request with those fields that are given, the batch axis as () or (B,))."""
        encoded, batch = encode_observation(obs, self.contract)
        given = {name: value for name, value in fields.items() if value is not None}
        return {"obs": encoded, "seq": next(self._numbers), **given}, batch


def _only_policy(listing: Any) -> str:
    """Return the name of the server's only policy, or raise an error that lists all of them."""
    policies = listing.get("policies") if isinstance(listing, dict) else None
    if not isinstance(policies, list):
        raise UnavailableError("the server's list of policies cannot be read: does it run another version of rlservo?")
    names = sorted({str(entry["name"]) for entry in policies if isinstance(entry, dict) and "name" in entry})
    if not names:
        raise UnknownPolicyError("the server has no policy loaded")
    if len(names) > 1:
        raise UsageError(f"the server has {len(names)} policies: name one of {', '.join(names)}", {"policies": names})
    return names[0]
