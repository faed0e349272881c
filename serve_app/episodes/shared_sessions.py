"""Sessions by id where several replicas serve: each memory is in one replica, and a record that all share says where.

Why no step is ever computed from an old memory. An episode has a *token* that no other has. Its memory is kept under
the token, by one replica at a time. The store that all replicas share has a record for each id, which leads to an
episode of it, and for each episode that another one followed a *link*, under its token, to that one. A link is created
and never overwritten, so of two requests that would begin after the same episode one does, however late the other's
write arrives, and the episodes of an id are one chain. `reset` is answered only after its link stands; a step follows
the links, the last of which its owner looks for after the step has arrived, and is computed with the memory of the
chain's last episode or not at all. So once a `reset` was answered, no later step finds the episode before, wherever its
memory may still be, and whoever cannot reach the store computes nothing. Nothing depends on clocks, or on who is
believed to be alive, except how long what leads nowhere is kept: longer than any write can be under way.

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
AFTER = "after-"  # before an episode's token: the key of the link to the one begun after it
STAMP_HEADER = STAMP.encode()
HOP_TIMEOUT_S = 4.0  # [s] less than HAProxy gives an action
BEGIN_S = 4.0  # [s] likewise, after which no episode is begun any more


class Record(NamedTuple):
    """Where the memory of an episode is."""

    replica: str
    token: str
    identity: str
    """Of the policy that it is of."""
    key: str
    """Of its id's record."""

    @property
    def is_closed(self) -> bool:
        """Whether it is a link to nothing: no episode can follow, and its id's record leads nowhere any more."""
        return not self.token


class RecordStore(Protocol):
    """Records that all replicas share. A read sees the last write that was acknowledged before it began."""

    async def get(self, key: str) -> bytes | None: ...
    async def put(self, key: str, value: bytes) -> None: ...
    async def create(self, key: str, value: bytes) -> bool: ...  # False where there is one
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
        self._unneeded: set[str] = set()  # records and links that nobody needed when they were last looked at
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
        if request.episode.reset:
            return await self._begin(store, request, key)
        record = await self._find(key)
        if record is None:
            raise self._lost(request)
        return await self._step(store, request, record)

    async def _begin(self, store: PolicyStore, request: Request, key: str) -> Decision:
        """Begin an episode here, and say so to all before anybody is answered."""
        assert request.episode is not None and request.episode.session_id is not None
        name, session_id, sessions = request.policy, request.episode.session_id, self._episodes.sessions
        chain = await self._chain(key)
        if chain and chain[-1].is_closed:
            await self._delete(key)
            chain = []
        before = chain[-1] if chain else None
        _check_time(request)
        decision = self._episodes.act(store, request)
        session = sessions.peek(name, session_id)  # None: there is nothing to remember
        record = Record(self._replica, secrets.token_hex(12), decision.policy.identity, key)
        try:
            is_first = await self._create(key if before is None else AFTER + before.token, record)
            _check_time(request)
            if not is_first:
                raise UnavailableError(
                    f"another request began session '{shorten(session_id)}' of policy '{name[:64]}' at the same time: "
                    "try again"
                )
        except RlservoError:
            if session is not None and sessions.peek(name, session_id) is session:
                sessions.end(name, session_id)
            raise
        if session is not None:
            session.token, session.begun = record.token, time.perf_counter()  # from now on there are steps
        if before is not None:
            with contextlib.suppress(UnavailableError):  # the link leads here, too
                await self._put(key, record)
            if before.replica != self._replica:
                task = asyncio.create_task(self._tell_forget(before, name, session_id))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        return decision

    async def _step(self, store: PolicyStore, request: Request, record: Record) -> Decision:
        """Take a step where the memory is: in the replica that began it, or the one that took it over."""
        while True:
            if record.replica == self._replica:
                found = await self.act_here(store, request, record.token)
            else:
                found = await self._ask(store, request, record)
            if found is not None:
                return found
            after = await self._find(MOVED + record.token)
            if after is None or after.replica == record.replica:
                after = await self._find(AFTER + record.token)
            if after is None or after.is_closed:
                raise self._lost(request)
            record = after

    async def act_here(self, store: PolicyStore, request: Request, token: str) -> Decision | None:
        """Take a step with a memory of this replica; None where it has none under this token, or another one follows.

        Raises UnavailableError where the store does not say whether one does.
        """
        if self._leaving is not None:
            await self._leaving.wait()
        assert request.episode is not None and request.episode.session_id is not None
        session = self._memory(request, token)
        if session is None or await self._find(AFTER + token) is not None:
            return None
        if self._memory(request, token) is not session:  # it went while the store was asked
            return None
        is_stamped = request.stream_id is None and request.seq is None  # otherwise `seq` says which request it is
        stamp = request.headers.get(STAMP_HEADER) if is_stamped else None
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

    def _memory(self, request: Request, token: str) -> Session | None:
        assert request.episode is not None and request.episode.session_id is not None
        session = self._episodes.sessions.peek(request.policy, request.episode.session_id)
        return session if session is not None and session.token == token else None

    async def _ask(self, store: PolicyStore, request: Request, record: Record) -> Decision | None:
        """Let the owner take the step; None where it has no such memory. Raises what it raises."""
        policy = store.find(request.policy, record.identity)
        if policy is None:  # its action could not be written down
            raise self._lost(request)
        headers = {STAMP_HEADER: stamp} if (stamp := request.headers.get(STAMP_HEADER)) is not None else {}
        now = time.perf_counter()
        sent = replace(request, headers=headers, reply_options=None, stream=None, connection=None, has_hung_up=None)
        if request.deadline_ms is not None:  # from when the owner has it
            sent.deadline_ms = request.deadline_ms - (now - request.received) * 1e3
        self.hops += 1
        try:
            call = self._peers.call(record.replica, "act", sent, record.token, now - request.arrived)
            found = await asyncio.wait_for(call, HOP_TIMEOUT_S)
        except Exception as error:
            if isinstance(error, ProcessLookupError) and (headers or request.seq is not None):
                return None  # if it took the step and handed the episode over, the next owner knows this request
            logger.debug("the replica %s did not answer for a session: %s", record.replica, error)
            if request.seq is not None:
                raise UnavailableError("the replica that has this session does not answer: try again") from None
            with contextlib.suppress(UnavailableError):  # the step may have been taken: nobody can go on from here
                await self._create(AFTER + record.token, closed(record.key))
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
            records = [
                Record(other, one.session.token, one.identity, key_of(one.name, one.session_id))
                for one in part
                if one.session.token in adopted
            ]
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
        """Delete records and links that nobody needs: of what ended here, and of replicas that have ended.

        They go when two looks in a row found so. Between these lies longer than a write may be under way, so that none
        arrives late for what was deleted.
        """
        running = await self._peers.running()
        unneeded = {key for key in await self._records.keys() if await self._is_unneeded(key, running)}
        for key in unneeded & self._unneeded:
            if not key.startswith((MOVED, AFTER)):
                record = await self._find(key)
                if record is None or not await self._create(AFTER + record.token, closed(key)):
                    continue  # it is deleted already, or an episode was begun just now
            await self._delete(key)
        self._unneeded = unneeded

    async def _is_unneeded(self, key: str, running: Sequence[str]) -> bool:
        record = await self._find(key)
        if record is None or (record.replica != self._replica and record.replica in running):
            return False  # the other replica's own
        has_memory = record.replica == self._replica and record.token in self._episodes.sessions.tokens()
        if key.startswith(MOVED) or (has_memory and not key.startswith(AFTER)):
            return not has_memory
        chain = await self._chain(record.key)
        if key.startswith(AFTER):
            is_passed = all(key != AFTER + each.token for each in chain)
        else:
            is_passed = len(chain) == 1 and await self._find(MOVED + record.token) is None
        if not is_passed and len(chain) > 1:
            await self._shorten(record.key, chain)
        return is_passed

    async def _chain(self, key: str) -> list[Record]:
        """Return the episodes to which an id's record leads, in the order in which they began."""
        chain, record = [], await self._find(key)
        while record is not None:
            chain.append(record)
            record = None if record.is_closed else await self._find(AFTER + record.token)
        return chain

    async def _shorten(self, key: str, chain: Sequence[Record]) -> None:
        """Let an id's record lead to its last episode at once."""
        if chain[-1].is_closed:
            await self._delete(key)
        else:
            await self._put(key, chain[-1])

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

    async def _create(self, key: str, record: Record) -> bool:
        """Write a record that is not there; return whether this one is."""
        try:
            is_written = await self._records.create(key, json.dumps(record).encode())
        except Exception as error:
            raise self._count_unreachable(error) from None
        return is_written or await self._find(key) == record  # written, and then tried again by Ray

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


def _check_time(request: Request) -> None:
    """Raise DeadlineError or UnavailableError for a `reset` whose client has given up: it may have sent the next."""
    check_deadline(request)
    if time.perf_counter() - request.received > BEGIN_S:
        raise UnavailableError(f"beginning the session took longer than {BEGIN_S:g} s: try again")


def closed(key: str) -> Record:
    """Return the link that ends the episodes to which an id's record leads."""
    return Record("", "", "", key)


def without_policy(decision: Decision) -> Decision:
    """Return a decision as it goes to another replica, which has the policy itself."""
    return replace(decision, policy=None, inputs={})  # type: ignore[arg-type]  # whoever gets it puts its own there


def _bare(session: Session) -> Session:
    """Return a session as it goes to another replica."""
    answer, stamped = (each and without_policy(each) for each in (session.answer, session.stamped))
    return replace(session, policy=None, answer=answer, stamped=stamped, begun=0.0)  # type: ignore[arg-type]  # likewise


def key_of(name: str, session_id: SessionId) -> str:
    """Return the key of an id's record: of one length, whatever the id is."""
    return hashlib.blake2b(json.dumps([name, session_id]).encode(), digest_size=16).hexdigest()
