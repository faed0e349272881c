"""A policy that runs on a server, used like one that runs in process: `PolicyClient` is an `ActingPolicy` over HTTP.

It needs numpy, pydantic and httpx. It knows of the server only its `/v1` addresses, and nothing of ray, onnxruntime or
environments. A robot's loop gets an action that belongs to the observation it just sent, in time, or an error: every
request carries a running number `seq`, and an answer with another number, a late one or a malformed one is never used.
"""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from typing_extensions import Self

from rlservo.export.contract.bundle import Contract, DictSpec, LeafSpec, SpaceSpec, TupleSpec, leaf_specs
from rlservo.export.contract.errors import (
    ActionError,
    DeadlineError,
    ObservationError,
    RequestError,
    SessionLostError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.export.contract.nested import build_action
from rlservo.serve_app.client.http_transport import Transport, encode
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.wire.state_names import MARK

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
    ) -> None:
        """Check the arguments; the server is first asked when `contract` or `act` needs it.

        `policy` may be None where the server has exactly one. `timeout_s` bounds one call, its retries included, and
        `deadline_ms` instead of it each `act`; `retries` counts further attempts after a failed connection or a 503,
        nothing else is ever sent twice.
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
        self._last, self._unsure = reply["action"], False
        return action

    def commanded(self, action: Any) -> None:
        """Tell what the robot was commanded instead of an answer that did not come. Sends nothing.

        The next request says so, and a limit on the step from one action to the next (`max_action_step`) counts from
        there. `action` is as `act` returns it.
        """
        self._last, self._unsure = action, True

    def reset(self) -> None:
        """Start an episode: the next request begins with the state of an episode's start. Sends nothing."""
        self._state, self._steps, self._last = {}, 0, None

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


def check_sender(url: str, reply: Any, number: int, contract: Contract) -> None:
    """Refuse an answer to another request or from another policy: it must not move this robot."""
    if not isinstance(reply, dict):
        raise UnavailableError(f"{url} answered with {type(reply).__name__}, expected an object")
    if reply.get("seq") != number:
        raise UnavailableError(
            f"{url} answered request {reply.get('seq')!r}, expected {number}: the action was dropped",
            {"expected": number, "actual": reply.get("seq")},
        )
    sender = (reply.get("policy"), reply.get("version"))
    if sender != (contract.name, contract.version):
        raise UnavailableError(
            f"{url} answered for policy {sender[0]!r} version {sender[1]!r}, expected "
            f"{contract.name!r} version {contract.version!r}: the action was dropped"
        )


def check_step(reply: Mapping[str, Any], steps: int) -> int:
    """Return how many steps the server's memory has come; raise SessionLostError unless it comes from this episode.

    It may be ahead: a step whose answer came too late, or was refused here, has moved it on all the same.
    """
    step = reply.get("session_step")
    if type(step) is not int or step <= steps or (steps == 0 and step != 1):
        raise SessionLostError(
            f"the server's memory is at step {step!r} of an episode, expected one after {steps}: it is not this "
            "episode's; call reset() to begin one"
        )
    return step


def carried(reply: Mapping[str, Any], contract: Contract) -> dict[str, Any]:
    """Return the state for the next request; raise UnavailableError where the server gave none."""
    state = reply.get("state")
    if state is None and not contract.state:
        return {}  # what had to be carried has not to be any more
    names = {name for name in state if not name.startswith(MARK)} if isinstance(state, dict) else None
    if not isinstance(state, dict) or names != {spec.name for spec in contract.state}:
        raise UnavailableError(f"the server's answer for {contract.name!r} lacks the state: the action was dropped")
    return state


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


def sendable(obs: Observation, contract: Contract) -> tuple[Any, tuple[int, ...]]:
    """Return (what goes into the JSON, the batch axis as () or (B,)); the server checks shapes and names."""
    space = contract.observation_space
    if isinstance(space, DictSpec | TupleSpec):
        return _sendable_part(obs, space, "obs")
    if isinstance(obs, Mapping):
        named = {str(name): _finite(value, f"element {name!r}") for name, value in obs.items()}
        return named, next((value.shape[:1] for value in named.values()), ())
    array = _finite(obs, "")
    batch = array.shape[:1] if array.ndim == len(space.shape) + 1 else ()
    return array, batch


def _sendable_part(obs: Any, space: SpaceSpec, path: str) -> tuple[Any, tuple[int, ...]]:
    """Return (a nested observation's JSON form, the batch axis of its leaves); the server checks that it fits."""
    if isinstance(space, DictSpec | TupleSpec):
        inside = space.spaces.items() if isinstance(space, DictSpec) else enumerate(space.spaces)
        try:
            parts = {key: _sendable_part(obs[key], child, f"{path}.{key}") for key, child in inside}
        except (KeyError, IndexError, TypeError) as error:
            raise ObservationError(f"the observation does not have the parts of {path}: {error!r}") from error
        plain = {key: part for key, (part, _) in parts.items()}
        batch = next((axis for _, axis in parts.values()), ())
        return (plain if isinstance(space, DictSpec) else list(plain.values())), batch
    array = _finite(obs, f"part {path}")
    return array, array.shape[:1] if array.ndim == len(space.shape) + 1 else ()


def _finite(value: ArrayLike, where: str) -> NDArray[Any]:
    """Return `value` as a contiguous array of finite numbers, or raise ObservationError naming the element."""
    try:
        array = np.ascontiguousarray(value).reshape(np.shape(value))  # ascontiguousarray makes a scalar an array of 1
    except ValueError as error:
        raise ObservationError(f"the observation is ragged: expected numbers in one shape ({error})") from error
    if array.dtype.kind not in "fiub":
        got = type(value).__name__ if array.dtype.kind == "O" else array.dtype.name
        raise ObservationError(f"the observation{where and f', {where},'} holds {got}, expected numbers")
    array = array.astype(array.dtype.newbyteorder("="), copy=False)  # orjson takes the machine's own byte order only
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        which = where or f"element {first[0] if len(first) == 1 else first}"
        raise ObservationError(
            f"the observation's {which} is {array[first]}: expected a finite number", {"element": list(first)}
        )
    return array


def restored(action: Any, batch: tuple[int, ...], contract: Contract) -> Any:
    """Return the JSON action in the space's form, arrays of its dtype and shape, or raise ActionError."""
    return build_action(
        contract.action_space,
        {
            name: _restored_leaf(_part(action, name, contract), batch, name, leaf, contract)
            for name, leaf in leaf_specs(contract.action_space, "action").items()
        },
    )


def is_action(action: Any, batch: tuple[int, ...], contract: Contract) -> bool:
    """Whether this is an action of the policy for so many observations."""
    try:
        restored(action, batch, contract)
    except ActionError:
        return False
    return True


def _part(action: Any, name: str, contract: Contract) -> Any:
    """Return the leaf `action.<path>` of a nested JSON action, or raise ActionError."""
    part = action
    for step in name.split(".")[1:]:
        if isinstance(part, dict) and step in part:
            part = part[step]
        elif isinstance(part, list | tuple) and step.isdigit() and int(step) < len(part):
            part = part[int(step)]
        else:
            raise ActionError(f"the server's action for {contract.name!r} lacks the part {name!r}")
    return part


def _restored_leaf(action: Any, batch: tuple[int, ...], name: str, space: LeafSpec, contract: Contract) -> NDArray[Any]:
    expected = (*batch, *space.shape)
    what = f"action for {contract.name!r}" if name == "action" else f"{name} for {contract.name!r}"
    try:
        array = np.asarray(action)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiu" and array.size:
        raise ActionError(f"the server's {what} is {str(action)[:80]}, expected numbers")
    if array.shape != expected:
        raise ActionError(f"the server's {what} has shape {array.shape}, expected {expected}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ActionError(f"the server's {what} has an element that is not finite")
    typed = array.astype(space.dtype)
    if typed.dtype.kind in "iu" and not np.array_equal(typed, array):
        raise ActionError(f"the server's {what} is {str(action)[:80]}, expected {space.dtype}")
    return typed
