"""WebSocket per robot: the openpi policy server's protocol, compatible with its unchanged clients.

On connecting the server sends one msgpack map, the metadata; then request and response alternate as binary frames. A
request is `{"obs": ...}` with the JSON protocol's options, or the observation map itself, from element name to value.
Further fields of openpi's clients (`prompt`) are ignored, unless an element has that name. `actions` in the reply is a
chunk of one action, `(1, ...)`, as openpi's clients expect; a batch of observations gets one chunk each.

An error is a text frame with the JSON protocol's error body, then close 1011; a client that connects with
`?errors=keep` gets only the text frame, with the request's `seq`, and continues.

The recurrent state belongs to the connection: it starts when the connection opens and after `reset`, and is lost with
the connection. A client that prefers to carry it sends `state`, as over JSON.

Source of the protocol: github.com/Physical-Intelligence/openpi, websocket_policy_server.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Mapping
from typing import Any

from starlette.types import Message, Send

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import DictSpec
from rlservo.client.formats.msgpack_arrays import pack, unpack
from rlservo.errors import (
    InternalError,
    RequestError,
    RlservoError,
    TooLargeError,
    UnauthenticatedError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app.protocols.error_statuses import describe, error_answer, send_reply
from rlservo.serve_app.protocols.request_fields import ACT, encode_json, fill_request, parse_fields
from rlservo.serve_app.protocols.routing import WEBSOCKET, Call, Route
from rlservo.serve_app.server.access_checks import StreamKey, presented_key
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL, check_length
from rlservo.serve_app.server.metrics import IDLE
from rlservo.serve_app.server.request_handler import BUG, RequestHandler
from rlservo.serve_app.sessions.request import Request, new_episode_id, reply_fields
from rlservo.serve_app.sessions.session import Session
from rlservo.serve_app.versions.policy_store import Decision

logger = logging.getLogger(__name__)

STREAM_PATHS = ("/", "/v1/policies/{name}/stream", "/v1/policies/{name}/versions/{version}/stream")
DENIAL = "websocket.http.response"  # the ASGI extension that answers an upgrade with an HTTP error
FAILED = 1011  # the close code openpi's server uses for every error
GOING_AWAY = 1001
KEEP = b"errors=keep"
PROTOCOL = "websocket"
SILENT = "silent for too long"
IGNORED = frozenset({"prompt", "env_id"})
"""Fields that openpi's clients send for other policies (task, robot); ignored here."""


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of streams."""

    async def serve(call: Call) -> None:
        opening = call.request(PROTOCOL)
        try:
            opening.policy, opening.version = _address(handler, call.params)
            opening.stream_id = new_episode_id(opening.label)
            opening.label = opening.label or opening.stream_id  # during a canary they all get the same version
            policy = handler.store().choose(opening.policy, opening.version, opening.label)
        except RlservoError as error:
            handler.record_failure(opening, error)
            raise
        await call.receive()  # websocket.connect
        try:
            await call.send({"type": "websocket.accept", "headers": call.reply_headers})
            with handler.open_stream(opening):
                opening.stream = Session(policy) if policy.is_stateful else None
                await _Stream(handler, opening, call).run(policy.contract)
        except RlservoError as error:
            await fail_stream(call.send, error)
        except OSError:  # the client disconnected while something was being sent
            logger.debug("a stream's client disconnected before its reply could be sent")
        except Exception:
            handler.record_bug(opening)
            await fail_stream(call.send, InternalError(BUG))

    return [Route(WEBSOCKET, path, Access.act, "Stream of actions", serve, reads_body=True) for path in STREAM_PATHS]


def _address(handler: RequestHandler, params: Mapping[str, str]) -> tuple[str, str | None]:
    """Return the (policy, version) in a path's parameters; without any, the default policy."""
    if "name" in params:
        return params["name"], params.get("version")
    names = handler.store().names
    default = handler.settings.default_policy or (names[0] if len(names) == 1 else None)
    if default is None:
        raise UnknownPolicyError(
            f"this server has no default policy among {', '.join(names)}: connect to /v1/policies/NAME/stream, or "
            "serve with --default-policy (RLSERVO_DEFAULT_POLICY)",
            {"policies": list(names)},
        )
    return default, None


class _Stream:
    """Answers the messages of one connection in sequence, and closes it if there are none."""

    def __init__(self, handler: RequestHandler, opening: Request, call: Call) -> None:
        self._handler, self._opening, self._call = handler, opening, call
        self._keeps = KEEP in call.scope.get("query_string", b"").split(b"&")  # whether it continues after an error
        self._key = StreamKey(handler.keys, presented_key(opening.headers))
        self._timings: dict[str, float] | None = None
        self._is_fresh = False
        self._last = time.perf_counter()
        self._is_silent = False

    async def run(self, contract: Contract) -> None:
        """Answer until the client disconnects. Raises RlservoError, which has been recorded, and OSError."""
        call, silence = self._call, asyncio.create_task(self._close_when_silent())
        try:
            await call.send({"type": "websocket.send", "bytes": encode_metadata(contract)})
            while (message := await call.receive())["type"] != "websocket.disconnect" and not self._is_silent:
                await call.send(await self._answer(message))
        finally:
            silence.cancel()
            if self._opening.stream is not None:
                self._handler.episodes.sessions.reserve(self._opening.stream, 0)

    async def _close_when_silent(self) -> None:
        """Close after a silence: this wakes once in each such period, not for each message."""
        while (left_s := self._last + self._handler.settings.stream_idle_s - time.perf_counter()) > 0:
            await asyncio.sleep(left_s)
        self._is_silent = True
        self._handler.record_failure(self._opening, UnavailableError(SILENT), IDLE)
        with contextlib.suppress(OSError, RuntimeError):  # the client may have disconnected
            await self._call.send({"type": "websocket.close", "code": GOING_AWAY, "reason": SILENT})

    async def _answer(self, message: Message) -> Message:
        """Return the reply. Raises RlservoError, which has been recorded, if it ends the stream."""
        handler, opening = self._handler, self._opening
        request = Request(
            PROTOCOL,
            opening.policy,
            opening.version,
            time.perf_counter(),
            label=opening.label,
            request_id=opening.request_id,
            headers=opening.headers,
            is_fresh=self._is_fresh,
            stream=opening.stream,
            stream_id=opening.stream_id,
            reply_options=self._timings,
        )
        self._last = request.received
        self._is_fresh = False
        try:
            reply = await handler.answer(CODEC, request, message, self._key)
        except RlservoError as error:
            if not self._keeps or isinstance(error, UnauthenticatedError):
                raise
            document = describe(error)[1]
            if request.seq is not None:
                document["seq"] = request.seq
            return {"type": "websocket.send", "text": encode_json(document).decode()}
        taken_s = time.perf_counter() - request.received
        self._timings = {"prev_total_ms": taken_s * 1e3}
        if taken_s > handler.admission.max_wait_s:
            self._is_fresh = True  # this reply blocked the loop, and the next request comes after it
        return {"type": "websocket.send", "bytes": reply}


async def refuse_upgrade(call: Call, error: Exception) -> None:
    """Answer an upgrade with an HTTP error; if the server cannot send one, accept it and send the error as a frame."""
    await call.receive()  # websocket.connect
    if DENIAL not in call.scope.get("extensions", {}):
        await call.send({"type": "websocket.accept"})
        await fail_stream(call.send, error)
        return
    status, content, own = error_answer(error)
    await send_reply(call.send, status, content, own + call.reply_headers, kind=DENIAL)


async def fail_stream(send: Send, error: Exception) -> None:
    """End an open WebSocket with an error's body."""
    with contextlib.suppress(OSError, RuntimeError):  # the client may have disconnected
        await send({"type": "websocket.send", "text": error_answer(error)[1].decode()})
        await send({"type": "websocket.close", "code": FAILED, "reason": "see the text frame"})


class MsgpackCodec:
    """MessagePack of a stream (`Codec`): frame to `Request`, decision to a frame."""

    async def receive(self, handler: RequestHandler, request: Request, source: Message) -> Mapping[Any, Any]:
        """Return the map in a frame, and note its `seq` for an error's frame. Raises RequestError."""
        content = source.get("bytes")
        if content is None:
            raise RequestError("the message is a text frame: send msgpack in a binary frame")
        limit, most = handler.settings.max_body_bytes, None
        if len(content) > limit:
            raise TooLargeError(f"the message is larger than {limit} bytes", {"max_bytes": limit})
        if len(content) > SMALL:
            bounds = check_length(handler.store(), request.policy, content, handler.settings.max_batch)
            most = max(each.values for each in bounds)
        document = unpack(content, most=most)
        if type(document) is not dict:
            raise RequestError(f"the message must be a map such as {{'obs': ...}}, got {type(document).__name__}")
        if "obs" in document and type(document.get("seq")) is int:
            request.seq = document["seq"]
        return document

    def parse(self, handler: RequestHandler, request: Request, content: Mapping[Any, Any]) -> None:
        """Fill the request. Raises RequestError."""
        if not IGNORED.isdisjoint(content):
            ignored = {name for name in IGNORED if not _names(handler, request, name)}
            content = {key: value for key, value in content.items() if key not in ignored}
        if "obs" not in content:  # element names and values
            request.obs = content
            if type(content.get("reset")) is bool and not _names(handler, request, "reset"):
                request.obs = {name: value for name, value in content.items() if name != "reset"}
                request.reset = content["reset"]
        else:
            fill_request(request, parse_fields(ACT, content))

    def encode(self, request: Request, decision: Decision) -> bytes:
        """Return the reply's frame; `reply_options` are further timings."""
        fields = reply_fields(request, decision)
        fields["actions"] = _chunks(decision.action, batch=decision.batch is not None)
        fields["server_timing"] = {"infer_ms": fields.pop("infer_ms"), **(request.reply_options or {})}
        return pack(fields)


CODEC = MsgpackCodec()


def _names(handler: RequestHandler, request: Request, name: str) -> bool:
    """Return whether an observation of the request's policy has a part or an element of that name."""
    stream = request.stream
    policy = handler.store().get(request.policy, request.version) if stream is None else stream.policy
    space = policy.contract.observation_space
    if isinstance(space, DictSpec):
        return name in space.spaces or name in space.ignored
    return any(name == element.name for element in space.elements)


def encode_metadata(contract: Contract) -> bytes:
    """Return the frame that a client gets on connecting: the policy's name and version, and the whole contract."""
    return pack(
        {
            "server": "rlservo",
            "policy": contract.name,
            "version": contract.version,
            "control_rate_hz": contract.control_rate_hz,
            "action_horizon": 1,  # steps in a chunk, as in a reply's `actions`
            "contract": contract.model_dump(mode="json"),
        }
    )


def _chunks(action: Any, *, batch: bool) -> Any:
    """Return the action as chunks of one; each leaf of a nested one is a chunk."""
    if isinstance(action, dict):
        return {key: _chunks(part, batch=batch) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_chunks(part, batch=batch) for part in action]
    return action[:, None, ...] if batch else action[None, ...]
