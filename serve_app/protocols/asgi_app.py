"""ASGI application of the server: JSON, Open Inference Protocol, WebSocket and health over one `Core`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException
from starlette.routing import BaseRoute, Match
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.export.contract.errors import RequestError, RlservoError, UnknownPolicyError
from rlservo.serve_app.protocols import http_endpoint, http_errors, json_messages, oip_config, oip_models
from rlservo.serve_app.protocols.admin_routes import add_admin
from rlservo.serve_app.protocols.docs_page import add_docs
from rlservo.serve_app.protocols.http_endpoint import BareRoute, Endpoint
from rlservo.serve_app.protocols.json_act import ActHandler, add_policy_routes, check_headers, json_reply
from rlservo.serve_app.protocols.websocket_stream import CHECK_KEY, STREAM_PATHS, Stream, StreamRoute, refuse
from rlservo.serve_app.server.api_keys import Access, access_of, grant
from rlservo.serve_app.server.core import Core, StoreProvider
from rlservo.serve_app.server.gauges import gauges_of
from rlservo.serve_app.server.request_checks import PATH, Hosts, RequestChecks, check_path
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.replica_versions import ReplicaVersions

CODES = {404: "not-found", 405: "method-not-allowed", 413: "too-large", 415: "wrong-media-type"}
ACT_PATH = "/v1/policies/{name}/act"
ACT_VERSION_PATH = "/v1/policies/{name}/versions/{version}/act"
PATHS_REMEMBERED, LONGEST_REMEMBERED = 1024, 512  # the longest that a name and a version can make is 170


def create_app(
    store_provider: StoreProvider,
    settings: ServerSettings,
    *,
    replica: str = "",
    control: ReplicaVersions | None = None,
    alone: Callable[[], bool] = lambda: True,
    host: str = "127.0.0.1",
) -> PolicyApp:
    """Return the application; `store_provider` gives None for as long as the policies are being loaded.

    With a `control` what is served can be administered. `replica` and `alone` are the `Core`'s, which is the
    application's `state.core`; `host` is the address that is listened on. Raises UsageError when the API keys that
    `settings` name cannot be read.
    """
    core = Core(store_provider, settings, replica=replica, control=control, alone=alone)
    core.metrics.sources += gauges_of(core)
    checks = RequestChecks(Hosts(host, settings, keyed=core.guard.asks_for_keys))
    # A redirect would be an answer to a path that no route has: there is none.
    app = PolicyApp(
        core, checks, title="rlservo", description=DESCRIPTION, docs_url=None, redoc_url=None, redirect_slashes=False
    )
    (document,) = app.routes  # FastAPI's own, /openapi.json: it tells nothing of policies
    grant(Access.open)(document)
    app.state.core = core  # for gRPC and the replica, which are no part of the application
    _add_act(app, Endpoint("json", ActHandler(core), check_headers, core))
    _add_streams(app, Stream(core))
    add_policy_routes(app, core)
    _add_health(app, core)
    if control is not None:
        add_admin(app, core, control)
    oip_config.add_routes(app, core)
    oip_models.add_routes(app, core, app.add_direct)
    if settings.docs:
        add_docs(app)
    app.add_exception_handler(RlservoError, _on_rlservo_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_bug)
    return app


DESCRIPTION = "Actions from exported RLlib policies. Every error is a sentence, a code and, where it helps, details."


class PolicyApp(FastAPI):
    """A FastAPI application that finds each request's route itself, lets the route decide who may use it, and answers
    requests for actions before its middleware and router see them.

    Those cost as much again as the request does (measured: a sixth of the round trip). What it `takes` needs nothing
    that Serve does, either (`ingress.py`). A path that no route has never reaches FastAPI.
    """

    def __init__(self, core: Core, checks: RequestChecks, **options: Any) -> None:
        super().__init__(**options)
        self._core = core
        self._checks = checks
        self._direct: dict[str, list[BareRoute | StreamRoute]] = {"POST": [], "WEBSOCKET": []}
        self._found: dict[tuple[str, str], tuple[BareRoute | StreamRoute, dict[str, Any]]] = {}
        self._mount: str | None = None  # the paths' prefix, which the first request that Serve brings tells

    def add_direct(self, route: BareRoute | StreamRoute) -> None:
        """Add a route that is answered without FastAPI, which only documents it."""
        self.router.routes.append(route)
        self._direct["POST" if isinstance(route, BareRoute) else "WEBSOCKET"].append(route)

    def takes(self, scope: Scope) -> bool:
        """Whether this is a request for actions, or a stream, that Serve has not handled yet."""
        mount, path = self._mount, scope["path"]
        return mount is not None and path.startswith(mount) and self._find_direct(scope, path[len(mount) :]) is not None

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer what it takes, under the prefix that Serve would have put it."""
        scope["root_path"] = self._mount
        await self(scope, receive, send)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch one ASGI connection."""
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        self._mount = scope.get("root_path", "")
        path = route_path(scope)
        try:
            direct = self._find_direct(scope, path)
            if direct is None or b"%" in (scope.get("raw_path") or b""):
                check_path(scope, path)
            route, access = (direct[0], direct[0].access) if direct is not None else self._find(scope)
            presented, unreadable = self._checks.read(scope)
            scope[http_endpoint.KEY] = self._core.guard.check(presented, access)
            if unreadable is not None:
                raise RequestError(f"the header '{unreadable[:64]}' is not UTF-8")
        except RlservoError as error:
            await self._refuse(scope, receive, send, error)
            return
        if direct is not None:
            scope["path_params"] = direct[1]
            if scope["type"] == "websocket":
                scope[CHECK_KEY] = partial(self._core.guard.check, presented, access)
            await direct[0].app(scope, receive, send)
        elif scope["type"] == "websocket":
            sentence = f"no stream is at {path[:200]}: connect to /v1/policies/NAME/stream"
            await refuse(scope, receive, send, UnknownPolicyError(sentence))
        elif route is None:
            await _http_error(404, scope)(scope, receive, send)
        else:
            try:
                body = await http_endpoint.receive_body(self._core, scope, receive)
            except RlservoError as error:
                await self._refuse(scope, receive, send, error)
                return
            if body is not None:  # else the client has gone
                await super().__call__(scope, http_endpoint.replay(body, receive), send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, error: RlservoError) -> None:
        self._core.kept_out(scope["type"], error, http_endpoint.request_id(scope), peer=http_endpoint.peer_of(scope))
        await refuse(scope, receive, send, error)

    def _find_direct(self, scope: Scope, path: str) -> tuple[BareRoute | StreamRoute, dict[str, Any]] | None:
        """Return the direct route of a usable path below the prefix, and the path's parameters."""
        kind = scope["method"] if scope["type"] == "http" else "WEBSOCKET"
        found = self._found.get((kind, path))
        if found is None and len(path) <= LONGEST_REMEMBERED and PATH.fullmatch(path) is not None:
            for route in self._direct.get(kind, ()):
                match = route.path_regex.fullmatch(path)
                if match is not None:
                    if len(self._found) >= PATHS_REMEMBERED:
                        self._found.clear()
                    found = self._found[kind, path] = (route, match.groupdict())
                    break
        return found

    def _find(self, scope: Scope) -> tuple[BaseRoute | None, Access]:
        """Return (the route that FastAPI will take, who may use it).

        A path with another method is kept as its most guarded route is; one without any is for whoever has a key.
        """
        others: list[BaseRoute] = []
        for route in self.router.routes:
            match, _ = route.matches(scope)
            if match is Match.FULL:
                return route, access_of(route)
            if match is Match.PARTIAL:
                others.append(route)
        if not others:
            return None, Access.act
        levels = {access_of(route) for route in others}
        return others[0], next(level for level in (Access.admin, Access.act, Access.open) if level in levels)


def route_path(scope: Scope) -> str:
    """Return a connection's path below the prefix that the application is mounted at, as Starlette's routes see it."""
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    below = path[len(root) :]
    return below if path.startswith(root) and below[:1] in ("", "/") else path


def _add_act(app: PolicyApp, act: ASGIApp) -> None:
    for path, operation, summary in (
        (ACT_PATH, "act", "Act with the default version"),
        (ACT_VERSION_PATH, "act_version", "Act with one version, or with what an alias leads to"),
    ):
        app.add_direct(
            BareRoute(
                path,
                act,
                operation=operation,
                tag="act",
                summary=summary,
                reply=json_messages.ActReply,
                body={"application/json": {"schema": json_messages.ActRequest.model_json_schema()}},
                responses=http_errors.error_models(400, 404, 408, 409, 410, 413, 415, 422, 500, 503),
            )
        )


def _add_streams(app: PolicyApp, stream: ASGIApp) -> None:
    for path in STREAM_PATHS:
        app.add_direct(StreamRoute(path, stream))


def _add_health(app: FastAPI, core: Core) -> None:
    @app.get(
        "/healthz",
        tags=["health"],
        summary="The process answers",
        response_class=Response,
        responses=http_errors.error_models(),
    )
    @grant(Access.open)
    async def healthz() -> Response:
        return Response("OK", media_type="text/plain")

    @app.get(
        "/metrics",
        tags=["health"],
        summary="For Prometheus: what this replica answered",
        response_class=Response,
        responses=http_errors.error_models(),
    )
    @grant(Access.act)
    async def metrics() -> Response:
        return Response(core.exposition(), media_type=CONTENT_TYPE_LATEST)


# Errors of the routes that FastAPI runs; `http_endpoint.py` has the table.


async def _on_rlservo_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RlservoError)
    status, content, headers = http_errors.error_answer(error)
    return Response(content, status, {name.decode(): value.decode() for name, value in headers})


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _http_error(error.status_code, request.scope, error)


def _http_error(status: int, scope: Scope, error: HTTPException | None = None) -> Response:
    """Return the answer where no route of ours has decided."""
    path, headers = scope["path"][:200], (error and error.headers) or {}
    sentences = {
        404: f"nothing is at {path}: policies are under /v1/policies, documentation at /docs",
        405: f"{scope['method']} is not what {path} takes: {headers.get('Allow', 'another method')} is",
    }
    sentence = sentences.get(status, str(error and error.detail))
    return json_reply(status, {"error": sentence, "code": CODES.get(status, "http-error")}, headers)


async def _on_validation_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return json_reply(400, {"error": f"{where}: {first['msg']}", "code": RequestError.code})


async def _on_bug(_request: Request, _error: Exception) -> Response:
    return Response(http_errors.encode_bug(), 500, None, "application/json")  # Starlette raises it again, for the log
