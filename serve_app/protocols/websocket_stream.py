"""WebSocket per robot: the openpi policy server's protocol, compatible with its unchanged clients.

On connecting the server sends one msgpack map, the metadata; then request and response alternate as binary frames
(`msgpack_codec.py`). An error is a text frame with the JSON protocol's error body, then close 1011; a client that
connects with `?errors=keep` gets only the text frame, with the request's `seq`, and continues.

The recurrent state belongs to the connection: it starts when the connection opens and after `reset`, and is lost with
the connection. A client that prefers to carry it sends `state`, as over JSON.

Source of the protocol: github.com/Physical-Intelligence/openpi, websocket_policy_server.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Mapping

from rlservo.export.contract.errors import (
    InternalError,
    OverloadedError,
    RlservoError,
    UnauthenticatedError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app.episodes.request import Request, new_episode_id
from rlservo.serve_app.episodes.session import Session
from rlservo.serve_app.protocols.http_errors import error_answer, fail_stream, refuse_upgrade
from rlservo.serve_app.protocols.json_text import encode_json
from rlservo.serve_app.protocols.msgpack_codec import MsgpackCodec, encode_metadata
from rlservo.serve_app.protocols.routes import WEBSOCKET, Route
from rlservo.serve_app.server.access_checks import (
    HEADERS,
    LABEL,
    REPLY_HEADERS,
    REQUEST_ID,
    StreamKey,
    header_text,
    presented_key,
)
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.metrics import IDLE
from rlservo.serve_app.server.request_handler import BUG, RequestHandler
from rlservo.serve_app.wire.asgi import Message, Receive, Scope, Send

logger = logging.getLogger(__name__)

STREAM_PATHS = ("/", "/v1/policies/{name}/stream", "/v1/policies/{name}/versions/{version}/stream")
GOING_AWAY = 1001
KEEP = b"errors=keep"
PROTOCOL = "websocket"
SILENT = "silent for too long"


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of streams."""
    stream = StreamEndpoint(handler)
    return [Route(WEBSOCKET, path, Access.act, "Stream of actions", app=stream) for path in STREAM_PATHS]


class StreamEndpoint:
    """Answers WebSocket connections."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler
        self._codec = MsgpackCodec(handler)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection until the client closes it."""
        handler, headers = self._handler, scope[HEADERS]
        opening = Request(
            PROTOCOL,
            "",
            None,
            time.perf_counter(),
            label=header_text(headers, LABEL),
            request_id=header_text(headers, REQUEST_ID),
        )
        try:
            opening.policy, opening.version = self._address(scope["path_params"])
            opening.stream_id = new_episode_id(opening.label)
            opening.label = opening.label or opening.stream_id  # during a canary they all get the same version
            policy = handler.store().choose(opening.policy, opening.version, opening.label)
        except RlservoError as error:
            handler.record_failure(opening, error)
            await refuse_upgrade(scope, receive, send, error)
            return
        await receive()  # websocket.connect
        try:
            await send({"type": "websocket.accept", "headers": scope.get(REPLY_HEADERS, ())})
        except OSError:  # the client has already disconnected
            return
        try:
            handler.open_stream(opening)
        except OverloadedError as error:
            await fail_stream(send, error_answer(error)[1])
            return
        opening.stream = Session(policy) if policy.is_stateful else None
        conversation = _Conversation(handler, self._codec, opening, scope, send)
        try:
            await send(_binary(encode_metadata(policy.contract)))
            while (message := await receive())["type"] != "websocket.disconnect" and not conversation.is_idle:
                await send(await conversation.answer(message))
        except RlservoError as error:
            await fail_stream(send, error_answer(error)[1])
        except OSError:  # the client disconnected while its reply was being sent
            logger.debug("a stream's client disconnected before its reply could be sent")
        except Exception:
            handler.record_bug(opening)
            await fail_stream(send, error_answer(InternalError(BUG))[1])
        finally:
            conversation.timer.cancel()
            if opening.stream is not None:
                handler.episodes.sessions.reserve(opening.stream, 0)
            handler.close_stream(opening)

    def _address(self, params: Mapping[str, str]) -> tuple[str, str | None]:
        """Return the (policy, version) in a path's parameters; without any, the default policy."""
        if "name" in params:
            return params["name"], params.get("version")
        names = self._handler.store().names
        default = self._handler.settings.default_policy or (names[0] if len(names) == 1 else None)
        if default is None:
            raise UnknownPolicyError(
                f"this server has no default policy among {', '.join(names)}: connect to /v1/policies/NAME/stream, or "
                "serve with --default-policy (RLSERVO_DEFAULT_POLICY)",
                {"policies": list(names)},
            )
        return default, None


class _Conversation:
    """Answers the messages of one connection in sequence, and closes it if there are none."""

    def __init__(
        self, handler: RequestHandler, codec: MsgpackCodec, opening: Request, scope: Scope, send: Send
    ) -> None:
        self._handler, self._codec, self._opening, self._send = handler, codec, opening, send
        self._keeps = KEEP in scope.get("query_string", b"").split(b"&")
        self._key = StreamKey(handler.keys, presented_key(scope[HEADERS]))
        self._timings: dict[str, float] | None = None
        self._is_fresh = False
        self._last = time.perf_counter()
        self.is_idle = False
        self.timer = self._check_after(handler.settings.stream_idle_s)

    def _check_after(self, seconds: float) -> asyncio.TimerHandle:
        """Look again after some time: one callback for each period of silence, not one for each message."""
        return asyncio.get_running_loop().call_later(seconds, self._check)

    def _check(self) -> None:
        left_s = self._last + self._handler.settings.stream_idle_s - time.perf_counter()
        if left_s > 0:
            self.timer = self._check_after(left_s)
            return
        self.is_idle = True
        self._handler.record_failure(self._opening, UnavailableError(SILENT), IDLE)
        self._closing = asyncio.create_task(self._close())  # after which the server reports a disconnect

    async def _close(self) -> None:
        with contextlib.suppress(OSError, RuntimeError):  # the client may have disconnected
            await self._send({"type": "websocket.close", "code": GOING_AWAY, "reason": SILENT})

    async def answer(self, message: Message) -> Message:
        """Return the reply. Raises RlservoError, which has been recorded, if it ends the stream."""
        handler, opening = self._handler, self._opening
        request = Request(
            PROTOCOL,
            opening.policy,
            opening.version,
            time.perf_counter(),
            label=opening.label,
            request_id=opening.request_id,
            is_fresh=self._is_fresh,
            stream=opening.stream,
            stream_id=opening.stream_id,
            reply_options=self._timings,
        )
        self._last = request.received
        self._is_fresh = False
        try:
            reply = await handler.answer(self._codec, request, message, self._key)
        except RlservoError as error:
            if not self._keeps or isinstance(error, UnauthenticatedError):
                raise
            return {"type": "websocket.send", "text": _with_seq(error_answer(error)[1], request.seq)}
        taken_s = time.perf_counter() - request.received
        self._timings = {"prev_total_ms": taken_s * 1e3}
        if taken_s > handler.admission.max_wait_s:
            self._is_fresh = True  # this reply blocked the loop, and the next request comes after it
        return _binary(reply)


def _with_seq(content: bytes, seq: int | None) -> str:
    """Return an error's body with its request's number."""
    if seq is None:
        return content.decode()
    return encode_json({**json.loads(content), "seq": seq}).decode()


def _binary(content: bytes) -> Message:
    return {"type": "websocket.send", "bytes": content}
