"""`PolicyClient`: a policy on a server, used over HTTP like a policy in process.

A robot's loop gets an action for the observation that it just sent, in time, or an error: every request has a sequence
number `seq`, and an answer with another number, a late one or a malformed one is never used.
"""

from __future__ import annotations

import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import StateNeededError, UnavailableError, UnknownPolicyError, UsageError
from rlservo.serve_app.client.client_episode import ClientEpisode
from rlservo.serve_app.client.http_transport import Transport, encode
from rlservo.serve_app.client.remote_policy import RemotePolicy
from rlservo.serve_app.client.replies import answering_version, decode_action
from rlservo.serve_app.interface import Observation

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
        self._transport = Transport(url, timeout_s=timeout_s, retries=retries, api_key=api_key)
        self.url = self._transport.url
        self._label = label
        self._begin_label()
        super().__init__(
            policy,
            version=version,
            timeout_s=timeout_s,
            deadline_ms=deadline_ms,
            episode=ClientEpisode(server_state=server_state, is_stream=False),
            record=record,
        )

    @property
    def reconnects(self) -> int:
        """Number of connections after the first."""
        return self._transport.reconnects

    def reset(self) -> None:
        """Start an episode: the next request carries it. Sends nothing."""
        super().reset()
        self._begin_label()
        # A version number needs no lookup.
        known = self._contract
        self._looks_up = self._version is not None and known is not None and self._version != known.version

    def _begin_label(self) -> None:
        number = secrets.token_hex(8 if self._label is None else 4)
        self._transport.label = number if self._label is None else f"{self._label}.{number}"

    def _act(self, obs: Observation, *, explore: bool, seed: int | None, reward: ArrayLike | None = None) -> Any:
        contract = self.contract
        deadline = time.monotonic() + self._deadline_ms / 1e3
        request, batch = self._encode_request(obs, explore=explore, seed=seed, reward=reward)
        request["seq"] = number = next(self._numbers)
        try:
            reply = self._post({**request, **self._episode.request_fields(contract, batch)}, self._deadline_ms)
        except StateNeededError:
            if self._episode.is_carried(contract) or self._episode.is_on_server(contract):
                raise
            # The contract does not say whether the server limits the step from one action to the next.
            self._episode.carry()
            request["seq"] = number = next(self._numbers)
            fields = self._episode.request_fields(contract, batch)
            reply = self._post({**request, **fields}, 1e3 * (deadline - time.monotonic()))
        contract = self._answering_contract(reply, number, deadline)
        action = decode_action(reply.get("action"), batch, contract)
        self._episode.advance(reply, reply["action"], contract)
        self.last_reply, self._reward = reply, None
        return action

    def _tell_end(self, request: dict[str, Any]) -> None:
        number = next(self._numbers)
        answering_version(self.url, self._post({**request, "seq": number}, self._deadline_ms), number, self.contract)

    def _close(self) -> None:
        self._transport.close()

    def _post(self, request: dict[str, Any], deadline_ms: float) -> Any:
        """Send a request for an action and return the reply."""
        contract = self.contract
        # The server drops requests that would be late, instead of working through a queue of abandoned ones.
        body = encode({**request, "deadline_ms": deadline_ms})
        version = () if self._version is None else ("versions", contract.version)
        return self._transport.post(
            "v1", "policies", contract.name, *version, "act", body=body, timeout_s=deadline_ms / 1e3
        )

    def _fetch_contract(self, timeout_s: float | None) -> Contract:
        retries = None if timeout_s is None else 0
        name = self._name
        if name is None:
            name = _only_policy(self._transport.get("v1", "policies", timeout_s=timeout_s, retries=retries))
        version = () if self._version is None else ("versions", self._version)
        document = self._transport.get("v1", "policies", name, *version, timeout_s=timeout_s, retries=retries)
        return self._parse_contract(document)

    def _fetch_version(self, version: str, deadline: float) -> Contract:
        path = ("v1", "policies", self.contract.name, "versions", version)
        timeout_s = max(deadline - time.monotonic(), 0.001)
        return self._parse_contract(self._transport.get(*path, timeout_s=timeout_s, retries=0))


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
