"""The JSON protocol under /v1, and health, as a FastAPI application over the `Core`; the other protocols join it here.

`_Act` is the hot path, on an `Endpoint` that FastAPI documents but does not run. This file knows nothing of ray;
`app.py` puts the application into a replica.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.export.bundle import Contract, contract_json
from rlservo.export.errors import MediaTypeError, ObservationError, RequestError, RlservoError
from rlservo.serve_app import edge, listing, oip, wire
from rlservo.serve_app.admin import add_admin
from rlservo.serve_app.control import Control
from rlservo.serve_app.core import Core, StoreProvider
from rlservo.serve_app.docs import add_docs
from rlservo.serve_app.edge import JSON, JSON_HEADERS, BareRoute, Body, Endpoint, Headers
from rlservo.serve_app.settings import ServerSettings
from rlservo.serve_app.store import Decision
from rlservo.serve_app.stream import CHECK_KEY, STREAM_PATTERN, Stream, refuse

CODES = {404: "not-found", 405: "method-not-allowed", 413: "too-large", 415: "wrong-media-type"}
ACT_PATH = "/v1/policies/{name}/act"
ACT_VERSION_PATH = "/v1/policies/{name}/versions/{version}/act"
ACT_PATTERN = re.compile(r"/v1/policies/(?P<name>[^/]+)(?:/versions/(?P<version>[^/]+))?/act")


def create_app(
    store_provider: StoreProvider,
    settings: ServerSettings,
    *,
    replica: str = "",
    control: Control | None = None,
    alone: Callable[[], bool] = lambda: True,
) -> PolicyApp:
    """Return the application; `store_provider` gives None for as long as the policies are being loaded.

    With a `control` what is served can be administered. `replica` and `alone` are the `Core`'s, which is the
    application's `state.core`. Raises UsageError when the API keys that `settings` name cannot be read.
    """
    core = Core(store_provider, settings, replica=replica, control=control, alone=alone)
    act = Endpoint("json", _Act(core), _check_headers, core)
    infer = oip.endpoint(core)
    app = PolicyApp(
        ((ACT_PATTERN, act), (oip.INFER_PATTERN, infer)),
        Stream(core),
        core,
        title="rlservo",
        description=DESCRIPTION,
        docs_url=None,
        redoc_url=None,
    )
    app.state.core = core  # for gRPC and the replica, which are no part of the application
    _add_act(app, act)
    _add_policies(app, core)
    _add_health(app, core)
    if control is not None:
        add_admin(app, core, control)
    oip.add_routes(app, core, infer)
    if settings.docs:
        add_docs(app)
    app.add_exception_handler(RlservoError, _on_rlservo_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_bug)
    return app


DESCRIPTION = "Actions from exported RLlib policies. Every error is a sentence, a code and, where it helps, details."


class PolicyApp(FastAPI):
    """A FastAPI application that answers requests for actions before its middleware and router see them.

    Those cost as much again as the request does (measured: a sixth of the round trip). The routes are still there: for
    the documentation, and for whatever is not a POST. What it `takes` needs nothing that Serve does, either
    (`ingress.py`).
    """

    def __init__(
        self, direct: tuple[tuple[re.Pattern[str], ASGIApp], ...], stream: ASGIApp, core: Core, **options: Any
    ) -> None:
        super().__init__(**options)
        self._direct = direct
        self._stream = stream
        self._core = core
        self._mount: str | None = None  # the paths' prefix, which the first request that Serve brings tells

    def takes(self, scope: Scope) -> bool:
        """Whether this is a request for actions, or a stream, that Serve has not handled yet."""
        mount, path = self._mount, scope["path"]
        if mount is None or not path.startswith(mount):
            return False
        path = path[len(mount) :]
        if scope["type"] == "http":
            return scope["method"] == "POST" and any(pattern.fullmatch(path) for pattern, _ in self._direct)
        return scope["type"] == "websocket" and STREAM_PATTERN.fullmatch(path) is not None

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
        path = scope["path"].removeprefix(self._mount)
        try:
            self._core.guard.check(scope, path)
        except RlservoError as error:
            self._core.kept_out(scope["type"], error, edge.request_id(scope))
            await refuse(scope, receive, send, error)
            return
        if scope["type"] == "http" and scope["method"] == "POST":
            for pattern, endpoint in self._direct:
                match = pattern.fullmatch(path)
                if match is not None:
                    scope["path_params"] = match.groupdict()
                    await endpoint(scope, receive, send)
                    return
        elif scope["type"] == "websocket":
            scope[CHECK_KEY] = partial(self._core.guard.check, scope, path)
            await self._stream(scope, receive, send)
            return
        await super().__call__(scope, receive, send)


class _Act:
    """Answers act requests: JSON in, JSON out."""

    def __init__(self, core: Core) -> None:
        self._core = core

    async def __call__(self, scope: Scope, body: Body, received: float) -> tuple[bytes, Headers, Decision]:
        self._core.store()  # not ready comes before any fault of the request
        request = wire.read_request(body)
        if request.non_finite and request.episode is not None:
            wire.refuse_non_finite()  # before a session moves on
        params = scope["path_params"]
        try:
            decision = await self._core.act(
                params["name"],
                params.get("version"),
                request.obs,
                received=received,
                explore=request.explore,
                seed=request.seed,
                seq=request.seq,
                deadline_ms=request.deadline_ms,
                episode=request.episode,
                session=edge.session_of(scope),
            )
        except ObservationError as error:
            if request.non_finite:
                raise ObservationError(f"{error.message}; JSON has no NaN or Infinity", error.details) from error
            raise
        if request.non_finite:
            wire.refuse_non_finite()
        clock = None if request.timestamp is None else wire.clock(request.timestamp, received)
        return wire.encode_decision(decision, request.seq, clock), JSON_HEADERS, decision


def _add_act(app: FastAPI, act: ASGIApp) -> None:
    for path, operation, summary in (
        (ACT_PATH, "act", "Act with the default version"),
        (ACT_VERSION_PATH, "act_version", "Act with one version, or with what an alias leads to"),
    ):
        app.router.routes.append(
            BareRoute(
                path,
                act,
                operation=operation,
                tag="act",
                summary=summary,
                reply=wire.ActReply,
                body={"application/json": {"schema": wire.ActRequest.model_json_schema()}},
                responses=edge.error_models(400, 404, 408, 409, 410, 413, 415, 422, 500, 503),
            )
        )


def _add_policies(app: FastAPI, core: Core) -> None:
    store = core.store

    @app.get("/v1/policies", tags=["policies"], summary="What is served", response_model=listing.PolicyList)
    async def list_policies() -> Response:
        return _json(200, listing.describe(core))

    @app.get(
        "/v1/policies/{name}",
        tags=["policies"],
        summary="A policy's contract (the default version)",
        response_model=Contract,
        responses=edge.error_models(404, 503),
    )
    async def get_policy(name: str) -> Response:
        return Response(contract_json(store().get(name).contract), media_type="application/json")

    @app.get(
        "/v1/policies/{name}/versions/{version}",
        tags=["policies"],
        summary="The contract of a version, or of what an alias leads to",
        response_model=Contract,
        responses=edge.error_models(404, 503),
    )
    async def get_policy_version(name: str, version: str) -> Response:
        return Response(contract_json(store().get(name, version).contract), media_type="application/json")


def _add_health(app: FastAPI, core: Core) -> None:
    @app.get("/healthz", tags=["health"], summary="The process answers", response_class=Response)
    async def healthz() -> Response:
        return Response("OK", media_type="text/plain")

    @app.get("/metrics", tags=["health"], summary="For Prometheus: what this replica answered", response_class=Response)
    async def metrics() -> Response:
        return Response(core.exposition(), media_type=CONTENT_TYPE_LATEST)


# Errors of the routes that FastAPI runs; `edge.py` has the table.


async def _on_rlservo_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RlservoError)
    status, content, headers = edge.error_answer(error)
    return Response(content, status, {name.decode(): value.decode() for name, value in headers})


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = CODES.get(error.status_code, "http-error")
    path = request.url.path[:200]
    sentences = {
        404: f"nothing is at {path}: policies are under /v1/policies, documentation at /docs",
        405: f"{request.method} is not what {path} takes: {(error.headers or {}).get('Allow', 'another method')} is",
    }
    sentence = sentences.get(error.status_code, str(error.detail))
    return _json(error.status_code, {"error": sentence, "code": code}, error.headers)


async def _on_validation_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return _json(400, {"error": f"{where}: {first['msg']}", "code": RequestError.code})


async def _on_bug(_request: Request, _error: Exception) -> Response:
    return Response(edge.encode_bug(), 500, None, "application/json")  # Starlette raises it again, for the log


def _check_headers(headers: list[tuple[bytes, bytes]]) -> None:
    for name, value in headers:
        if name == b"content-type":
            if value != JSON and value.split(b";", 1)[0].strip().lower() != JSON:
                raise MediaTypeError(
                    f"the content type is '{value[:64].decode('latin-1')}': send application/json "
                    "(curl: -H 'content-type: application/json')"
                )
        elif name == b"content-encoding" and value.lower() != b"identity":
            raise MediaTypeError(f"the content encoding '{value[:32].decode('latin-1')}' is not read: send plain JSON")


def _json(status: int, document: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    return Response(wire.encode_json(document), status, headers, "application/json")
