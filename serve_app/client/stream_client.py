"""`StreamClient`: a policy on a server over one WebSocket, used like `PolicyClient`.

A stream saves the HTTP overhead of each request. It reconnects automatically, and late answers are recognised by their
number and never used.
"""

from __future__ import annotations

import json
import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import (
    ActionError,
    DeadlineError,
    RequestError,
    RlservoError,
    StateNeededError,
    UnavailableError,
    UsageError,
)
from rlservo.export.contract.nested import action_leaves, build_action
from rlservo.serve_app.client.client_episode import ClientEpisode
from rlservo.serve_app.client.remote_policy import RemotePolicy
from rlservo.serve_app.client.replies import decode_action, decode_error, error_of
from rlservo.serve_app.client.websocket_connection import BrokenError, HandshakeError, WebSocket
from rlservo.serve_app.interface import Observation
from rlservo.serve_app.wire.addresses import parse_address
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack

if TYPE_CHECKING:
    from rlservo.serve_app.recording.recorder import Recorder

SCHEMES = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
WAIT_S = 0.02  # between two attempts to connect within one call
SILENT_FACTOR, SILENT_S = 3.0, 0.5  # a connection without any data for this many deadlines, and this long, is replaced


class StreamClient(RemotePolicy):
    """One policy of an rlservo server, over a WebSocket.

    ```python
    with StreamClient("http://127.0.0.1:8000", "ur5", deadline_ms=50) as policy:
        action = policy.act(obs)
    ```

    Versions are chosen as for `PolicyClient`; a canary's share is drawn once per client. A recurrent policy's state is
    kept here and sent with each request, or with `server_state` stays with the connection: if that breaks in the middle
    of an episode the state is lost, and `act` raises SessionLostError until `reset`. It belongs to one loop, and is not
    thread-safe.
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

        `policy` may be None if the server has a default policy. `timeout_s` bounds the first contact, `deadline_ms` (by
        default the same) each `act`, including the replacement of a broken connection. `record` keeps every decision: a
        new .mcap file, a folder, or a Recorder.
        """
        self.url = parse_address(url, SCHEMES)
        super().__init__(
            policy,
            version=version,
            timeout_s=timeout_s,
            deadline_ms=deadline_ms,
            episode=ClientEpisode(server_state=server_state, is_stream=True),
            record=record,
        )
        self._api_key = api_key
        self._socket: WebSocket | None = None
        self._label = secrets.token_hex(8)
        self._is_closed = False
        self._connections = 0
        self.stale = 0
        """Answers that came after their deadline and were dropped."""

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return max(0, self._connections - 1)

    def _act(self, obs: Observation, *, explore: bool, seed: int | None, reward: ArrayLike | None = None) -> Any:
        _ = self.contract
        deadline = time.monotonic() + self._deadline_ms / 1e3
        request, batch = self._encode_request(obs, explore=explore, seed=seed, reward=reward)
        request["seq"] = number = next(self._numbers)
        while True:
            connection = self._connected(deadline)
            contract = self.contract
            fields = self._episode.request_fields(contract, batch)
            fields["deadline_ms"] = max(0.0, 1e3 * (deadline - time.monotonic()))
            try:
                connection.send(pack({**request, **fields}), deadline)
                reply = self._receive_reply(connection, number, deadline)
            except BrokenError:
                self._disconnect()
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                continue  # asking twice is harmless: the server has not kept any memory of ours
            except StateNeededError:
                self._disconnect()  # the version has changed: the next connection sends its contract
                version = contract.version
                self._connected(deadline)
                if self.contract.version == version:
                    raise
                continue
            except DeadlineError:
                silent_s = time.monotonic() - connection.last_receive_at
                if silent_s > max(SILENT_S, SILENT_FACTOR * self._deadline_ms / 1e3):
                    self._disconnect()
                raise DeadlineError(
                    f"{self.url} did not answer within {self._deadline_ms:g} ms", {"deadline_ms": self._deadline_ms}
                ) from None
            try:
                contract = self._answering_contract(reply, number, deadline)
            except _UnmetVersionError:
                self._disconnect()  # the next connection starts with its contract
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                continue
            first = _first_of_chunk(reply.get("actions"), contract, batch)
            action = decode_action(first, batch, contract)
            self._episode.advance(reply, first, contract)
            self.last_reply, self._reward = reply, None
            return action

    def _tell_end(self, request: dict[str, Any]) -> None:
        if self._socket is None:
            raise UnavailableError("the connection broke")
        deadline = time.monotonic() + self._deadline_ms / 1e3
        number = next(self._numbers)
        try:
            self._socket.send(pack({**request, "seq": number, "deadline_ms": self._deadline_ms}), deadline)
            self._receive_reply(self._socket, number, deadline)
        except (BrokenError, DeadlineError):
            self._disconnect()
            raise

    def _close(self) -> None:
        self._disconnect()
        self._is_closed = True

    def _receive_reply(self, connection: WebSocket, number: int, deadline: float) -> dict[str, Any]:
        """Return the reply to request `number`; replies to earlier requests are dropped."""
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
                raise error_of(document, 500) or UnavailableError(f"{self.url} sent {message[:80]!r}")
            return document

    def _connected(self, deadline: float) -> WebSocket:
        while self._socket is None:
            try:
                contract = self._connect(deadline)
                if self._version is None and self._contract is not None and not self._episode.is_bound(self._contract):
                    self._meet(contract)
            except BrokenError:
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                time.sleep(WAIT_S)
        return self._socket

    def _connect(self, deadline: float) -> Contract:
        """Open a connection and return the contract that it starts with."""
        if self._is_closed:
            raise UsageError("the client is closed: make a new one")
        name, version = self._name, self._version
        if self._contract is not None:
            name, version = self._contract.name, None if version is None else self._contract.version
        connection, contract = self._open(self.url, name, version, deadline)
        self._learn(contract)
        self._socket = connection
        self._connections += 1
        self._episode.reconnect()
        return contract

    def _open(self, url: str, name: str | None, version: str | None, deadline: float) -> tuple[WebSocket, Contract]:
        """Return (an open connection to a policy, the contract that it started with)."""
        path = "/" if name is None else f"/v1/policies/{quote(name, safe='')}"
        path += f"/versions/{quote(version, safe='')}/stream" if version else "/stream" if name else ""
        try:
            connection = WebSocket(
                f"{url}{path}?errors=keep", api_key=self._api_key, deadline=deadline, label=self._label
            )
        except HandshakeError as error:
            raise decode_error(url, error.status, error.body) from None
        try:
            return connection, self._receive_contract(connection, deadline)
        except BaseException:
            connection.close()
            raise

    def _fetch_contract(self, timeout_s: float | None) -> Contract:
        return self._connect(time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s))

    def _fetch_version(self, version: str, deadline: float) -> Contract:  # noqa: ARG002
        raise _UnmetVersionError(f"{self.url} answered for version {version[:32]!r}: the action was dropped")

    def _receive_contract(self, connection: WebSocket, deadline: float) -> Contract:
        """Return the contract in the metadata, which a server sends first."""
        message = connection.receive(deadline)
        try:
            metadata = None if isinstance(message, str) else unpack(message)
        except RlservoError:
            metadata = None
        if not isinstance(metadata, dict):
            raise UnavailableError(f"{self.url} did not send a contract first: is it another version of rlservo?")
        return self._parse_contract(metadata.get("contract"))

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class _UnmetVersionError(UnavailableError):
    """The contract of the version that answered has not arrived on any connection yet."""


def _first_of_chunk(chunks: Any, contract: Contract, batch: tuple[int, ...]) -> Any:
    """Return the action without the chunk axis of each leaf; our chunks have one action. Raises ActionError."""
    leaves: dict[str, Any] = {}
    try:
        for name, chunk in action_leaves(contract.action_space, chunks).items():
            array = np.asarray(chunk)
            if array.ndim <= len(batch) or array.shape[len(batch)] != 1:
                raise ActionError(f"the server's {name} has shape {array.shape}: expected a chunk of one action")
            leaves[name] = array[:, 0] if batch else array[0]
    except (RequestError, ValueError) as error:
        raise ActionError(f"the server's action for {contract.name!r} cannot be read: {error}") from error
    return build_action(contract.action_space, leaves)
