"""Routes of the JSON protocol: actions under /v1/policies/NAME/act, and the listings beside them."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI
from fastapi.responses import Response

from rlservo.export.contract.contract import Contract, contract_json
from rlservo.serve_app.protocols.direct_routes import PostRoute
from rlservo.serve_app.protocols.http_endpoint import HttpEndpoint
from rlservo.serve_app.protocols.http_errors import error_models
from rlservo.serve_app.protocols.json_codec import JsonCodec
from rlservo.serve_app.protocols.json_messages import ActReply, ActRequest, encode_json
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access, grant
from rlservo.serve_app.server.core import Core


def add_routes(app: FastAPI, core: Core, add_direct: Callable[[PostRoute], None]) -> None:
    """Add /v1 to the application; `add_direct` adds what FastAPI only documents."""
    act = HttpEndpoint("json", JsonCodec(core), core)
    for path, operation, summary in (
        ("/v1/policies/{name}/act", "act", "Act with the default version"),
        (
            "/v1/policies/{name}/versions/{version}/act",
            "act_version",
            "Act with one version, or with what an alias leads to",
        ),
    ):
        add_direct(
            PostRoute(
                path,
                act,
                operation=operation,
                tag="act",
                summary=summary,
                reply=ActReply,
                body={"application/json": {"schema": ActRequest.model_json_schema()}},
                responses=error_models(400, 404, 408, 409, 410, 413, 415, 422, 500, 503),
            )
        )
    _add_policies(app, core)


def _add_policies(app: FastAPI, core: Core) -> None:
    store = core.store

    @app.get(
        "/v1/policies",
        tags=["policies"],
        summary="What is served",
        response_model=listing.PolicyList,
        responses=error_models(),
    )
    @grant(Access.act)
    async def list_policies() -> Response:
        return Response(encode_json(listing.describe(core)), media_type="application/json")

    @app.get(
        "/v1/policies/{name}",
        tags=["policies"],
        summary="A policy's contract (the default version)",
        response_model=Contract,
        responses=error_models(404, 503),
    )
    @grant(Access.act)
    async def get_policy(name: str) -> Response:
        return Response(contract_json(store().get(name).contract), media_type="application/json")

    @app.get(
        "/v1/policies/{name}/versions/{version}",
        tags=["policies"],
        summary="The contract of a version, or of what an alias leads to",
        response_model=Contract,
        responses=error_models(404, 503),
    )
    @grant(Access.act)
    async def get_policy_version(name: str, version: str) -> Response:
        return Response(contract_json(store().get(name, version).contract), media_type="application/json")
