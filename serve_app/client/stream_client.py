"""`StreamClient`: a policy on a server over one WebSocket, used like `PolicyClient`.

A stream saves the HTTP around each request. It is made again by itself when it breaks, and whatever comes late is told
by its number and never used.
"""

from __future__ import annotations

import itertools
import json
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit, urlunsplit

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError
from typing_extensions import Self

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import (
    ActionError,
    DeadlineError,
    RequestError,
    RlservoError,
    SessionLostError,
    UnavailableError,
    UsageError,
)
from rlservo.export.contract.nested import action_leaves, build_action
from rlservo.serve_app.client.http_transport import error_from, error_of_status
from rlservo.serve_app.client.replies import carried, check_sender, check_step, is_action, restored, sendable
from rlservo.serve_app.client.websocket_connection import BrokenError, RefusedError, WebSocket
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.recording.start import record_policy
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack

if TYPE_CHECKING:
    from rlservo.serve_app.recording.recorder import Recorder

WAIT_S = 0.02  # between two attempts to connect within one call
POLL_S = 0.1
SILENT_FACTOR, SILENT_S = 3.0, 0.5  # a connection that gave no byte for so many deadlines, and so long, is made anew


class StreamClient:
    """One policy of an rlservo server, over a WebSocket.

    ```python
    with StreamClient("http://127.0.0.1:8000", "ur5", deadline_ms=50) as policy:
        action = policy.act(obs)
    ```

    The version is settled at the first contact and stays. A recurrent policy's state is kept here and sent along, or
    with `server_state` left with the connection: when that breaks in the middle of an episode the state is gone, and
    `act` raises SessionLostError until `reset`. It belongs to one loop, and is not thread-safe.
    """

    def __init__(
        self,
        url: str,
        policy: str | None = None,
        *,
        version: str | None = None,
        timeout_s: float = 5.0,
        api_key: str | None = None,
        deadline_ms: float | None = None,
        server_state: bool = False,
        record: str | Path | Recorder | None = None,
    ) -> None:
        """Check the arguments; nothing is sent before `contract` or `act` needs it.

        `policy` may be None where the server has a default policy. `timeout_s` bounds the first contact, `deadline_ms`
        (by default the same) each `act`, in which a broken connection is made anew. `record` keeps every
        decision: a new .mcap file, a folder, or a Recorder.
        """
        if version is not None and policy is None:
            raise UsageError(f"version {version!r} was given without the policy's name")
        deadline_s = timeout_s if deadline_ms is None else deadline_ms / 1e3
        if not (timeout_s > 0 and deadline_s > 0):
            raise UsageError(f"timeout_s and deadline_ms must be above 0, got {timeout_s} and {deadline_ms}")
        self.url = _stream_root(url)
        self._name, self._version = policy, version
        self._timeout_s, self._deadline_s = timeout_s, deadline_s
        self._api_key = api_key
        self._server_state = server_state
        self._contract: Contract | None = None
        self._socket: WebSocket | None = None
        self._closed = False
        self._numbers = itertools.count(1)
        self._state: dict[str, Any] = {}
        self._steps = 0  # of the connection's episode
        self._lost = False
        self._last: Any = None  # the last action of the episode, as the server sent it
        self._begins = False  # an episode, with the next request; the first one begins with the connection
        self._connections = 0
        self._unsure = True  # whether the connection knows the last action that was used: a new one does not
        self.stale = 0
        """Answers that came after their deadline, and were dropped."""
        self.last_reply: dict[str, Any] = {}
        """The server's reply to the last request that got an action."""
        self._recorded = None if record is None else record_policy(self, record, act=self._act)

    @property
    def reconnects(self) -> int:
        """How many connections were made after the first."""
        return max(0, self._connections - 1)

    @property
    def contract(self) -> Contract:
        """The policy's contract, which the server sends first."""
        if self._contract is None:
            self._connect(time.monotonic() + self._timeout_s)
        assert self._contract is not None
        return self._contract

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the action for `obs`, as `ActingPolicy.act` describes.

        Raises what `PolicyClient.act` raises, and SessionLostError when the episode's memory went with a connection.
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
        deadline = time.monotonic() + self._deadline_s
        plain, batch = sendable(obs, contract)
        number = next(self._numbers)
        request: dict[str, Any] = {"obs": plain, "seq": number}
        options = {"explore": explore or None, "seed": seed, "reward": None if reward is None else np.asarray(reward)}
        request.update({name: value for name, value in options.items() if value is not None})
        while True:
            connection = self._connected(deadline)
            held = bool(contract.state) and self._server_state
            if held:
                if self._lost:
                    raise SessionLostError(
                        f"the connection to {self.url} broke, and the episode's memory went with it: call reset()"
                    )
                request["reset"] = self._steps == 0
            elif contract.state:
                request["state"] = self._state
            elif self._begins:  # where the server limits the step, the connection holds the last action
                request["reset"] = True
            request.pop("last_action", None)
            if self._unsure and is_action(self._last, batch, contract):
                request["last_action"] = self._last  # where the server limits the step from it
            request["deadline_ms"] = max(0.0, 1e3 * (deadline - time.monotonic()))
            try:
                connection.send(pack(request), deadline)
                reply = self._answer(connection, number, deadline)
            except BrokenError:
                self._drop()
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                continue  # asking twice does no harm: no memory of ours has survived on the other side
            except DeadlineError:
                self._unsure = True  # it may have acted, with an action that no robot has seen
                silent_s = time.monotonic() - connection.heard_at
                if silent_s > max(SILENT_S, SILENT_FACTOR * self._deadline_s):
                    self._drop()
                raise DeadlineError(
                    f"{self.url} did not answer within {1e3 * self._deadline_s:g} ms",
                    {"deadline_ms": 1e3 * self._deadline_s},
                ) from None
            if not held and (reply.get("policy"), reply.get("version")) != (contract.name, contract.version):
                self._drop()  # the default has moved: the next connection names its version
                if self._connections == 1 and time.monotonic() + WAIT_S < deadline:
                    continue
            check_sender(self.url, reply, number, contract)
            sent = _first(reply.get("actions"), contract, batch)
            action = restored(sent, batch, contract)
            if held:
                self._steps = check_step(reply, self._steps)
            elif contract.state:
                self._state = carried(reply, contract)
            self._last, self._unsure, self._begins, self.last_reply = sent, False, False, reply
            return action

    def commanded(self, action: Any) -> None:
        """Tell what the robot was commanded instead of an answer that did not come, as `PolicyClient` does."""
        self._last, self._unsure = action, True
        if self._recorded is not None:
            self._recorded.commanded(action)

    def reset(self) -> None:
        """Start an episode: the next request says so. Sends nothing."""
        self._state, self._steps, self._lost, self._last = {}, 0, False, None
        self._begins = True
        if self._recorded is not None:
            self._recorded.begin()

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Return as soon as the server offers the policy.

        Raises UnavailableError with the last reason after `timeout_s`, and at once what waiting cannot cure.
        """
        deadline = time.monotonic() + timeout_s
        while self._contract is None:
            try:
                self._connect(min(deadline, time.monotonic() + 5.0))
            except (UnavailableError, DeadlineError) as error:
                if time.monotonic() + POLL_S >= deadline:
                    raise UnavailableError(
                        f"{self.url} was not ready within {timeout_s:g} s: {error.message}", error.details
                    ) from error
                time.sleep(POLL_S)

    def close(self) -> None:
        """Close the connection; later calls raise UsageError."""
        if self._recorded is not None:
            self._recorded.end()
        self._drop()
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _answer(self, connection: WebSocket, number: int, deadline: float) -> dict[str, Any]:
        """Return the reply to request `number`; those to earlier ones are dropped."""
        while True:
            message = connection.receive(deadline)
            try:
                document = json.loads(message) if isinstance(message, str) else unpack(message)
            except (ValueError, RlservoError) as error:
                raise UnavailableError(f"{self.url} sent a message that cannot be read: {error}") from error
            if not isinstance(document, dict):
                raise UnavailableError(f"{self.url} sent a {type(document).__name__}, expected a map")
            seq = document.get("seq")
            if type(seq) is int and seq < number:
                self.stale += 1
                continue
            if isinstance(message, str):
                raise error_from(document, 500) or UnavailableError(f"{self.url} sent {message[:80]!r}")
            return document

    def _connected(self, deadline: float) -> WebSocket:
        while self._socket is None:
            try:
                self._connect(deadline)
            except BrokenError:
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                time.sleep(WAIT_S)
        return self._socket

    def _connect(self, deadline: float) -> None:
        if self._closed:
            raise UsageError("the client is closed: make a new one")
        name, version = self._name, self._version
        if self._contract is not None:  # settled
            name, version = self._contract.name, self._contract.version
        path = "/" if name is None else f"/v1/policies/{quote(name, safe='')}"
        path += f"/versions/{quote(version, safe='')}/stream" if version else "/stream" if name else ""
        try:
            connection = WebSocket(f"{self.url}{path}?errors=keep", api_key=self._api_key, deadline=deadline)
        except RefusedError as error:
            raise _refused(self.url, error) from None
        try:
            contract = _contract_of(self.url, connection.receive(deadline))
        except BaseException:
            connection.close()
            raise
        self._contract = self._contract or contract
        self._socket = connection
        self._connections += 1
        self._unsure = True
        self._lost = self._steps > 0

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _first(chunks: Any, contract: Contract, batch: tuple[int, ...]) -> Any:
    """Return the action without the chunk axis of each leaf: ours are chunks of one. Raises ActionError."""
    found: dict[str, Any] = {}
    try:
        for name, chunk in action_leaves(contract.action_space, chunks).items():
            array = np.asarray(chunk)
            if array.ndim <= len(batch) or array.shape[len(batch)] != 1:
                raise ActionError(f"the server's {name} has shape {array.shape}: expected a chunk of one action")
            found[name] = array[:, 0] if batch else array[0]
    except (RequestError, ValueError) as error:
        raise ActionError(f"the server's action for {contract.name!r} cannot be read: {error}") from error
    return build_action(contract.action_space, found)


def _contract_of(url: str, message: bytes | str) -> Contract:
    """Return the contract in the metadata, the first thing a server sends."""
    try:
        metadata = None if isinstance(message, str) else unpack(message)
        return Contract.model_validate(metadata["contract"] if isinstance(metadata, dict) else None)
    except (ValidationError, KeyError, RlservoError) as error:
        raise UnavailableError(
            f"{url} did not begin with a contract that this client can read (is it another version of rlservo?)"
        ) from error


def _refused(url: str, error: RefusedError) -> RlservoError:
    try:
        document = json.loads(error.body)
    except ValueError:
        document = None
    told = error_from(document, error.status) if isinstance(document, dict) else None
    return told or error_of_status(error.status)(f"{url} answered {error.status}: is it an rlservo server?")


def _stream_root(url: str) -> str:
    parts = urlsplit(url)
    scheme = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}.get(parts.scheme)
    try:
        usable = parts.port != 0 and bool(parts.hostname)
    except ValueError:
        usable = False
    if scheme is None or not usable or parts.query or parts.fragment:
        raise UsageError(f"{url!r} is not a server address: expected for example 'http://127.0.0.1:8000'")
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/"), "", ""))
