"""`PolicyClient`: a policy on a server, used over HTTP like a policy in process.

A robot's loop gets an action for the observation that it just sent, in time, or an error: every request has a sequence
number `seq`, and an answer with another number, a late one or a malformed one is never used.
"""

from __future__ import annotations

import time
from typing import Any

from rlservo.client.remote_policy import RemotePolicy


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

    With `label`, the server's recording names its requests between two `reset`s as one episode of that label.
    """

    def _send(self, request: dict[str, Any], batch: tuple[int, ...], deadline: float) -> Any:
        contract, left_s = self.contract, deadline - time.monotonic()
        version = () if self._version is None else ("versions", contract.version)
        fields = self._episode.request_fields(contract, batch, ends="final_status" in request)
        # The server drops requests that would be late, instead of working through a queue.
        fields["deadline_ms"] = 1e3 * left_s
        path = ("v1", "policies", contract.name, *version, "act")
        return self._transport.post(*path, document={**request, **fields}, timeout_s=left_s)
