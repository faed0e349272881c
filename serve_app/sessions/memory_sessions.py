"""Sessions in this process, bounded in number, evicted when idle.

A session is begun explicitly. A request for an unknown session gets an error, because a state restarted in the middle
of an episode would give wrong actions silently. `redis_sessions.py` keeps sessions that several processes share.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import TypeAlias

from rlservo.errors import RlservoError, SessionError, UnavailableError
from rlservo.serve_app.sessions.request import Request, SessionId, check_client
from rlservo.serve_app.sessions.session import Session
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore

StepSession: TypeAlias = Callable[[PolicyStore, Request, Session | None], tuple[Decision, Session]]
"""Computes a step: the decision, and the session after it."""


class MemorySessions:
    """The sessions of one process, by policy name and session id."""

    def __init__(self, *, most: int, idle_s: float) -> None:
        """`most` bounds the episodes in memory, in sessions and on streams together (each row of a batch is one)."""
        self._most = most
        self._idle_s = idle_s
        # By policy name and session id; the least recently used come first.
        self._sessions: OrderedDict[tuple[str, SessionId | None], Session] = OrderedDict()
        self.rows = 0  # episodes remembered, in sessions and on streams
        self.evicted: Counter[str] = Counter()  # by policy name

    def count(self) -> Counter[str]:
        """Return the number of sessions, by policy name."""
        self._evict()
        return Counter(name for name, _ in self._sessions)

    def find(self, name: str, session_id: SessionId | None) -> Session | None:
        """Return a session that is not idle, or None."""
        self._evict()
        return self._sessions.get((name, session_id))

    async def act(self, store: PolicyStore, request: Request, step_session: StepSession) -> Decision:
        """Decide for a request of a session. Raises UnavailableError, ClientGoneError, and what `step_session` raises.

        It does not wait on the last request's connection, where requests come in order anyway.
        """
        key = (request.policy, request.session_id)
        before = self.find(*key)
        if before is None or request.connection is None or request.connection != before.connection:
            await check_client(request)
            before = self.find(*key)
        if before is not None and request.arrived < before.begun:
            raise overtaken(request)
        decision, after = step_session(store, request, before)
        if after.is_ended:
            self.end(*key)
            return decision
        self._count(after.rows - (0 if before is None else before.rows))
        after.connection, after.used = request.connection, time.monotonic()
        self._sessions[key] = after
        self._sessions.move_to_end(key)
        return decision

    def end(self, name: str, session_id: SessionId | None) -> None:
        """Forget a session."""
        session = self._sessions.pop((name, session_id), None)
        if session is not None:
            self.rows -= session.rows

    def reserve(self, stream: Session, rows: int) -> None:
        """Change the number of a stream's episodes. Raises UnavailableError, and then changes nothing."""
        if rows != stream.rows:
            self._evict()
            self._count(rows - stream.rows)
            stream.rows = rows

    def _count(self, more: int) -> None:
        """Count more episodes in memory. Raises UnavailableError if there is no room."""
        if more > 0 and self.rows + more > self._most:
            what = "another episode" if more == 1 else f"{more} more episodes (one per row of the batch)"
            raise UnavailableError(
                f"the server remembers {self.rows} of at most {self._most} episodes and has no room for {what}: end a "
                f"session, wait until an idle one is evicted ({self._idle_s:g} s), or send the state along with each "
                "request",
                {"episodes": self.rows, "most": self._most},
            )
        self.rows += more

    def _evict(self) -> None:
        oldest = time.monotonic() - self._idle_s
        while self._sessions:
            name, session_id = next(iter(self._sessions))
            if self._sessions[name, session_id].used > oldest:
                break
            self.end(name, session_id)
            self.evicted[name] += 1


def overtaken(request: Request) -> RlservoError:
    """Return the error for a request whose session was begun again meanwhile."""
    shown = f"session '{request.session_id!s:.64}' of policy '{request.policy[:64]}'"
    if request.reset:
        return UnavailableError(f"another request started {shown} at the same time: try again")
    return SessionError(f"the request belongs to an earlier episode: another request has restarted {shown} since")
