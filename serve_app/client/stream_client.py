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

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import DeadlineError, RlservoError, StateNeededError, UnavailableError
from rlservo.serve_app.client.client_episode import ClientEpisode
from rlservo.serve_app.client.http_transport import Transport
from rlservo.serve_app.client.remote_policy import RemotePolicy
from rlservo.serve_app.client.replies import error_of
from rlservo.serve_app.client.websocket_connection import BrokenError, WebSocket
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
        transport = Transport(url, timeout_s=timeout_s, retries=0, api_key=api_key, schemes=SCHEMES)
        super().__init__(
            transport,
            policy,
            version=version,
            timeout_s=timeout_s,
            deadline_ms=deadline_ms,
            episode=ClientEpisode(server_state=server_state, is_stream=True),
            record=record,
        )
        self._timeout_s = timeout_s
        transport.label = secrets.token_hex(8)  # during a canary, all its connections get the same version
        self._socket: WebSocket | None = None
        self._address: tuple[str, str | None] = ("", None)  # policy and version of the last connection
        self._connections = 0
        self.stale = 0
        """Answers that came after their deadline and were dropped."""

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return max(0, self._connections - 1)

    def close(self) -> None:
        """Close the connection, as `RemotePolicy.close`."""
        self._disconnect()
        super().close()

    def _exchange(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float, *, ends: bool) -> Any:
        is_version_new = False
        while True:
            connection = self._connected(self.contract, deadline)
            fields = self._episode.request_fields(self.contract, batch, ends=ends)
            fields["deadline_ms"] = max(0.0, 1e3 * (deadline - time.monotonic()))
            try:
                connection.send(pack({**request, **fields}), deadline)
                return self._receive_reply(connection, request["seq"], deadline)
            except BrokenError:
                self._disconnect()
                if time.monotonic() + WAIT_S >= deadline:
                    raise  # before that, asking twice is harmless: the server has not kept any memory of ours
            except StateNeededError:
                if is_version_new:
                    raise
                is_version_new = True  # and remembers: only a new connection has a memory
                self._disconnect()
                self._meet(self._fetch_contract(self._version, max(deadline - time.monotonic(), 0.001)))
            except DeadlineError:
                silent_s = time.monotonic() - connection.last_receive_at
                if silent_s > max(SILENT_S, SILENT_FACTOR * self._deadline_ms / 1e3):
                    self._disconnect()
                raise DeadlineError(
                    f"{self.url} did not answer within {self._deadline_ms:g} ms", {"deadline_ms": self._deadline_ms}
                ) from None

    def _receive_reply(self, connection: WebSocket, number: int, deadline: float) -> dict[str, Any]:
        """Return the reply to request `number`; replies to earlier requests are dropped."""
        while True:
            document = self._receive(connection, deadline)
            seq = document.get("seq")
            if type(seq) is int and seq < number:
                self.stale += 1
            elif (error := error_of(document, 500)) is not None:
                raise error
            else:
                return document

    def _receive(self, connection: WebSocket, deadline: float) -> dict[str, Any]:
        message = connection.receive(deadline)
        try:
            document = json.loads(message) if isinstance(message, str) else unpack(message)
        except (ValueError, RlservoError) as error:
            raise UnavailableError(f"{self.url} sent a message that cannot be read: {error}") from error
        if not isinstance(document, dict):
            raise UnavailableError(f"{self.url} sent a {type(document).__name__}, expected a map")
        return document

    def _connected(self, contract: Contract, deadline: float) -> WebSocket:
        """Return the connection to a policy, or to the version that was named."""
        address = (contract.name, None if self._version is None else contract.version)
        if address != self._address:
            self._disconnect()
        while self._socket is None:
            try:
                self._socket, _ = self._open(_path(*address), deadline)
            except BrokenError:
                if time.monotonic() + WAIT_S >= deadline:
                    raise
                time.sleep(WAIT_S)
                continue
            self._address = address
            self._connections += 1
            self._episode.reconnect()
        return self._socket

    def _open(self, path: str, deadline: float) -> tuple[WebSocket, dict[str, Any]]:
        """Return an open connection, and the metadata that it began with."""
        self._transport.check_open()
        connection = WebSocket(self._transport, f"{path}?errors=keep", deadline)
        try:
            metadata = self._receive(connection, deadline)
            if (error := error_of(metadata, 500)) is not None:
                raise error
            return connection, metadata
        except BaseException:
            connection.close()
            raise

    def _find_name(self, timeout_s: float | None, retries: int | None) -> str:  # noqa: ARG002
        """Return the name of the server's default policy."""
        connection, metadata = self._open("/", time.monotonic() + (timeout_s or self._timeout_s))
        connection.close()
        return str(metadata.get("policy"))

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


def _path(name: str, version: str | None) -> str:
    which = "" if version is None else f"/versions/{quote(version, safe='')}"
    return f"/v1/policies/{quote(name, safe='')}{which}/stream"
