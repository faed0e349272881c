"""`StreamClient`: a policy on a server over one WebSocket, used like `PolicyClient`.

A stream saves the HTTP overhead of each request. It reconnects automatically, and late answers are recognised by their
number and never used.
"""

from __future__ import annotations

import time
from typing import Any
from urllib.parse import quote

import orjson

from rlservo.bundle.contract import Contract
from rlservo.client.formats.msgpack_arrays import pack, unpack
from rlservo.client.http_transport import BrokenError
from rlservo.client.remote_policy import RemotePolicy
from rlservo.client.replies import error_of
from rlservo.client.websocket_connection import WebSocket
from rlservo.errors import DeadlineError, RlservoError, UnavailableError

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

    _is_stream = True
    _schemes = SCHEMES
    _socket: WebSocket | None = None
    _address: tuple[str, str | None] = ("", None)  # policy and version of the last connection
    stale = 0
    """Answers that came after their deadline and were dropped."""

    def _send(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float) -> Any:
        while True:
            try:
                connection = self._connected(self.contract, deadline)
                fields = self._episode.request_fields(self.contract, batch, ends="final_status" in request)
                fields["deadline_ms"] = max(0.0, 1e3 * (deadline - time.monotonic()))
                connection.send(pack({**request, **fields}), deadline)
                return self._receive(connection, request["seq"], deadline)
            except BrokenError:
                wait_s = WAIT_S if self._socket is None else 0.0
                self._disconnect()
                if time.monotonic() + wait_s + WAIT_S >= deadline:
                    raise  # before that, asking twice is harmless: the server has not kept any memory of ours
                time.sleep(wait_s)
            except DeadlineError:
                silent_s = 0.0 if self._socket is None else time.monotonic() - self._socket.last_receive_at
                if silent_s > max(SILENT_S, SILENT_FACTOR * self._deadline_ms / 1e3):
                    self._disconnect()
                raise DeadlineError(
                    f"{self.url} did not answer within {self._deadline_ms:g} ms", {"deadline_ms": self._deadline_ms}
                ) from None

    def _receive(self, connection: WebSocket, number: int, deadline: float) -> dict[str, Any]:
        """Return the reply to request `number`; replies to earlier requests are dropped."""
        while True:
            message = connection.receive(deadline)
            try:
                document = orjson.loads(message) if isinstance(message, str) else unpack(message)
            except (ValueError, RlservoError) as error:
                raise UnavailableError(f"{self.url} sent a message that cannot be read: {error}") from error
            if not isinstance(document, dict):
                raise UnavailableError(f"{self.url} sent a {type(document).__name__}, expected a map")
            seq = document.get("seq")
            if type(seq) is int and seq < number:
                self.stale += 1
            elif (refusal := error_of(document, 500)) is not None:
                raise refusal
            else:
                return document

    def _connected(self, contract: Contract, deadline: float) -> WebSocket:
        """Return the connection to a policy, or to the version that was named."""
        address = (contract.name, None if self._version is None else contract.version)
        if address != self._address:
            self._disconnect()
        if self._socket is None:
            which = "" if self._version is None else f"/versions/{quote(contract.version, safe='')}"
            path = f"/v1/policies/{quote(contract.name, safe='')}{which}/stream?errors=keep"
            self._socket, self._address = WebSocket(self._transport, path, deadline), address
            try:
                self._receive(self._socket, 0, deadline)  # the metadata
            except BaseException:
                self._disconnect()
                raise
            self._episode.reconnect()
        return self._socket

    def _fetch_contract(self, version: str | None, timeout_s: float | None) -> Contract:
        """Also open the connection, so that no `act` waits for it."""
        deadline = time.monotonic() + (timeout_s or self._timeout_s)
        contract = super()._fetch_contract(version, timeout_s)
        self._connected(contract, deadline)
        return contract

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
