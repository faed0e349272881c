"""JSON protocol: actions under /v1/policies/NAME/act, and the listings beside them.

`ActHandler` is the hot path, on an `Endpoint` that FastAPI documents but does not run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.responses import Response
from starlette.types import Scope

from rlservo.export.contract.contract import Contract, contract_json
from rlservo.export.contract.errors import MediaTypeError, ObservationError
from rlservo.serve_app.protocols import http_endpoint, http_errors, json_messages
from rlservo.serve_app.protocols.http_endpoint import Body
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access, grant
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.versions.policy_store import Decision


class ActHandler:
    """Answers act requests: JSON in, JSON out."""

    def __init__(self, core: Core) -> None:
        self._core = core

    async def __call__(self, scope: Scope, body: Body, received: float) -> tuple[bytes, Headers, Decision]:
        self._core.store()  # not ready comes before any fault of the request
        request = json_messages.read_request(body)
        if request.non_finite and request.episode is not None:
            json_messages.refuse_non_finite()  # before a session moves on
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
                session=http_endpoint.session_of(scope),
            )
        except ObservationError as error:
            if request.non_finite:
                raise ObservationError(f"{error.message}; JSON has no NaN or Infinity", error.details) from error
            raise
        if request.non_finite:
            json_messages.refuse_non_finite()
        clock = None if request.timestamp is None else json_messages.clock(request.timestamp, received)
        return json_messages.encode_decision(decision, request.seq, clock), JSON_HEADERS, decision


def add_policy_routes(app: FastAPI, core: Core) -> None:
    store = core.store

    @app.get(
        "/v1/policies",
        tags=["policies"],
        summary="What is served",
        response_model=listing.PolicyList,
        responses=http_errors.error_models(),
    )
    @grant(Access.act)
    async def list_policies() -> Response:
        return json_reply(200, listing.describe(core))

    @app.get(
        "/v1/policies/{name}",
        tags=["policies"],
        summary="A policy's contract (the default version)",
        response_model=Contract,
        responses=http_errors.error_models(404, 503),
    )
    @grant(Access.act)
    async def get_policy(name: str) -> Response:
        return Response(contract_json(store().get(name).contract), media_type="application/json")

    @app.get(
        "/v1/policies/{name}/versions/{version}",
        tags=["policies"],
        summary="The contract of a version, or of what an alias leads to",
        response_model=Contract,
        responses=http_errors.error_models(404, 503),
    )
    @grant(Access.act)
    async def get_policy_version(name: str, version: str) -> Response:
        return Response(contract_json(store().get(name, version).contract), media_type="application/json")


def check_headers(headers: list[tuple[bytes, bytes]]) -> None:
    http_endpoint.check_media_type(headers, JSON)
    for name, value in headers:
        if name == b"content-encoding" and value.lower() != b"identity":
            raise MediaTypeError(f"the content encoding '{value[:32].decode('latin-1')}' is not read: send plain JSON")


def json_reply(status: int, document: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    return Response(json_messages.encode_json(document), status, headers, "application/json")
