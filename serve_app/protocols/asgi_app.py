"""ASGI application of the server: JSON, Open Inference Protocol, WebSocket and health over one `RequestHandler`.

Everything runs in the event loop: a decision takes microseconds, a hop to a thread takes more.
"""

from __future__ import annotations

import itertools
import secrets
import time

from prometheus_client import CONTENT_TYPE_LATEST

from rlservo.export.contract.errors import (
    ForbiddenError,
    InternalError,
    RateLimitError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
)
from rlservo.serve_app.episodes.request import ClientGoneError, Request
from rlservo.serve_app.protocols import (
    admin_routes,
    json_codec,
    pages,
    websocket_stream,
)
from rlservo.serve_app.protocols.error_statuses import Headers, error_answer, missing_route, send_reply
from rlservo.serve_app.protocols.http_endpoint import receive_body
from rlservo.serve_app.protocols.open_inference import infer, model_info
from rlservo.serve_app.protocols.routes import GET, WEBSOCKET, Call, Found, Route, RoutingTable
from rlservo.serve_app.server.access_checks import (
    REQUEST_ID,
    OriginChecks,
    authorize,
    check_path,
    fold_headers,
    presented_key,
)
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.logs import AuditEntry
from rlservo.serve_app.server.metrics import exposition
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.wire.asgi import Receive, Scope, Send

PROCESS = secrets.token_hex(8).encode()
numbers = itertools.count(1)


def create_app(
    control: PlanFollower,
    settings: ServerSettings,
    *,
    replica: str = "",
    host: str = "127.0.0.1",
    is_behind_serve: bool = False,
    is_alone: bool = True,
) -> PolicyApp:
    """Return the application; `control` need not have loaded anything yet.

    `replica` is the `RequestHandler`'s; `host` is the address that it listens on; `is_behind_serve` is `PolicyApp`'s;
    `is_alone` says that requests reach only this process. Raises UsageError when the API keys that `settings` name
    cannot be read.
    """
    handler = RequestHandler(control, settings, replica=replica, is_alone=is_alone)
    checks = OriginChecks(host, settings, keyed=bool(handler.keys.accepted.keys))
    routes = [
        *json_codec.routes(handler),
        *websocket_stream.routes(handler),
        *_health(handler),
        *admin_routes.routes(handler),
        *infer.routes(handler),
        *model_info.routes(handler),
        *pages.routes(lambda: table),
    ]
    table = RoutingTable(routes)
    return PolicyApp(handler, checks, table, is_behind_serve=is_behind_serve)


def _health(handler: RequestHandler) -> list[Route]:
    async def healthz(_call: Call) -> tuple[bytes, Headers]:
        return b"OK", ((b"content-type", b"text/plain; charset=utf-8"),)

    async def metrics(_call: Call) -> tuple[bytes, Headers]:
        return await exposition(handler), ((b"content-type", CONTENT_TYPE_LATEST.encode()),)

    return [
        Route(GET, "/healthz", Access.open, "The process is alive", healthz),
        Route(GET, "/metrics", Access.act, "Metrics for Prometheus", metrics),
    ]


class PolicyApp:
    """The ASGI application: finds each connection's route, and checks the client before it reads the body."""

    def __init__(
        self, handler: RequestHandler, checks: OriginChecks, table: RoutingTable, *, is_behind_serve: bool = False
    ) -> None:
        """`is_behind_serve`: Ray Serve adds the request id to replies, and its connections treat trailers as headers"""
        self.handler = handler
        self.table = table
        self._checks = checks
        self._is_behind_serve = is_behind_serve

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one ASGI connection."""
        if scope["type"] == "lifespan":  # the engine loads the policies
            for phase in ("startup", "shutdown"):
                await receive()
                await send({"type": f"lifespan.{phase}.complete"})
            return
        path, headers = route_path(scope), fold_headers(scope["headers"])
        request_id = headers.get(REQUEST_ID)
        if request_id is None:
            request_id = headers[REQUEST_ID] = b"%s-%x" % (PROCESS, next(numbers))
        method = scope["method"] if scope["type"] == "http" else WEBSOCKET
        found = self.table.find(method, path, headers.get(b"accept", b""))
        audit = AuditEntry(method, path, peer_of(scope), request_id.decode("latin-1"))
        own = () if self._is_behind_serve else ((REQUEST_ID, request_id),)
        call = Call(scope, receive, found.params, headers, own, audit)
        try:
            await self._serve(found, call, send)
        except RlservoError as error:
            await self._refuse(call, send, error)
        except ClientGoneError:
            return
        finally:
            if found.access is Access.admin:
                audit.write()

    async def _serve(self, found: Found, call: Call, send: Send) -> None:
        """Check the client, and answer it. Raises RlservoError if it is refused, and ClientGoneError."""
        scope, route, path = call.scope, found.route, call.audit.path
        check_path(scope, path)
        self._checks.check(scope, call.headers)
        key = authorize(self.handler.keys, presented_key(call.headers), found.access)
        if key is not None:
            call.audit.key = key.label
        call.may_explore = key is None or key.may_explore
        if self._is_behind_serve and b"transfer-encoding" in call.headers:
            raise RequestError("a chunked body is not accepted behind Ray Serve: send Content-Length")
        if scope["type"] == "websocket":
            if route is None or route.stream is None:
                raise UnknownPolicyError(f"there is no stream at {path[:200]}: connect to /v1/policies/NAME/stream")
            await route.stream(call, send)
            return
        if route is None or route.answer is None:
            status, call.audit.code, content, own = missing_route(scope["method"], path, found.allowed)
        else:
            if not route.reads_body:
                call.body = bytes(await receive_body(self.handler, call.headers, call.receive))
            try:
                status, (content, own) = 200, await route.answer(call)
            except ClientGoneError:
                raise
            except Exception as error:
                call.audit.code = error.code if isinstance(error, RlservoError) else InternalError.code
                status, content, own = error_answer(error)
        await send_reply(send, status, content, own + call.reply_headers)

    async def _refuse(self, call: Call, send: Send, error: RlservoError) -> None:
        """Answer a client that may not or cannot ask, and count it."""
        audit, kind = call.audit, call.scope["type"]
        audit.code = error.code
        if isinstance(error, ForbiddenError | RateLimitError):
            audit.key = audit.key or error.key
        request = Request(kind, "", None, time.perf_counter(), request_id=audit.request_id, peer=audit.peer)
        self.handler.record_failure(request, error)
        if kind == "websocket":
            await websocket_stream.refuse_upgrade(call, send, error)
        else:
            status, content, own = error_answer(error)
            await send_reply(send, status, content, own + call.reply_headers)


def route_path(scope: Scope) -> str:
    """Return a connection's path below the prefix that the application is mounted at, as Starlette's routes see it."""
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    below = path[len(root) :]
    return below if path.startswith(root) and below[:1] in ("", "/") else path


def peer_of(scope: Scope) -> str | None:
    """Return the client's address; behind trusted proxies uvicorn takes it from `X-Forwarded-For`."""
    client = scope.get("client")
    return None if client is None else str(client[0])
