"""`PolicyClient`: a policy on a server, used over HTTP like a policy in process.

A robot's loop gets an action for the observation that it just sent, in time, or an error: every request has a sequence
number `seq`, and an answer with another number, a late one or a malformed one is never used.
"""

from __future__ import annotations

import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.export.contract.errors import StateNeededError, UsageError
from rlservo.serve_app.client.client_episode import ClientEpisode
from rlservo.serve_app.client.http_transport import Transport, encode
from rlservo.serve_app.client.remote_policy import RemotePolicy

if TYPE_CHECKING:
    from rlservo.serve_app.recording.recorder import Recorder


class PolicyClient(RemotePolicy):
    """One policy of an rlservo server.

    ```python
    with PolicyClient("http://127.0.0.1:8000", "ur5") as policy:
        action = policy.act(obs)
    ```

    Without `version` each request uses the version that the server has in use: if `production` moves, or a canary
    begins or ends, a running loop follows, provided that observations and actions are the same (otherwise the answer is
    refused). A canary's share is drawn once per `reset`, and an episode with a recurrent state ends with the version
    that began it. With `version` the loop stays with that version; an alias is resolved at the first request of every
    episode.

    Thread-safe for stateless policies: threads share the connections and each gets the answer to its own request.
    A recurrent policy's state is kept here and sent with each request, and so is the last action if the server limits
    the step from it: such a client belongs to one loop, and its memory survives a replica's death. With `server_state`
    the memory stays on the server instead, in a session of this client, which saves sending large states (camera
    frames) and raises SessionLostError if the server has lost it.
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
        label: str | None = None,
    ) -> None:
        """Check the arguments; the first request is sent when `contract` or `act` needs it.

        `policy` may be None if the server has exactly one. `timeout_s` bounds one call including its retries;
        `deadline_ms` replaces it for each `act`. `retries` counts further attempts after a failed connection or a 503;
        nothing else is ever sent twice. `record` keeps every decision: a new .mcap file, a folder, or a Recorder.
        `label` names this loop: in the server's own recording, its requests between two `reset`s are one episode, with
        a random name if there is no label. Threads that share a client share its episode.
        """
        if label is not None and not (label and label.isascii() and label.isprintable() and len(label) <= 100):
            raise UsageError(f"label must be 1 to 100 printable ASCII characters, got {label[:100]!r}")
        super().__init__(
            Transport(url, timeout_s=timeout_s, retries=retries, api_key=api_key),
            policy,
            version=version,
            timeout_s=timeout_s,
            deadline_ms=deadline_ms,
            episode=ClientEpisode(server_state=server_state, is_stream=False),
            record=record,
        )
        self._label = label
        self._begin_label()

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return self._transport.reconnects

    def reset(self) -> None:
        """Start an episode: the next request carries it. Sends nothing."""
        super().reset()
        self._begin_label()

    def _begin_label(self) -> None:
        number = secrets.token_hex(8 if self._label is None else 4)
        self._transport.label = number if self._label is None else f"{self._label}.{number}"

    def _exchange(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float, *, ends: bool) -> Any:
        left_ms, episode = self._deadline_ms, self._episode
        while True:
            contract = self.contract
            version = () if self._version is None else ("versions", contract.version)
            # With `deadline_ms` the server drops requests that would be late, instead of working through a queue.
            fields = {**episode.request_fields(contract, batch, ends=ends), "deadline_ms": left_ms}
            try:
                return self._transport.post(
                    *("v1", "policies", contract.name, *version, "act"),
                    body=encode({**request, **fields}),
                    timeout_s=left_ms / 1e3,
                )
            except StateNeededError:
                if episode.is_carried(contract) or episode.is_on_server(contract):
                    raise
                # The contract does not say whether the server limits the step from one action to the next.
                episode.carry()
                left_ms = 1e3 * (deadline - time.monotonic())
