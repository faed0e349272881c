"""ASGI application of the server: JSON, Open Inference Protocol, WebSocket and health over one `RequestHandler`.

Everything runs in the event loop: a decision takes microseconds, a hop to a thread takes more.
"""

from __future__ import annotations

import itertools
import secrets
from dataclasses import dataclass

from prometheus_client import CONTENT_TYPE_LATEST
from starlette.types import Receive, Scope, Send

from rlservo.errors import (
    ForbiddenError,
    InternalError,
    RateLimitError,
    RequestError,
    RlservoError,
    UnknownPolicyError,
)
from rlservo.serve_app.protocols import act_json, admin_routes, pages, websocket_stream
from rlservo.serve_app.protocols.error_statuses import Headers, error_answer, missing_route, send_reply
from rlservo.serve_app.protocols.http_endpoint import receive_body
from rlservo.serve_app.protocols.open_inference import infer, model_info
from rlservo.serve_app.protocols.routing import GET, WEBSOCKET, Call, Found, Route, RoutingTable
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
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.sampled_metrics import exposition
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.sessions.request import TRACEPARENT, ClientGoneError, trace_id
from rlservo.serve_app.versions.plan_follower import PlanFollower

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
        *act_json.routes(handler),
        *websocket_stream.routes(handler),
        *_health(handler),
        *admin_routes.routes(handler),
        *infer.routes(handler),
        *model_info.routes(handler),
        *pages.routes(lambda: table),
    ]
    table = RoutingTable(routes)
    return PolicyApp(handler, table, checks, is_behind_serve)


def _health(handler: RequestHandler) -> list[Route]:
    async def healthz(_call: Call) -> tuple[bytes, Headers]:
        return b"OK", ((b"content-type", b"text/plain; charset=utf-8"),)

    async def metrics(_call: Call) -> tuple[bytes, Headers]:
        return await exposition(handler), ((b"content-type", CONTENT_TYPE_LATEST.encode()),)

    return [
        Route(GET, "/healthz", Access.open, "The process is alive", healthz),
        Route(GET, "/metrics", Access.act, "Metrics for Prometheus", metrics),
    ]


@dataclass(frozen=True)
class PolicyApp:
    """The ASGI application: finds each connection's route, and checks the client before it reads the body."""

    handler: RequestHandler
    table: RoutingTable
    checks: OriginChecks
    is_behind_serve: bool
    """Ray Serve adds the request id to replies, and its connections treat trailers as headers."""

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
        own: Headers = () if self.is_behind_serve else ((REQUEST_ID, request_id),)
        if trace_id(headers) is not None:
            own = (*own, (TRACEPARENT, headers[TRACEPARENT]))
        call = Call(scope, receive, send, found.params, headers, own, audit)
        try:
            await self._admit(found, call)
            if found.route is None:
                status, audit.code, content, own = missing_route(method, path, found.allowed)
            elif (reply := await found.route.answer(call)) is None:  # the end of a WebSocket
                return
            else:
                status, (content, own) = 200, reply
        except ClientGoneError:
            return
        except Exception as error:
            audit.code = error.code if isinstance(error, RlservoError) else InternalError.code
            if method == WEBSOCKET:
                await websocket_stream.refuse_upgrade(call, error)
                return
            status, content, own = error_answer(error)
        finally:
            if found.access is Access.admin:
                audit.write()
        await send_reply(send, status, content, own + call.reply_headers)

    async def _admit(self, found: Found, call: Call) -> None:
        """Check the client, and read its body unless the route does.

        Raises RlservoError, which has been counted, if it may not or cannot ask, and ClientGoneError.
        """
        scope, route, audit, path = call.scope, found.route, call.audit, call.audit.path
        try:
            check_path(scope, path)
            self.checks.check(scope, call.headers)
            key = authorize(self.handler.keys, presented_key(call.headers), found.access)
            if key is not None:
                audit.key = key.label
            call.may_explore = key is None or key.may_explore
            if self.is_behind_serve and b"transfer-encoding" in call.headers:
                raise RequestError("a chunked body is not accepted behind Ray Serve: send Content-Length")
            if route is None and audit.method == WEBSOCKET:
                raise UnknownPolicyError(f"there is no stream at {path[:200]}: connect to /v1/policies/NAME/stream")
            if route is not None and not route.reads_body:
                call.body = bytes(await receive_body(self.handler, call.headers, call.receive))
        except RlservoError as error:
            if isinstance(error, ForbiddenError | RateLimitError):
                audit.key = audit.key or error.key
            request = call.request(scope["type"])
            request.peer = audit.peer
            self.handler.record_failure(request, error)
            raise


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
