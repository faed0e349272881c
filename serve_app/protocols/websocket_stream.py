"""WebSocket per robot: the openpi policy server's protocol, which its clients speak unchanged.

On connecting the server sends one msgpack map, the metadata; then request and response alternate as binary frames. A
request is `{"obs": ...}` with the JSON protocol's options, or the observation map itself, from element name to value.
`actions` in the reply is a chunk of one action, `(1, ...)`, as openpi's clients expect; a batch of observations gets
one chunk each. An error is a text frame with the JSON protocol's error body, then close 1011; a client that connects
with `?errors=keep` gets the text frame alone, with the request's `seq`, and goes on.

A recurrent policy's memory is the connection's: at its start when the connection opens and after `reset`, gone with the
connection. A client that would rather carry it sends `state`, as over JSON.

Source of the protocol: github.com/Physical-Intelligence/openpi, websocket_policy_server.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

from starlette.routing import WebSocketRoute
from starlette.types import Message, Receive, Scope, Send

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import RequestError, RlservoError, TooLargeError, UnknownPolicyError
from rlservo.export.contract.spaces import DictSpec
from rlservo.serve_app.episodes.sessions import Session
from rlservo.serve_app.protocols import json_messages
from rlservo.serve_app.protocols.http_endpoint import request_id, session_of
from rlservo.serve_app.protocols.http_errors import encode_bug, error_answer
from rlservo.serve_app.server.admission import IdleTimer
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.request_log import FIELDS
from rlservo.serve_app.server.request_metrics import IDLE
from rlservo.serve_app.versions.policy_store import Decision
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack

logger = logging.getLogger(__name__)

STREAM_PATHS = ("/", "/v1/policies/{name}/stream", "/v1/policies/{name}/versions/{version}/stream")
GOING_AWAY = 1001
FAILED = 1011  # the close code openpi's server uses for every error
KEEP = b"errors=keep"
KNOWN = frozenset({"obs", *json_messages.OPTIONS, *json_messages.OF_EPISODE})
PROTOCOL = "websocket"
NO_OPTIONS: dict[str, Any] = {}
CHECK_KEY = "rlservo.check_key"  # in a stream's scope: what raises when the key that opened it is no longer accepted
DENIAL = "websocket.http.response"  # the ASGI extension that answers an upgrade with an HTTP error


@dataclass(slots=True)
class _Conversation:
    """One connection, and the request that it is at."""

    name: str
    version: str | None
    label: str  # whose requests these are, where a canary runs
    session: Session | None
    request_id: str | None  # of the connection; requests are told apart by `seq`
    _: KW_ONLY
    keep: bool  # whether the connection outlives errors
    check_key: Callable[[], object]  # raises UnauthenticatedError or ForbiddenError
    key_changes: int  # how often the keys had changed when this one was last checked
    received: float | None = None
    seq: Any = None  # as the client gave it


class StreamRoute(WebSocketRoute):
    """A path of streams; its `app` is a bare ASGI callable."""

    access = Access.act


class Stream:
    """Answers WebSocket connections."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._max_bytes = core.settings.max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection until the client closes it."""
        name = ""
        version: str | None = None
        key_changes = self._core.keys.changes  # the key was checked in this very turn of the event loop
        try:
            name, version = self._addressed(scope["path_params"])
            # All requests of a stream get the same version where a canary runs.
            label = session_of(scope) or secrets.token_hex(8)
            policy = self._core.store().choose(name, version, label)
        except RlservoError as error:
            self._failed(name, version, error, request_id(scope))
            await refuse(scope, receive, send, error)
            return
        await receive()  # websocket.connect
        try:
            await send({"type": "websocket.accept"})
        except OSError:  # the client has gone already
            return
        self._core.metrics.stream(name, 1)
        idle = IdleTimer(self._core.settings.stream_idle_s)
        session = Session(policy) if policy.is_stateful else None
        keep = KEEP in scope.get("query_string", b"").split(b"&")
        conversation = _Conversation(
            name,
            version,
            label,
            session,
            request_id(scope),
            keep=keep,
            check_key=scope[CHECK_KEY],
            key_changes=key_changes,
        )
        try:
            with self._core.admission.streaming():
                await send(_binary(pack(_metadata(policy.contract))))
                await self._answer(conversation, receive, send, idle)
        except asyncio.CancelledError:
            if not idle.expired:
                raise
            if sys.version_info >= (3, 11) and (task := asyncio.current_task()) is not None:
                task.uncancel()  # Python counts cancellations
            self._core.failed(PROTOCOL, name, version, IDLE)
            self._core.log.failed(
                PROTOCOL, name, version, "idle", "silent for too long", request_id=conversation.request_id
            )
            await _close_idle(send)
        except RlservoError as error:
            self._failed(name, version, error, conversation.request_id, conversation)
            await _fail(send, error_answer(error)[1])
        except OSError:  # the client went while its reply was being sent: nobody is left to tell
            logger.debug("a stream's client went before its reply could be sent")
        except Exception:
            logger.exception(
                "the stream of policy '%s' failed", name, extra={FIELDS: {"request_id": conversation.request_id}}
            )
            self._core.metrics.failed(PROTOCOL, "", "", "internal")
            await _fail(send, encode_bug())
        finally:
            idle.stop()
            if session is not None:
                self._core.episodes.sessions.release(session)
            self._core.metrics.stream(name, -1)

    def _failed(
        self,
        name: str,
        version: str | None,
        error: RlservoError,
        request_id: str | None,
        conversation: _Conversation | None = None,
    ) -> None:
        """Count and log a request, or a connection, that was refused."""
        self._core.failed(PROTOCOL, name, version, error.code)
        received = None if conversation is None else conversation.received
        self._core.log.failed(
            PROTOCOL,
            name,
            version,
            error.code,
            error.message,
            request_id=request_id,
            seconds=None if received is None else time.perf_counter() - received,
            seq=None if conversation is None else conversation.seq,
        )

    async def _answer(self, asked: _Conversation, receive: Receive, send: Send, idle: IdleTimer) -> None:
        core, log = self._core, self._core.log
        previous_ms: float | None = None
        waited: float | None = None
        while True:
            message = await receive()
            asked.received = received = time.perf_counter()
            asked.seq = None
            idle.touch()
            if message["type"] == "websocket.disconnect":
                return
            if asked.key_changes != core.keys.changes:
                asked.key_changes = core.keys.changes
                asked.check_key()  # ends the stream, also one that outlives errors
            try:
                obs, options = self._read(message, asked)
                asked.seq = options.get("seq")
                core.admission.age.check(waited)
                waited = None
                reply, decision = await self._decide(asked, obs, options, received)
            except RlservoError as error:
                if not asked.keep:
                    raise
                self._failed(asked.name, asked.version, error, asked.request_id, asked)
                await send({"type": "websocket.send", "text": _with_seq(error_answer(error)[1], asked.seq)})
                continue
            if previous_ms is not None:
                reply["server_timing"]["prev_total_ms"] = previous_ms
            await send(_binary(pack(reply)))
            taken, batch = time.perf_counter() - received, decision.batch or 1
            previous_ms = taken * 1e3
            if taken > core.admission.age.limit_s:
                waited = 0.0  # the loop stood still for this answer, and the next request comes after it
            core.metrics.answered(PROTOCOL, decision, batch, taken)
            if log.every:
                log.answered(
                    PROTOCOL,
                    decision.name,
                    decision.version,
                    taken,
                    batch=batch,
                    request_id=asked.request_id,
                    seq=asked.seq,
                )

    async def _decide(
        self, asked: _Conversation, obs: Any, options: Mapping[str, Any], received: float
    ) -> tuple[dict[str, Any], Decision]:
        """Return (reply, decision) for one request."""
        explore, seed, seq, deadline_ms = json_messages.read_options(options) if options else (False, None, None, None)
        timestamp = json_messages.read_timestamp(options) if options else None
        episode = json_messages.read_episode(options) if options else None
        if asked.session is None and episode is not None and episode.reset and episode.session_id is None:
            episode = replace(episode, reset=False)  # nothing is remembered here
        decision = await self._core.act(
            asked.name,
            asked.version,
            obs,
            received=received,
            explore=explore,
            seed=seed,
            seq=seq,
            deadline_ms=deadline_ms,
            episode=episode,
            stream=asked.session,
            session=asked.label,
        )
        reply: dict[str, Any] = {
            "actions": _chunks(decision.action, batch=decision.batch is not None),
            "policy": decision.name,
            "version": decision.version,
            "server_timing": {"infer_ms": decision.infer_ms},
        }
        if seq is not None:
            reply["seq"] = seq
        if decision.notices:
            reply["warnings"] = decision.notices
        if decision.episode is not None:
            reply.update(json_messages.describe_episode(decision.episode))
            if decision.episode.state is not None:
                reply["state"] = decision.episode.state
        if timestamp is not None:
            reply.update(json_messages.clock(timestamp, received))
        return reply, decision

    def _addressed(self, params: Mapping[str, str]) -> tuple[str, str | None]:
        """Return (policy, version) that a path's parameters name; without any it is the default policy."""
        if "name" in params:
            return params["name"], params.get("version")
        names = self._core.store().names
        default = self._core.settings.default_policy or (names[0] if len(names) == 1 else None)
        if default is None:
            raise UnknownPolicyError(
                f"this server has no default policy, but {', '.join(names)}: connect to /v1/policies/NAME/stream, or "
                "serve with --default-policy (RLSERVO_DEFAULT_POLICY)",
                {"policies": list(names)},
            )
        return default, None

    def _read(self, message: Message, asked: _Conversation) -> tuple[Any, Mapping[str, Any]]:
        """Return (observation, options) of one frame."""
        content = message.get("bytes")
        if content is None:
            raise RequestError("the message is a text frame: send msgpack in a binary one")
        if len(content) > self._max_bytes:
            raise TooLargeError(f"the message is larger than {self._max_bytes} bytes", {"max_bytes": self._max_bytes})
        document = unpack(content)
        if type(document) is not dict:
            raise RequestError(f"the message must be a map such as {{'obs': ...}}, got {type(document).__name__}")
        if "obs" not in document:  # element names and values
            if type(document.get("reset")) is bool and not self._names(asked, "reset"):
                named = {name: value for name, value in document.items() if name != "reset"}
                return named, {"reset": document["reset"]}
            return document, NO_OPTIONS
        if len(document) == 1:
            return document["obs"], NO_OPTIONS
        unknown = sorted(str(key)[:64] for key in document.keys() - KNOWN)
        if unknown:
            raise RequestError(f"unknown field '{unknown[0]}': known are {', '.join(sorted(KNOWN))}")
        return document["obs"], document

    def _names(self, asked: _Conversation, name: str) -> bool:
        """Whether an observation of this stream's policy has a part or an element of that name."""
        session = asked.session
        policy = self._core.store().get(asked.name, asked.version) if session is None else session.policy
        space = policy.contract.observation_space
        return name in (space.spaces if isinstance(space, DictSpec) else {element.name for element in space.elements})


def _metadata(contract: Contract) -> dict[str, Any]:
    """What a client learns on connecting: who decides, and the whole contract."""
    return {
        "server": "rlservo",
        "policy": contract.name,
        "version": contract.version,
        "control_rate_hz": contract.control_rate_hz,
        "contract": contract.model_dump(mode="json"),
    }


def _chunks(action: Any, *, batch: bool) -> Any:
    """Return the action as chunks of one; each leaf of a nested one is a chunk."""
    if isinstance(action, dict):
        return {key: _chunks(part, batch=batch) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_chunks(part, batch=batch) for part in action]
    return action[:, None, ...] if batch else action[None, ...]


def _with_seq(content: bytes, seq: Any) -> str:
    """Return an error's body with the number of the request that it answers."""
    if type(seq) is not int:
        return content.decode()
    return json_messages.encode_json({**json.loads(content), "seq": seq}).decode()


async def refuse(scope: Scope, receive: Receive, send: Send, error: RlservoError) -> None:
    """Answer a request with an error before anybody reads it.

    A WebSocket's upgrade gets the same HTTP error; where the server cannot send one, it is accepted and fails in the
    protocol's own way.
    """
    status, content, headers = error_answer(error)
    if scope["type"] == "http":
        headers += ((b"content-length", b"%d" % len(content)),)
        await send({"type": "http.response.start", "status": status, "headers": list(headers)})
        await send({"type": "http.response.body", "body": content})
        return
    await receive()  # websocket.connect
    if DENIAL in scope.get("extensions", {}):
        headers += ((b"content-length", b"%d" % len(content)),)
        await send({"type": f"{DENIAL}.start", "status": status, "headers": list(headers)})
        await send({"type": f"{DENIAL}.body", "body": content})
        return
    await send({"type": "websocket.accept"})
    await _fail(send, content)


async def _fail(send: Send, content: bytes) -> None:
    try:
        await send({"type": "websocket.send", "text": content.decode()})
        await send({"type": "websocket.close", "code": FAILED, "reason": "see the text frame"})
    except (OSError, RuntimeError):  # the client has gone meanwhile: nobody is left to tell
        logger.debug("a stream's client went before its error could be sent")


async def _close_idle(send: Send) -> None:
    with contextlib.suppress(OSError, RuntimeError):  # the client may have gone meanwhile
        await send({"type": "websocket.close", "code": GOING_AWAY, "reason": "silent for too long"})


def _binary(content: bytes) -> Message:
    return {"type": "websocket.send", "bytes": content}
