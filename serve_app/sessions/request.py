"""Request for an action in the form that all protocols share, its episode, and the fields of its reply."""

from __future__ import annotations

import hashlib
import re
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from rlservo.errors import DeadlineError
from rlservo.serve_app.sessions.session import Session
from rlservo.serve_app.versions.policy_store import Decision

SessionId: TypeAlias = str | int
"""Triton's clients number their sequences; 7 and "7" are different."""

LONGEST_SESSION_ID = 128
LONGEST_LABEL = LONGEST_SESSION_ID  # a header may have 16 KB
TRACEPARENT = b"traceparent"
_TRACE = re.compile(rb"(?!ff)[0-9a-f]{2}-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")


def trace_id(headers: Mapping[bytes, bytes]) -> str | None:
    """Return the id of the client's trace (W3C trace context); None if the header is absent or has another form."""
    found = _TRACE.fullmatch(headers.get(TRACEPARENT, b""))
    return None if found is None else found[1].decode()


def new_episode_id(label: str | None) -> str:
    """Return an id for an episode or a stream of a client with this label."""
    return secrets.token_hex(8) if label is None else f"{shorten_label(label)}.{secrets.token_hex(4)}"


def shorten_label(label: str) -> str:
    """Return a label for an episode's id: a long one is cut and gets a hash."""
    if len(label) <= LONGEST_LABEL:
        return label
    digest = hashlib.blake2b(label.encode("utf-8", "surrogatepass"), digest_size=8).hexdigest()
    return f"{label[: LONGEST_LABEL - len(digest) - 1]}.{digest}"


@dataclass(slots=True)
class Request:
    """A request for an action, or for a batch of them.

    A transport (HTTP, WebSocket, gRPC) makes it from the address and the headers, before it reads the content; the
    protocol's codec fills in the rest from the content.
    """

    protocol: str
    """Name in metrics and log."""
    policy: str = ""
    version: str | None = None
    """A version or an alias; None is the default version."""
    received: float = field(default_factory=time.perf_counter)
    """Time of arrival of its first byte, by `time.perf_counter`."""

    arrived: float = field(default_factory=time.perf_counter)
    """Time at which this process saw it; `received` may be earlier."""
    connection: Any = None
    """Address of the client's own connection, on which requests come in order; None if unknown."""
    has_hung_up: Callable[[], Awaitable[bool]] | None = None
    """Tells whether its client has disconnected; None if that cannot be known."""
    label: str | None = None
    """Name that the client gave itself: during a canary, all requests with one label get the same version."""
    request_id: str | None = None
    peer: str | None = None
    """The client's address, for the log; given if the request may be refused before it is routed."""
    headers: Mapping[bytes, bytes] = field(default_factory=dict)
    """Headers of an HTTP message, or metadata of a gRPC call."""
    is_fresh: bool = False
    """Whether it came after the stream's last reply, so it did not wait while the server was blocked."""
    stream: Session | None = None
    """The episode of its stream."""
    stream_id: str | None = None
    """Id of its WebSocket, whose requests share it and are distinguished by `seq`."""

    may_explore: bool = False
    """Whether its key may ask for exploratory actions."""

    obs: Any = None
    explore: bool = False
    seed: int | None = None
    seq: int | None = None
    """The client's request number, echoed in the reply."""
    deadline_ms: float | None = None
    """[ms] After `received`; a request that is late by then is not computed."""
    timestamp: float | None = None
    """[s] The client's clock, echoed in the reply."""
    state: Mapping[str, Any] | None = None
    """The recurrent state that the client carries (see `carried_state.py`); empty at an episode's start. None: not
    carried."""
    session_id: SessionId | None = None
    reset: bool = False  # begin the session, or the stream's episode
    end: bool = False  # forget the session after this request
    reward: Any = None
    final_status: str | None = None
    """End of the episode, in the client's words: the observation is the one after its last action."""
    truncated: bool = False  # whether it was cut off, as by a time limit
    last_action: Any = None  # the robot's last command, if the step from it is limited
    non_finite: bool = False
    """Whether its JSON held NaN or Infinity, which JSON does not have."""
    reply_options: Any = None
    """Form of the reply, from the codec's `parse` to its `encode`."""

    @property
    def begins(self) -> bool:
        """Whether it is its episode's first one."""
        return self.reset or (self.state is not None and not self.state)


class ClientGoneError(Exception):
    """The client hung up: there is nothing to answer or count."""


async def check_client(request: Request) -> None:
    """Raise ClientGoneError if a session's client has given up its request: its next episode may have begun."""
    if request.has_hung_up is not None and await request.has_hung_up():
        raise ClientGoneError


def check_deadline(request: Request) -> None:
    """Raise DeadlineError for a request whose deadline has passed."""
    late_ms = (time.perf_counter() - request.received) * 1e3
    if request.deadline_ms is not None and late_ms >= request.deadline_ms:
        raise DeadlineError(
            f"the deadline of {request.deadline_ms:g} ms passed before inference: no action was computed",
            {"deadline_ms": request.deadline_ms, "elapsed_ms": round(late_ms, 3), "seq": request.seq},
        )


def reply_fields(request: Request, decision: Decision) -> dict[str, Any]:
    """Return a reply's fields besides the action; empty ones are left out.

    `policy`, `version`, `infer_ms`, `seq`, `warnings` (a tuple of sentences), `session_id`, `session_step`, `state`
    (a dict of arrays, with what `carried_state.py` adds), `timestamp`, `received_at`, `sent_at`.
    """
    fields: dict[str, Any] = {
        "policy": decision.name,
        "version": decision.version,
        "infer_ms": round(decision.infer_ms, 4),
    }
    if request.seq is not None:
        fields["seq"] = request.seq
    if decision.notices:
        fields["warnings"] = decision.notices
    if decision.session_id is not None:
        fields["session_id"] = decision.session_id
    if decision.session_step is not None:
        fields["session_step"] = decision.session_step
    if decision.state is not None:
        fields["state"] = decision.state
    if request.timestamp is not None:
        now = time.time()
        fields["timestamp"] = request.timestamp
        fields["received_at"] = now - (time.perf_counter() - request.received)
        fields["sent_at"] = now
    return fields
