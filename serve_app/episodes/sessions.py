"""Sessions: recurrent state of running episodes on the server, bounded in number, evicted when idle.

A session is begun explicitly and belongs to this process. Whoever asks for one that is not here gets an error, because
a state begun anew in the middle of an episode would give wrong actions without a word. What is bounded is episodes (a
batch is so many side by side), in sessions and on streams together. A session of a policy that remembers nothing only
keeps its version, takes no place, and makes room for a newer one.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.runtime.recurrent_state import State
from rlservo.serve_app.versions.policy_store import Decision

SWEEP_S = 1.0  # [s] at least between two looks for idle sessions

SessionId: TypeAlias = str | int
"""Triton's clients number their sequences; 7 and "7" are two."""


@dataclass(slots=True)
class Session:
    """One episode, or so many side by side, of one policy in one version."""

    policy: Policy
    state: State | None = None  # None: at its start
    last: dict[str, NDArray[np.generic]] | None = None  # the last action's leaves
    steps: int = 0
    rows: int = 0  # episodes that it takes the place of
    used: float = field(default_factory=time.monotonic)
    begun: float = field(default_factory=time.perf_counter)
    connection: Any = None  # of the last request
    seq: int | None = None  # of the last request that was answered
    inputs_hash: bytes = b""  # of its observation
    answer: Decision | None = None  # to the last request, for the same request sent again
    token: str = ""  # of its episode, where several replicas serve (`shared_sessions.py`, as the next two)
    stamps: deque[bytes] = field(default_factory=lambda: deque(maxlen=8))  # the proxy's, of the last requests
    stamped: Decision | None = None  # the answer to the last of them

    def keep(self, step: Step) -> None:
        """Remember what a step came to."""
        self.state = step.state or None
        self.last = step.leaves
        self.steps += 1

    def begin(self, policy: Policy) -> None:
        """Forget everything: the next step is an episode's first."""
        self.policy = policy
        self.state = self.last = self.seq = self.answer = None
        self.steps = 0

    def answer_again(self, seq: int | None, obs: Any) -> Decision | None:
        """Return the answer there was, when this is the last request again (its reply got lost).

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


Key: TypeAlias = tuple[str, SessionId]  # (policy name, session id)


class Sessions:
    """The sessions of one process, by policy name and session id."""

    def __init__(self, *, most: int, idle_s: float) -> None:
        """`most` bounds the episodes that are remembered, and apart from them the sessions that remember none."""
        self._most = most
        self._idle_s = idle_s
        self._sessions: OrderedDict[Key, Session] = OrderedDict()  # the longest unused come first
        self._sweeper: asyncio.TimerHandle | None = None
        self.rows = 0  # episodes remembered, in sessions and on streams
        self.begun: Counter[str] = Counter()  # by policy name, as the next two
        self.evicted: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._sessions)

    def count(self) -> Counter[str]:
        """Return how many sessions there are, by policy name."""
        return Counter(name for name, _ in self._sessions)

    def check_room(self, name: str, session_id: SessionId) -> None:
        """Raise UnavailableError where not even one more episode could be remembered: before any work for it."""
        self._evict()
        before = self._sessions.get((name, session_id))
        if self.rows >= self._most and (before is None or not before.rows):
            raise self._full(1)

    def put(self, name: str, session_id: SessionId, session: Session, rows: int) -> None:
        """Keep a session that was begun; one of that id ends. Raises UnavailableError, and nothing has changed."""
        self._evict()
        key = (name, session_id)
        before = self._sessions.get(key)
        if rows and self.rows - (0 if before is None else before.rows) + rows > self._most:
            raise self._full(rows)
        self.end(name, session_id)
        session.rows = rows
        session.used = time.monotonic()
        self.rows += rows
        self.begun[name] += 1
        self._sessions[key] = session
        if not rows:
            stateless = [each for each, other in self._sessions.items() if not other.rows]
            if len(stateless) > self._most:
                del self._sessions[stateless[0]]
        self._sweep_later()

    def reserve(self, stream: Session, rows: int) -> None:
        """Reserve the places of a stream's episodes. Raises UnavailableError, and nothing has changed."""
        more = rows - stream.rows
        if more > 0:
            self._evict()
            if self.rows + more > self._most:
                raise self._full(rows)
        stream.rows = rows
        self.rows += more

    def release(self, stream: Session) -> None:
        """Give the places of a stream's episodes back."""
        self.rows -= stream.rows
        stream.rows = 0

    def use(self, name: str, session_id: SessionId) -> Session:
        """Return a session that was begun here, which is used by that; one lost is counted. Raises SessionLostError."""
        self._evict()
        key = (name, session_id)
        session = self._sessions.get(key)
        if session is None:
            self.lost[name] += 1
            raise SessionLostError(
                f"this server has no session '{shorten(session_id)}' of policy '{name[:64]}': it was never begun, was "
                f"ended, was idle for {self._idle_s:g} s, or ended with its process or its version: begin an episode",
                {"session_id": shorten(session_id), "policy": name[:64]},
            )
        session.used = time.monotonic()
        self._sessions.move_to_end(key)
        return session

    def peek(self, name: str, session_id: SessionId) -> Session | None:
        """Return a session, if it is here and not idle, without counting that as its use."""
        session = self._sessions.get((name, session_id))
        return session if session is not None and session.used > time.monotonic() - self._idle_s else None

    def end(self, name: str, session_id: SessionId, *, lost: bool = False) -> None:
        """Forget a session; `lost` counts it among those that a client will miss."""
        session = self._sessions.pop((name, session_id), None)
        if session is not None:
            self.rows -= session.rows
            self.lost[name] += lost

    def tokens(self) -> set[str]:
        """Return the tokens of all."""
        return {session.token for session in self._sessions.values()}

    def take_all(self) -> list[tuple[str, SessionId, Session]]:
        """Forget all sessions, and return them."""
        taken = [(name, session_id, session) for (name, session_id), session in self._sessions.items()]
        for name, session_id, _ in taken:
            self.end(name, session_id)
        return taken

    def _full(self, rows: int) -> UnavailableError:
        what = "another episode" if rows == 1 else f"{rows} more episodes (a batch is so many)"
        return UnavailableError(
            f"the server remembers {self.rows} episodes already, at most {self._most}, and has no room for {what}: end "
            f"a session, wait until an idle one is evicted ({self._idle_s:g} s), or send the state along with each "
            "request",
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

    def _sweep_later(self) -> None:
        """Look for idle sessions again when the first of them may be one: nobody may ask for anything by then."""
        if self._sweeper is not None:
            return
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:  # in process, without a server: whoever asks next sweeps
            return
        wait_s = next(iter(self._sessions.values())).used + self._idle_s - time.monotonic()
        self._sweeper = loop.call_later(max(wait_s, min(SWEEP_S, self._idle_s)), self._sweep)

    def _sweep(self) -> None:
        self._sweeper = None
        self._evict()
        if self._sessions:
            self._sweep_later()


def shorten(session_id: SessionId) -> str:
    """Return an id as an error's sentence may show it."""
    return str(session_id)[:64]
