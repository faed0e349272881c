"""Sessions: recurrent state of running episodes on the server, bounded in number, evicted when idle.

A session is begun explicitly. A request for one that does not exist gets an error, because a state begun again in the
middle of an episode would give wrong actions without notice. `Sessions` keeps them in this process; `redis_sessions.py`
keeps them where several processes find them.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import RlservoError, SessionError, UnavailableError
from rlservo.serve_app.episodes.request import Request, SessionId, check_client
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.runtime.recurrent_state import State
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore


@dataclass(slots=True)
class Session:
    """One episode, or so many side by side, of one policy in one version."""

    policy: Policy
    state: State | None = None  # None: at its start
    last: dict[str, NDArray[np.generic]] | None = None  # the last action's leaves
    steps: int = 0
    rows: int = 0  # episodes that it takes the place of
    used: float = field(default_factory=time.monotonic)
    begun: float = field(default_factory=time.perf_counter)  # the episode: no two of an id have the same
    connection: Any = None  # of the last request
    seq: int | None = None  # of the last request that was answered
    inputs_hash: bytes = b""  # of its observation
    answer: Decision | None = None  # to the last request, for the same request sent again; None where it had no `seq`
    is_ended: bool = False  # kept only for its answer

    def keep(self, step: Step) -> None:
        """Remember a step's outcome."""
        self.state = step.state or None
        self.last = step.leaves
        self.steps += 1

    def begin(self, policy: Policy) -> None:
        """Forget everything: the next step is an episode's first."""
        self.policy = policy
        self.state = self.last = None
        self.steps = 0

    def answer_again(self, seq: int | None, obs: Any) -> Decision | None:
        """Return the last request's answer if this is the same request again (its reply got lost).

        To compute it twice would move the recurrent state on twice. Raises SessionError for a request that comes out of
        order, and for another one under the last one's number: the old answer would be an action for what is long past.
        """
        if seq is None or self.seq is None or seq > self.seq:
            return None
        if seq == self.seq:
            if self.policy.fingerprint(self.policy.parse(obs).arrays) == self.inputs_hash:
                return self.answer
            raise SessionError(
                f"request {seq} of its session was answered already, for another observation: give every request a "
                "larger 'seq' than the one before, or none",
                {"seq": seq, "last_seq": self.seq},
            )
        raise SessionError(
            f"request {seq} came after request {self.seq} of its session was answered: send them in order",
            {"seq": seq, "last_seq": self.seq},
        )


StepSession: TypeAlias = Callable[[PolicyStore, Request, Session | None], tuple[Decision, Session]]
"""Computes a step: the decision, and the session after it."""

Key: TypeAlias = tuple[str, SessionId]  # (policy name, session id)


class Sessions:
    """The sessions of one process, by policy name and session id."""

    def __init__(self, *, most: int, idle_s: float) -> None:
        """`most` bounds the episodes in memory, in sessions and on streams together (a batch is so many)."""
        self._most = most
        self._idle_s = idle_s
        self._sessions: OrderedDict[Key, Session] = OrderedDict()  # the longest unused come first
        self.rows = 0  # episodes remembered, in sessions and on streams
        self.evicted: Counter[str] = Counter()  # by policy name

    def __len__(self) -> int:
        return len(self._sessions)

    def count(self) -> Counter[str]:
        """Return how many sessions there are, by policy name."""
        self._evict()
        return Counter(name for name, _ in self._sessions)

    def find(self, name: str, session_id: SessionId) -> Session | None:
        """Return a session that is not idle, None where there is none."""
        self._evict()
        return self._sessions.get((name, session_id))

    async def act(
        self, store: PolicyStore, request: Request, session_id: SessionId, step_session: StepSession
    ) -> Decision:
        """Decide for a request of a session. Raises UnavailableError, ClientGoneError, and what `step_session` raises.

        It waits for nothing where requests come in order anyway: on the connection of the last one.
        """
        key = (request.policy, session_id)
        before = self.find(*key)
        if before is None or request.connection is None or request.connection != before.connection:
            await check_client(request)
            before = self.find(*key)
        if before is not None and request.arrived < before.begun:
            raise overtaken(request, session_id)
        decision, after = step_session(store, request, before)
        if after.is_ended:
            self.end(*key)
            return decision
        more = after.rows - (0 if before is None else before.rows)
        self._check_room(more)
        self.rows += more
        after.connection, after.used = request.connection, time.monotonic()
        self._sessions[key] = after
        self._sessions.move_to_end(key)
        return decision

    def end(self, name: str, session_id: SessionId) -> None:
        """Forget a session."""
        session = self._sessions.pop((name, session_id), None)
        if session is not None:
            self.rows -= session.rows

    def reserve(self, stream: Session, rows: int) -> None:
        """Reserve the places of a stream's episodes. Raises UnavailableError, and nothing has changed."""
        self._evict()
        self._check_room(rows - stream.rows)
        self.rows += rows - stream.rows
        stream.rows = rows

    def release(self, stream: Session) -> None:
        """Give the places of a stream's episodes back."""
        self.rows -= stream.rows
        stream.rows = 0

    def _check_room(self, more: int) -> None:
        if more > 0 and self.rows + more > self._most:
            what = "another episode" if more == 1 else f"{more} more episodes (a batch is so many)"
            raise UnavailableError(
                f"the server remembers {self.rows} episodes already, at most {self._most}, and has no room for {what}: "
                f"end a session, wait until an idle one is evicted ({self._idle_s:g} s), or send the state along with "
                "each request",
                {"episodes": self.rows, "most": self._most},
            )

    def _evict(self) -> None:
        oldest = time.monotonic() - self._idle_s
        while self._sessions:
            name, session_id = next(iter(self._sessions))
            if self._sessions[name, session_id].used > oldest:
                break
            self.end(name, session_id)
            self.evicted[name] += 1


def overtaken(request: Request, session_id: SessionId) -> RlservoError:
    """Return the error of a request during which another one began its session."""
    shown = f"session '{shorten(session_id)}' of policy '{request.policy[:64]}'"
    if request.episode is not None and request.episode.reset:
        return UnavailableError(f"another request began {shown} at the same time: try again")
    return SessionError(f"the request was under way when another one began {shown} again: it is of the episode before")


def shorten(session_id: SessionId) -> str:
    """Return an id as an error's sentence may show it."""
    return str(session_id)[:64]
