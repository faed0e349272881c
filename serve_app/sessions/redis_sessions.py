"""Sessions in Redis, shared by several processes: a memory is only replaced by the step computed from it.

A key holds a stamp, new with every write, and the session. A step reads both, computes, and writes if the stamp has not
changed; otherwise another step was written first, and it starts again from that one. So the memories of a session form
one chain, and an answer is sent only after its memory is part of it: even if a process or a write is delayed, no step
is computed from an old memory.

After a restart or failover Redis may have an older copy. A session names the run of Redis (`run_id`) in which it was
written, and is lost in every other.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import os
import time
from typing import Any

from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError

from rlservo.client.formats.msgpack_arrays import pack, unpack
from rlservo.errors import OverloadedError, UnavailableError, UsageError
from rlservo.serve_app.sessions.memory_sessions import StepSession, overtaken
from rlservo.serve_app.sessions.request import Request, check_client, check_deadline
from rlservo.serve_app.sessions.session import Session
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore

logger = logging.getLogger(__name__)

CONNECTIONS = 64  # of one process at most; each carries one command at a time
TIMEOUT_S = 1.0  # for a connection, and for each reply
STAMP_BYTES = 16
READ = "return {redis.call('GET', KEYS[1]), string.match(redis.call('INFO', 'server'), 'run_id:(%x+)')}"
# A command whose reply was lost is sent again: if its write is already stored, it has succeeded.
WRITE = f"""
local now = redis.call('GETRANGE', KEYS[1], 0, {STAMP_BYTES - 1})
if now == ARGV[1] then redis.call('SET', KEYS[1], ARGV[2], 'PX', ARGV[3]) end
return now == ARGV[1] or now == string.sub(ARGV[2], 1, {STAMP_BYTES})
"""

FIELDS = ("state", "last", "steps", "begun", "is_ended", "seq", "inputs_hash", "infer_ms", "batch", "notices")


class RedisSessions:
    """The sessions of all processes that use one Redis database."""

    def __init__(self, url: str, *, idle_s: float, patience_s: float) -> None:
        """Connect when the first session is used. Raises UsageError for an unusable URL.

        Redis forgets a session `idle_s` after its last step. A request that arrived more than `patience_s` ago is not
        computed.
        """
        self._idle_ms = max(1, round(idle_s * 1e3))
        self._patience_s = patience_s
        retry = Retry(NoBackoff(), 1, supported_errors=(RedisConnectionError,))  # an idle connection may be closed
        try:
            self._redis = Redis.from_url(url, socket_timeout=TIMEOUT_S, socket_connect_timeout=TIMEOUT_S, retry=retry)
        except ValueError:  # its message may hold the password
            raise UsageError("the session store's URL is not valid: expected redis://HOST:PORT/DATABASE") from None
        self._read = self._redis.register_script(READ)
        self._write = self._redis.register_script(WRITE)
        self._connections = asyncio.Semaphore(CONNECTIONS)
        self._is_down = False
        self.unreachable = 0
        """Reads and writes that failed."""

    async def act(self, store: PolicyStore, request: Request, step_session: StepSession) -> Decision:
        """Decide for a request of a session, as `MemorySessions.act`. Also raises DeadlineError."""
        named = json.dumps([request.policy, request.session_id]).encode()
        key = "rlservo:session:" + hashlib.blake2b(named, digest_size=16).hexdigest()
        stamp, run, session = await self._load(key, store, request)
        begun = None if session is None else session.begun
        while True:
            decision, after = step_session(store, request, session)
            content = os.urandom(STAMP_BYTES) + _pack(after, run)
            if decision.is_repeat or await self._call(request, self._write, key, stamp, content, self._idle_ms):
                return decision
            stamp, run, session = await self._load(key, store, request)
            if session is not None and session.begun != begun:
                raise overtaken(request)

    async def _load(self, key: str, store: PolicyStore, request: Request) -> tuple[bytes, bytes, Session | None]:
        """Return (stamp, Redis's run, session). Also raises ClientGoneError."""
        record, run = await self._call(request, self._read, key)
        await check_client(request)  # after the read: it lacks later requests, or the client has hung up
        if record is None:
            return b"", run, None
        return record[:STAMP_BYTES], run, _unpack(record[STAMP_BYTES:], store, request.policy, run)

    async def close(self) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def _call(self, request: Request, script: Any, key: str, *arguments: Any) -> Any:
        try:
            async with self._connections:
                check_deadline(request)
                if time.perf_counter() - request.received > self._patience_s:
                    raise OverloadedError(
                        f"the session could not be read and written within {self._patience_s:g} s (Redis is slow, or "
                        "other requests keep the session busy): try again"
                    )
                reply = await script(keys=[key], args=arguments)
        except (RedisError, OSError, RuntimeError) as error:  # the last is uvloop's for a closed connection
            self.unreachable += 1
            if not self._is_down:
                self._is_down = True
                logger.warning("Redis, which keeps the sessions, cannot be used: %s", error)
            raise UnavailableError(
                "this server's session store is unavailable at the moment: try again, or carry the 'state' in "
                "each request"
            ) from None
        if self._is_down:
            self._is_down = False
            logger.warning("Redis, which keeps the sessions, can be used again")
        return reply


def _pack(session: Session, run: bytes) -> bytes:
    fields = {name: getattr(session, name) for name in FIELDS}
    if session.is_ended:
        fields["state"] = None
    return pack({"run": run, "identity": session.policy.identity, **fields})


def _unpack(content: bytes, store: PolicyStore, name: str, run: bytes) -> Session | None:
    """Return a session; None if it was written in another run of Redis, or its policy is not loaded."""
    fields = unpack(content)
    policy = store.find(name, fields.pop("identity"))
    return None if fields.pop("run") != run or policy is None else Session(policy, **fields)
