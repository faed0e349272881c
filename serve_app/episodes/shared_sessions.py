"""Sessions by id where several replicas serve: each memory is in one replica, and a record that all share says where.

Why no step is ever computed from an old memory. An episode has a *token* that no other has. Its memory is kept under
the token, by one replica at a time. The record of an id is one entry in a store that all replicas share, and whose
reads see the last write that was acknowledged. `reset` is answered only after its token stands in the record; a step
reads the record after it has arrived, and is computed with the memory of that token or not at all. So once a `reset`
was answered, no later step finds the episode before, wherever its memory may still be, and whoever cannot reach the
store computes nothing. Nothing depends on clocks, or on who is believed to be alive.

Why no step moves a memory twice. A proxy that saw a replica die sends the request on to another one, with the stamp it
gave it: the memory remembers the last stamps. Where a replica does not hear from the owner whether a step was done, the
episode ends (410), unless its client counts (`seq`): then the client may ask again.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

from rlservo.export.contract.errors import RlservoError, SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.episodes.episodes import Episodes
from rlservo.serve_app.episodes.request import Request, check_deadline
from rlservo.serve_app.episodes.sessions import Session, SessionId, shorten
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore
from rlservo.serve_app.wire.request_stamp import STAMP

logger = logging.getLogger(__name__)

MOVED = "moved-"  # before an episode's token: the key of the record of who took it over
STAMP_HEADER = STAMP.encode()
HOP_TIMEOUT_S = 4.0  # [s] less than HAProxy gives an action


class Record(NamedTuple):
    """Where the memory of an episode is."""

    replica: str
    token: str
    identity: str
    """Of the policy that it is of."""


class RecordStore(Protocol):
    """Records that all replicas share. A read sees the last write that was acknowledged before it began."""

    async def get(self, key: str) -> bytes | None: ...
    async def put(self, key: str, value: bytes) -> None: ...
    async def delete(self, key: str) -> None: ...
    async def keys(self) -> Sequence[str]: ...


class Peers(Protocol):
    """The other replicas."""

    async def call(self, replica: str, method: str, *arguments: Any) -> Any:
        """Call a method of `SharedSessions` there. Raises ProcessLookupError where it has ended."""
        ...

    async def running(self) -> Sequence[str]:
        """Return the replicas that take requests, as far as is known."""
        ...


@dataclass
class HandedOver:
    """What a replica that ends sends to another one of an episode."""

    name: str
    session_id: SessionId
    identity: str
    session: Session


class SharedSessions:
    """Acts for requests with a session's id, here or in the replica that has the memory."""

    def __init__(self, episodes: Episodes, records: RecordStore, peers: Peers, replica: str) -> None:
        self._episodes = episodes
        self._records = records
        self._peers = peers
        self._replica = replica
        self._leaving: asyncio.Event | None = None
        self._tasks: set[asyncio.Task[None]] = set()  # asyncio itself forgets those that nobody waits for
        self._doubtful: set[str] = set()  # records that led nowhere when they were last looked at
        self.hops = 0
        """Steps that another replica was asked to take, since it has the memory."""
        self.unreachable = 0
        """Reads and writes of records that the store did not answer."""
        episodes.is_shared = True

    async def act(self, store: PolicyStore, request: Request) -> Decision:
        """Decide for a request that names a session, as `Episodes.act`; UnavailableError where its record is not known.

        Who is told of a lost session has to begin an episode: nothing else can be answered under its id.
        """
        assert request.episode is not None and request.episode.session_id is not None
        name = request.policy
        if not any(store.get(name, version).is_stateful for version in store.versions(name)):
            return self._episodes.act(store, request)  # the id is a label
        key = key_of(name, request.episode.session_id)
        record = await self._find(key)
        if request.episode.reset:
            return await self._begin(store, request, key, record)
        if record is None:
            raise self._lost(request)
        decision = await self._step(store, request, key, record)
        if request.episode.end:
            with contextlib.suppress(UnavailableError):  # a record of nothing leads nowhere
                await self._delete(key)
        return decision

    async def _begin(self, store: PolicyStore, request: Request, key: str, before: Record | None) -> Decision:
        """Begin an episode here, and say so to all before anybody is answered."""
        assert request.episode is not None and request.episode.session_id is not None
        name, session_id = request.policy, request.episode.session_id
        check_deadline(request)
        decision = self._episodes.act(store, request)
        session = self._episodes.sessions.peek(name, session_id)
        if session is not None and not session.token:
            token = session.token = secrets.token_hex(12)
            record = Record(self._replica, token, session.policy.identity)
            try:
                await self._put(key, record)
            except UnavailableError:
                self.forget(name, session_id, token)
                raise
        else:  # there is nothing to remember of this one; of the one before there may be
            await self._delete(key)
        if before is not None and before.replica != self._replica:
            task = asyncio.create_task(self._tell_forget(before, name, session_id))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        return decision

    async def _step(self, store: PolicyStore, request: Request, key: str, record: Record) -> Decision:
        """Take a step where the memory is: in the replica that began it, or the one that took it over."""
        while True:
            if record.replica == self._replica:
                found = await self.act_here(store, request, record.token)
            else:
                found = await self._ask(store, request, key, record)
            if found is not None:
                return found
            moved = await self._find(MOVED + record.token)
            if moved is None or moved.replica == record.replica:
                raise self._lost(request)
            record = moved

    async def act_here(self, store: PolicyStore, request: Request, token: str) -> Decision | None:
        """Take a step with a memory of this replica; None where it has none under this token (any more)."""
        if self._leaving is not None:
            await self._leaving.wait()
        assert request.episode is not None and request.episode.session_id is not None
        session = self._episodes.sessions.peek(request.policy, request.episode.session_id)
        if session is None or session.token != token:
            return None
        stamp = request.headers.get(STAMP_HEADER) if request.stream_id is None else None
        if stamp is not None and stamp in session.stamps:
            if session.stamps[-1] == stamp and session.stamped is not None:
                return session.stamped
            raise SessionError("this request was answered already, and others after it")
        check_deadline(request)
        decision = self._episodes.act(store, request)
        if stamp is not None:
            session.stamps.append(stamp)
            session.stamped = replace(decision, inputs={}, is_repeat=True)
        return decision

    async def _ask(self, store: PolicyStore, request: Request, key: str, record: Record) -> Decision | None:
        """Let the owner take the step; None where it has no such memory. Raises what it raises."""
        policy = store.find(request.policy, record.identity)
        if policy is None:  # its action could not be written down
            raise self._lost(request)
        headers = {STAMP_HEADER: stamp} if (stamp := request.headers.get(STAMP_HEADER)) is not None else {}
        sent = replace(request, headers=headers, reply_options=None, stream=None)
        if request.deadline_ms is not None:  # from when the owner has it
            sent.deadline_ms = request.deadline_ms - (time.perf_counter() - request.received) * 1e3
        self.hops += 1
        try:
            found = await asyncio.wait_for(self._peers.call(record.replica, "act", sent, record.token), HOP_TIMEOUT_S)
        except Exception as error:
            if isinstance(error, ProcessLookupError) and (headers or request.seq is not None):
                return None  # if it took the step and handed the episode over, the next owner knows this request
            logger.debug("the replica %s did not answer for a session: %s", record.replica, error)
            if request.seq is not None:
                raise UnavailableError("the replica that has this session does not answer: try again") from None
            with contextlib.suppress(UnavailableError):
                await self._delete(key)  # the step may have been taken: nobody can go on from here
            raise self._lost(request) from None
        if isinstance(found, RlservoError):
            raise found
        return None if found is None else replace(found, policy=policy, is_repeat=True)

    def forget(self, name: str, session_id: SessionId, token: str) -> None:
        """Give the place of an episode back that was begun anew elsewhere."""
        session = self._episodes.sessions.peek(name, session_id)
        if session is not None and session.token == token:
            self._episodes.sessions.end(name, session_id)

    async def _tell_forget(self, record: Record, name: str, session_id: SessionId) -> None:
        with contextlib.suppress(Exception):  # it forgets by itself what is idle
            await asyncio.wait_for(self._peers.call(record.replica, "forget", name, session_id, record.token), 60)

    async def hand_over(self) -> None:
        """Give every episode to another replica, since this one ends; steps wait meanwhile."""
        self._leaving = asyncio.Event()
        try:
            running = await asyncio.wait_for(self._peers.running(), HOP_TIMEOUT_S)
            others = [other for other in running if other != self._replica]
            mine = self._episodes.sessions.take_all()
            if not others:
                return
            parts: list[list[HandedOver]] = [[] for _ in others]
            for number, (name, session_id, session) in enumerate(mine):
                if session.token:
                    sent = _bare(session)
                    parts[number % len(others)].append(HandedOver(name, session_id, session.policy.identity, sent))
            await asyncio.gather(*(self._send(*each) for each in zip(others, parts, strict=True) if each[1]))
        except Exception as error:
            logger.warning("the sessions end with this replica: %s", error)
        finally:
            self._leaving.set()

    async def _send(self, other: str, part: list[HandedOver]) -> None:
        try:
            adopted = await asyncio.wait_for(self._peers.call(other, "adopt", part), HOP_TIMEOUT_S)
            records = [Record(other, one.session.token, one.identity) for one in part if one.session.token in adopted]
            await asyncio.gather(*(self._put(MOVED + record.token, record) for record in records))
        except Exception as error:
            logger.warning("%d sessions end with this replica: %s", len(part), error)

    def adopt(self, store: PolicyStore, part: Sequence[HandedOver]) -> list[str]:
        """Take episodes over from a replica that ends; return the tokens of those there was room for."""
        adopted = []
        for each in part:
            policy = store.find(each.name, each.identity)
            begun = self._episodes.sessions.peek(each.name, each.session_id)  # here, under the same id: it is newer
            if policy is None or begun is not None or self._leaving is not None:
                continue
            each.session.policy = policy
            for answer in (each.session.answer, each.session.stamped):
                if answer is not None:
                    answer.policy = policy
            with contextlib.suppress(UnavailableError):
                self._episodes.sessions.put(each.name, each.session_id, each.session, each.session.rows)
                adopted.append(each.session.token)
        return adopted

    async def sweep(self) -> None:
        """Delete records that lead nowhere: of what was forgotten here, and of replicas that have ended."""
        running = await self._peers.running()
        doubtful: set[str] = set()
        for key in await self._records.keys():
            record = await self._find(key)
            if record is None or (record.replica != self._replica and record.replica in running):
                continue  # the other replica's own
            if record.replica == self._replica and record.token in self._episodes.sessions.tokens():
                continue
            if key.startswith(MOVED) or await self._find(MOVED + record.token) is None:
                doubtful.add(key)
        for key in doubtful & self._doubtful:  # twice in a row: not one that is just being begun, or handed over
            await self._delete(key)
        self._doubtful = doubtful

    # The store's errors are of its own kind, and what they mean is always the same.

    async def _find(self, key: str) -> Record | None:
        try:
            content = await self._records.get(key)
        except Exception as error:
            raise self._count_unreachable(error) from None
        return None if content is None else Record(*json.loads(content))

    async def _put(self, key: str, record: Record) -> None:
        try:
            await self._records.put(key, json.dumps(record).encode())
        except Exception as error:
            raise self._count_unreachable(error) from None

    async def _delete(self, key: str) -> None:
        try:
            await self._records.delete(key)
        except Exception as error:
            raise self._count_unreachable(error) from None

    def _count_unreachable(self, error: Exception) -> UnavailableError:
        self.unreachable += 1
        logger.debug("the records of sessions cannot be reached: %s", error)
        return UnavailableError(
            "the cluster's store cannot say at the moment which replica has this session: try again, or "
            "send the 'state' along"
        )

    def _lost(self, request: Request) -> SessionLostError:
        assert request.episode is not None and request.episode.session_id is not None
        self._episodes.sessions.lost[request.policy] += 1
        shown = shorten(request.episode.session_id)
        return SessionLostError(
            f"no replica has the session '{shown}' of policy '{request.policy[:64]}': it was never begun, was ended, "
            "was idle for too long, or ended with its replica or its version: begin an episode",
            {"session_id": shown, "policy": request.policy[:64]},
        )


def without_policy(decision: Decision) -> Decision:
    """Return a decision as it goes to another replica, which has the policy itself."""
    return replace(decision, policy=None, inputs={})  # type: ignore[arg-type]  # whoever gets it puts its own there


def _bare(session: Session) -> Session:
    """Return a session as it goes to another replica."""
    answer, stamped = (each and without_policy(each) for each in (session.answer, session.stamped))
    return replace(session, policy=None, answer=answer, stamped=stamped)  # type: ignore[arg-type]  # likewise


def key_of(name: str, session_id: SessionId) -> str:
    """Return the key of an id's record: of one length, whatever the id is."""
    return hashlib.blake2b(json.dumps([name, session_id]).encode(), digest_size=16).hexdigest()
