"""The JSON protocol under /v1, and health, as a FastAPI application over a `PolicyStore`.

`Actor.act` is the hot path: a plain ASGI callable on a route that FastAPI documents but does not run, because its
dependency and response machinery costs more than the policy does. Everything runs in the event loop: a decision takes
microseconds, a hop to a thread takes more. This file knows nothing of ray; `app.py` puts it into a replica.
"""

from __future__ import annotations

import asyncio
import logging
import re
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send

from rlservo.export.bundle import Contract, contract_json
from rlservo.export.errors import (
    ActionError,
    DeadlineError,
    MediaTypeError,
    ObservationError,
    RequestError,
    RlservoError,
    TooLargeError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app import wire
from rlservo.serve_app.docs import add_docs
from rlservo.serve_app.settings import ServerSettings
from rlservo.serve_app.store import PolicyStore

logger = logging.getLogger(__name__)

STATUS: tuple[tuple[type[RlservoError], int], ...] = (  # the first that fits; whatever does not fit is our fault: 500
    (ObservationError, 422),
    (UnknownPolicyError, 404),
    (MediaTypeError, 415),
    (TooLargeError, 413),
    (RequestError, 400),
    (DeadlineError, 408),
    (UnavailableError, 503),
    (ActionError, 500),
)
CODES = {404: "not-found", 405: "method-not-allowed", 413: "too-large", 415: "wrong-media-type"}
RETRY_AFTER_S = 1
JSON = b"application/json"
ACT_PATH = "/v1/policies/{name}/act"
ACT_VERSION_PATH = "/v1/policies/{name}/versions/{version}/act"
ACT_PATTERN = re.compile(r"/v1/policies/(?P<name>[^/]+)(?:/versions/(?P<version>[^/]+))?/act")

StoreProvider = Callable[[], PolicyStore | None]


def create_app(store_provider: StoreProvider, settings: ServerSettings) -> FastAPI:
    """Return the application; `store_provider` gives None for as long as the policies are being loaded."""
    actor = Actor(store_provider, settings)
    app = PolicyApp(actor.act, title="rlservo", description=DESCRIPTION, docs_url=None, redoc_url=None)
    for path, summary in ((ACT_PATH, "Act with the newest version"), (ACT_VERSION_PATH, "Act with one version")):
        app.router.routes.append(ActRoute(path, actor.act, summary))
    _add_policies(app, store_provider)
    _add_health(app, store_provider)
    if settings.docs:
        add_docs(app)
    app.add_exception_handler(RlservoError, _on_rlservo_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_bug)
    return app


DESCRIPTION = "Actions from exported RLlib policies. Every error is a sentence, a code and, where it helps, details."


class PolicyApp(FastAPI):
    """A FastAPI application that answers act requests before its middleware and router see them.

    Those cost as much again as the request does (measured: a sixth of the round trip). The routes are still there: for
    the documentation, and for whatever is not a POST.
    """

    def __init__(self, act: ASGIApp, **options: Any) -> None:
        super().__init__(**options)
        self._act = act

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch one ASGI connection."""
        if scope["type"] == "http" and scope["method"] == "POST":
            match = ACT_PATTERN.fullmatch(scope["path"].removeprefix(scope.get("root_path", "")))
            if match is not None:
                scope["path_params"] = match.groupdict()
                await self._act(scope, receive, send)
                return
        await super().__call__(scope, receive, send)


class Actor:
    """Answers act requests."""

    def __init__(self, store_provider: StoreProvider, settings: ServerSettings) -> None:
        self._store_provider = store_provider
        self._max_body = settings.max_body_bytes
        self._max_batch = settings.max_batch
        self._timeout_s = settings.body_timeout_s

    async def act(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request: read it, decide, reply."""
        received = time.perf_counter()
        headers: tuple[tuple[bytes, bytes], ...] = ()
        try:
            _check_headers(scope["headers"], self._max_body)
            body = await self._read_body(receive)
            if body is None:  # the client has gone
                return
            status, content = 200, self._decide(scope["path_params"], body, received)
        except RlservoError as error:
            status, content = _status(error), _encode_error(error)
            if status == 503:
                headers = ((b"retry-after", str(RETRY_AFTER_S).encode()),)
            elif status >= 500:
                logger.error("%s", error.message)
        except Exception:
            logger.exception("an act request failed")
            status, content = 500, _encode_bug()
        await send(
            {
                "type": "http.response.start",
                "status": status,
                "headers": [(b"content-type", JSON), (b"content-length", b"%d" % len(content)), *headers],
            }
        )
        await send({"type": "http.response.body", "body": content})

    def _decide(self, params: Mapping[str, str], body: bytes | bytearray, received: float) -> bytes:
        store = self._store_provider()
        if store is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        request = wire.read_request(body)
        if request.deadline_ms is not None:
            late_ms = (time.perf_counter() - received) * 1e3
            if late_ms >= request.deadline_ms:
                raise DeadlineError(
                    f"the deadline of {request.deadline_ms:g} ms passed before the policy was asked: nothing computed",
                    {"deadline_ms": request.deadline_ms, "elapsed_ms": round(late_ms, 3), "seq": request.seq},
                )
        obs = request.obs
        rows = _rows(obs)
        if rows > self._max_batch:
            policy = store.get(params["name"], params.get("version"))
            shape = policy.contract.observation_space.shape or (0,)
            if type(obs) is dict or rows != shape[0]:  # not one long observation
                raise TooLargeError(f"a batch of {rows} observations is too large: at most {self._max_batch}")
        try:
            decision = store.act(params["name"], params.get("version"), obs, explore=request.explore, seed=request.seed)
        except ObservationError as error:
            if request.non_finite:
                raise ObservationError(f"{error.message}; JSON has no NaN or Infinity", error.details) from error
            raise
        if request.non_finite:
            wire.refuse_non_finite()
        return wire.encode_decision(decision, request.seq)

    async def _read_body(self, receive: Receive) -> bytes | bytearray | None:
        """Return the body, or None when the client hung up. The first message usually holds all of it."""
        task, late = asyncio.current_task(), False

        def expire() -> None:
            nonlocal late
            late = True
            if task is not None:
                task.cancel()

        timer = asyncio.get_running_loop().call_later(self._timeout_s, expire)
        try:
            message = await receive()
            body = message.get("body", b"")
            if message.get("more_body", False):
                body = bytearray(body)
                while message.get("more_body", False):
                    message = await receive()
                    body += message.get("body", b"")
                    if len(body) > self._max_body:
                        break
        except asyncio.CancelledError:
            if not late:
                raise
            if sys.version_info >= (3, 11) and task is not None:  # it counts cancellations
                task.uncancel()
            raise DeadlineError(f"the request body did not arrive within {self._timeout_s:g} s") from None
        finally:
            timer.cancel()
        if message["type"] == "http.disconnect":
            return None
        if len(body) > self._max_body:
            raise _too_large(self._max_body)
        return body  # type: ignore[no-any-return]  # ASGI messages are untyped


class ActRoute(APIRoute):
    """A route FastAPI documents and routes to, and otherwise leaves alone: `app` is a bare ASGI callable."""

    def __init__(self, path: str, act: ASGIApp, summary: str) -> None:
        async def documented() -> None:
            """Send an observation, get the action."""

        super().__init__(
            path,
            documented,
            methods=["POST"],
            name="act",
            tags=["act"],
            summary=summary,
            response_model=wire.ActReply,
            responses=_errors(400, 404, 408, 413, 415, 422, 500, 503),
            openapi_extra={
                "requestBody": {
                    "required": True,
                    "content": {"application/json": {"schema": wire.ActRequest.model_json_schema()}},
                },
                "parameters": [
                    {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
                    for name in ("name", "version")
                    if f"{{{name}}}" in path
                ],
            },
            generate_unique_id_function=lambda route: "act_version" if "{version}" in route.path else "act",
        )
        self.app = act


def _add_policies(app: FastAPI, store_provider: StoreProvider) -> None:
    def store() -> PolicyStore:
        found = store_provider()
        if found is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return found

    @app.get("/v1/policies", tags=["policies"], summary="What is served", response_model=wire.PolicyList)
    async def list_policies() -> Response:
        policies = []
        for name in store().names:
            contract = store().get(name).contract
            policies.append(
                {
                    "name": name,
                    "version": contract.version,
                    "versions": list(store().versions(name)),
                    "description": contract.description,
                    "control_rate_hz": contract.control_rate_hz,
                }
            )
        return _json(200, {"policies": policies})

    @app.get(
        "/v1/policies/{name}",
        tags=["policies"],
        summary="A policy's contract (the newest version)",
        response_model=Contract,
        responses=_errors(404, 503),
    )
    async def get_policy(name: str) -> Response:
        return Response(contract_json(store().get(name).contract), media_type="application/json")

    @app.get(
        "/v1/policies/{name}/versions/{version}",
        tags=["policies"],
        summary="One version's contract",
        response_model=Contract,
        responses=_errors(404, 503),
    )
    async def get_policy_version(name: str, version: str) -> Response:
        return Response(contract_json(store().get(name, version).contract), media_type="application/json")


def _add_health(app: FastAPI, store_provider: StoreProvider) -> None:
    @app.get("/healthz", tags=["health"], summary="The process answers", response_class=Response)
    async def healthz() -> Response:
        return Response("OK", media_type="text/plain")

    @app.get("/v2/health/live", tags=["health"], summary="The process answers (Open Inference Protocol)")
    async def live() -> Response:
        return _json(200, {"live": True})

    @app.get("/v2/health/ready", tags=["health"], summary="The policies are loaded and proven", responses=_errors(503))
    async def ready() -> Response:
        if store_provider() is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return _json(200, {"ready": True})


# Errors: the one table above, and one body for all.


def _status(error: RlservoError) -> int:
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)


def _encode_error(error: RlservoError) -> bytes:
    if _status(error) == 500 and not isinstance(error, ActionError):
        return _encode_bug()
    document: dict[str, Any] = {"error": error.message, "code": error.code}
    if error.details:
        document["details"] = error.details
    return wire.encode_json(document)


def _encode_bug() -> bytes:
    return wire.encode_json({"error": "the server failed on this request; its log says how", "code": "internal"})


async def _on_rlservo_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RlservoError)
    status = _status(error)
    headers = {"retry-after": str(RETRY_AFTER_S)} if status == 503 else None
    return Response(_encode_error(error), status, headers, "application/json")


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
    return Response(_encode_bug(), 500, None, "application/json")  # Starlette raises it again, for the log


def _check_headers(headers: list[tuple[bytes, bytes]], max_body: int) -> None:
    for name, value in headers:
        if name == b"content-type":
            if value != JSON and value.split(b";", 1)[0].strip().lower() != JSON:
                raise MediaTypeError(
                    f"the content type is '{value[:64].decode('latin-1')}': send application/json "
                    "(curl: -H 'content-type: application/json')"
                )
        elif name == b"content-length":
            if value.isdigit() and len(value) < 20 and int(value) > max_body:
                raise _too_large(max_body)
        elif name == b"content-encoding" and value.lower() != b"identity":
            raise MediaTypeError(f"the content encoding '{value[:32].decode('latin-1')}' is not read: send plain JSON")


def _too_large(limit: int) -> TooLargeError:
    return TooLargeError(f"the request body is larger than {limit} bytes", {"max_body_bytes": limit})


def _errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    return {status: {"model": wire.ErrorReply} for status in statuses}


def _json(status: int, document: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    return Response(wire.encode_json(document), status, headers, "application/json")


def _rows(obs: Any) -> int:
    """Return how many observations a batch would hold, lists or names to lists."""
    if type(obs) is dict:
        return max((len(value) for value in obs.values() if type(value) is list), default=0)
    return len(obs) if type(obs) is list else 0
