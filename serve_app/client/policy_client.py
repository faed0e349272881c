"""`PolicyClient`: a policy on a server, used over HTTP like one in process.

It needs numpy, pydantic and httpcore. A robot's loop gets an action that belongs to the observation it just sent, in
time, or an error: every request carries a running number `seq`, and an answer with another number, a late one or a
malformed one is never used.
"""

from __future__ import annotations

import itertools
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError
from typing_extensions import Self

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import DeadlineError, RequestError, UnavailableError, UnknownPolicyError, UsageError
from rlservo.serve_app.client.http_transport import Transport, encode
from rlservo.serve_app.client.replies import carried, check_sender, check_step, is_action, restored, sendable
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.recording.start import record_policy

if TYPE_CHECKING:
    from rlservo.serve_app.recording.recorder import Recorder

POLL_S = 0.1  # between two looks at a server that is starting


class PolicyClient:
    """One policy of an rlservo server.

    ```python
    with PolicyClient("http://127.0.0.1:8000", "ur5") as policy:
        action = policy.act(obs)
    ```

    The version is settled at the first contact (the server's default, unless `version` names one) and stays: what
    `production` is moved to meanwhile does not change a running loop.

    Thread-safe for stateless policies: threads share the connections and each gets the answer to its own request.
    A recurrent policy's state is kept here and sent along, and so is the last action where the server limits the step
    from it: such a client belongs to one loop, and no replica that dies takes its memory along. With `server_state` the
    memory stays with the server instead, in a session of this client, which is worth it for large states (frames of a
    camera) and raises SessionLostError when the server has lost it.
    """

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
    ) -> None:
        """Check the arguments; the server is first asked when `contract` or `act` needs it.

        `policy` may be None where the server has exactly one. `timeout_s` bounds one call, its retries included, and
        `deadline_ms` instead of it each `act`; `retries` counts further attempts after a failed connection or a 503,
        nothing else is ever sent twice. `record` keeps every decision: a new .mcap file, a folder, or a Recorder.
        """
        if deadline_ms is not None and not deadline_ms > 0:
            raise UsageError(f"deadline_ms must be above 0, got {deadline_ms}")
        if policy == "":
            raise UsageError("the policy's name is empty: give a name, or None where the server has only one policy")
        if version is not None and policy is None:
            raise UsageError(f"version {version!r} was given without the policy's name")
        self._transport = Transport(url, timeout_s=timeout_s, retries=retries, api_key=api_key)
        self._deadline_ms = 1e3 * timeout_s if deadline_ms is None else deadline_ms
        self._policy = policy
        self._version = version
        self._contract: Contract | None = None
        self._numbers = itertools.count(1)  # next() is atomic: no two requests share a number
        self._state: dict[str, Any] = {}  # empty at an episode's start
        self._carries = False  # whether a policy without a state of its own needs one: a limit is set on its steps
        self._last: Any = None  # the last action of the episode, as the server sent it
        self._unsure = False  # whether the last action may be another one to the server than to the robot
        self._session = uuid.uuid4().hex if server_state else None
        self._steps = 0  # of the session's episode
        self.last_reply: dict[str, Any] = {}
        """The server's reply to the last request that got an action."""
        self._recorded = None if record is None else record_policy(self, record, act=self._act)

    @property
    def reconnects(self) -> int:
        """How many connections were made after the first."""
        return self._transport.reconnects

    @property
    def contract(self) -> Contract:
        """The policy's contract, fetched once.

        Raises UnavailableError, DeadlineError, UnknownPolicyError, or UsageError when no policy was named and the
        server has several.
        """
        if self._contract is None:
            self._contract = self._fetch()
        return self._contract

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the action for `obs`, as `ActingPolicy.act` describes; `reward` as `Policy.act` does.

        Raises ObservationError (non-finite numbers are refused here, the rest by the server), ActionError when the
        answer is not an action of this policy, DeadlineError after `timeout_s`, UnavailableError when the server
        cannot be reached, is not ready, or answers another request than this one.
        """
        act = self._act if self._recorded is None else self._recorded.act
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
        """Record what the last action brought (`WithRecording.outcome`). Nothing to do where nothing is recorded."""
        if self._recorded is not None:
            self._recorded.outcome(
                reward, terminated=terminated, truncated=truncated, final_status=final_status, final_obs=final_obs
            )

    def _act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        contract = self.contract
        deadline = time.monotonic() + self._deadline_ms / 1e3
        plain, batch = sendable(obs, contract)
        # The server drops what it could not answer in time, instead of working through a queue of abandoned questions.
        request: dict[str, Any] = {"obs": plain, "deadline_ms": self._deadline_ms}
        if explore:
            request["explore"] = True
        if seed is not None:
            request["seed"] = seed
        if reward is not None:
            request["reward"] = np.asarray(reward)
        if self._session is not None:
            request.update(session_id=self._session, reset=self._steps == 0)
        elif contract.state or self._carries:
            request["state"] = self._state
        in_episode = self._session is not None or "state" in request
        if in_episode and self._unsure and is_action(self._last, batch, contract):
            request["last_action"] = self._last  # what the robot was last commanded
        try:
            reply = self._ask(request, contract)
        except RequestError as error:
            if "state" in request or self._session is not None or error.details.get("send") != "state":
                raise
            # Nothing in the contract says that the server limits the step from one action to the next.
            self._carries = True
            request["state"] = self._state
            if self._last is not None:  # the limit was set in the middle of an episode
                request["last_action"] = self._last
            request["deadline_ms"] = 1e3 * (deadline - time.monotonic())
            reply = self._ask(request, contract)
        action = restored(reply.get("action"), batch, contract)
        if self._session is not None:
            self._steps = check_step(reply, self._steps)
        elif "state" in request:
            self._state = carried(reply, contract)
        self._last, self._unsure, self.last_reply = reply["action"], False, reply
        return action

    def commanded(self, action: Any) -> None:
        """Tell what the robot was commanded instead of an answer that did not come. Sends nothing.

        The next request says so, and a limit on the step from one action to the next (`max_action_step`) counts from
        there. `action` is as `act` returns it.
        """
        self._last, self._unsure = action, True
        if self._recorded is not None:
            self._recorded.commanded(action)

    def reset(self) -> None:
        """Start an episode: the next request begins with the state of an episode's start. Sends nothing."""
        self._state, self._steps, self._last = {}, 0, None
        if self._recorded is not None:
            self._recorded.begin()

    def _ask(self, request: dict[str, Any], contract: Contract) -> Any:
        """Send a request under a number of its own and return the reply to it. Raises DeadlineError."""
        number = request["seq"] = next(self._numbers)
        self._unsure = True
        path = ("v1", "policies", contract.name, "versions", contract.version, "act")
        reply = self._transport.post(*path, body=encode(request), timeout_s=request["deadline_ms"] / 1e3)
        check_sender(self._transport.url, reply, number, contract)
        return reply

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Return as soon as the server offers the policy.

        Raises UnavailableError with the last reason after `timeout_s`, and at once what waiting cannot cure, such as
        UnknownPolicyError.
        """
        deadline = time.monotonic() + timeout_s
        while self._contract is None:
            remaining = deadline - time.monotonic()
            try:
                self._contract = self._fetch(timeout_s=max(min(remaining, 5.0), 0.01), retries=0)
            except (UnavailableError, DeadlineError) as error:
                if time.monotonic() + POLL_S >= deadline:
                    raise UnavailableError(
                        f"{self._transport.url} was not ready within {timeout_s:g} s: {error.message}", error.details
                    ) from error
                time.sleep(POLL_S)

    def close(self) -> None:
        """Close the connections; later calls raise UsageError."""
        if self._recorded is not None:
            self._recorded.end()
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _fetch(self, *, timeout_s: float | None = None, retries: int | None = None) -> Contract:
        name = self._policy
        if name is None:
            name = _only_policy(self._transport.get("v1", "policies", timeout_s=timeout_s, retries=retries))
        versions = () if self._version is None else ("versions", self._version)
        document = self._transport.get("v1", "policies", name, *versions, timeout_s=timeout_s, retries=retries)
        try:
            return Contract.model_validate(document)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "the document"
            raise UnavailableError(
                f"{self._transport.url} sent a contract for {name!r} that this client cannot read: {where}: "
                f"{first['msg']} (is the server another version of rlservo?)"
            ) from error


def _only_policy(listing: Any) -> str:
    """Return the name of the server's one policy, or raise an error that lists them."""
    policies = listing.get("policies") if isinstance(listing, dict) else None
    if not isinstance(policies, list):
        raise UnavailableError("the server's list of policies cannot be read: is it another version of rlservo?")
    names = sorted({str(entry["name"]) for entry in policies if isinstance(entry, dict) and "name" in entry})
    if not names:
        raise UnknownPolicyError("the server has no policy loaded")
    if len(names) > 1:
        raise UsageError(f"the server has {len(names)} policies: name one of {', '.join(names)}", {"policies": names})
    return names[0]
