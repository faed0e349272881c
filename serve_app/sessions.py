"""Memories of running episodes, kept on the server: bounded in number, evicted when idle, never begun by accident.

A session is begun explicitly and belongs to this process. Whoever asks for one that is not here gets an error, because
a memory begun anew in the middle of an episode would give wrong actions without a word. It knows nothing of protocols.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rlservo.export.errors import SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.memory import State
from rlservo.serve_app.policy import Policy
from rlservo.serve_app.store import Decision


@dataclass(slots=True)
class Session:
    """One episode, or so many side by side, of one policy in one version."""

    policy: Policy
    state: State | None = None  # None: at its start
    last: dict[str, NDArray[np.generic]] | None = None  # the last action's leaves
    steps: int = 0
    used: float = field(default_factory=time.monotonic)
    seq: int | None = None  # of the last request that was answered
    answer: Decision | None = None  # to the last request, for the same request sent again

    def begin(self) -> None:
        """Forget everything: the next step is an episode's first."""
        self.state = self.last = self.seq = self.answer = None
        self.steps = 0

    def repeated(self, seq: int | None) -> Decision | None:
        """Return the answer there was, when this is the last request again (its reply got lost).

        To compute it twice would move the memory on twice. Raises SessionError for a request that comes out of order.
        """
        if seq is None or self.seq is None or seq > self.seq:
            return None
        if seq == self.seq:
            return self.answer
        raise SessionError(
            f"request {seq} came after request {self.seq} of its session was answered: send them in order",
            {"seq": seq, "last_seq": self.seq},
        )


class Sessions:
    """The sessions of one process, by policy name and session id."""

    def __init__(self, *, most: int, idle_s: float) -> None:
        self._most = most
        self._idle_s = idle_s
        self._sessions: OrderedDict[tuple[str, str], Session] = OrderedDict()  # the longest unused first
        self.evicted = 0

    def __len__(self) -> int:
        return len(self._sessions)

    def begin(self, name: str, session_id: str, policy: Policy) -> Session:
        """Return a new session; one of that id ends. Raises UnavailableError when there are too many."""
        self._evict()
        key = (name, session_id)
        self._sessions.pop(key, None)
        if len(self._sessions) >= self._most:
            raise UnavailableError(
                f"the server keeps {self._most} sessions already: end one, wait until an idle one is evicted "
                f"({self._idle_s:g} s), or send the state along with each request"
            )
        session = self._sessions[key] = Session(policy)
        return session

    def find(self, name: str, session_id: str) -> Session:
        """Return a session that was begun here. Raises SessionLostError."""
        self._evict()
        session = self._sessions.get((name, session_id))
        if session is None:
            raise SessionLostError(
                f"this server has no session '{session_id[:64]}' of policy '{name[:64]}': it was never begun, was "
                f"ended, was idle for {self._idle_s:g} s, or ended with its process or its version: begin an episode",
                {"session_id": session_id[:64], "policy": name[:64]},
            )
        session.used = time.monotonic()
        self._sessions.move_to_end((name, session_id))
        return session

    def peek(self, name: str, session_id: str) -> Session | None:
        """Return a session, if it is here, without counting that as its use."""
        return self._sessions.get((name, session_id))

    def end(self, name: str, session_id: str) -> None:
        """Forget a session."""
        self._sessions.pop((name, session_id), None)

    def _evict(self) -> None:
        oldest = time.monotonic() - self._idle_s
        while self._sessions:
            key, session = next(iter(self._sessions.items()))
            if session.used > oldest:
                return
            del self._sessions[key]
            self.evicted += 1
