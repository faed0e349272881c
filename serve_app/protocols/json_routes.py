"""Routes of the JSON protocol: actions under /v1/policies/NAME/act, and the listings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from fastapi import FastAPI
from fastapi.responses import Response

from rlservo.export.contract.contract import Contract, contract_json
from rlservo.serve_app.protocols.action_routes import PostRoute, post_routes
from rlservo.serve_app.protocols.fastapi_routes import add_route
from rlservo.serve_app.protocols.http_endpoint import HttpEndpoint
from rlservo.serve_app.protocols.json_codec import JsonCodec
from rlservo.serve_app.protocols.json_messages import ActReply, ActRequest, encode_json
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.request_handler import RequestHandler


def add_routes(app: FastAPI, handler: RequestHandler, add: Callable[[PostRoute], None]) -> None:
    """Add /v1 to the application; `add` adds routes that FastAPI only documents."""
    act = HttpEndpoint("json", JsonCodec(handler), handler)
    body = {"application/json": {"schema": ActRequest.model_json_schema()}}
    for route in post_routes("/v1/policies", "act", act, tag="act", reply=ActReply, body=body):
        add(route)
    _add_policies(app, handler)


def _add_policies(app: FastAPI, handler: RequestHandler) -> None:
    get = partial(add_route, app, Access.act, "GET")
    default = "A policy's contract (the default version)"
    chosen = "The contract of a version, or of what an alias leads to"

    @get("/v1/policies", "policies", "What is served", response_model=listing.PolicyList)
    async def list_policies() -> Response:
        return Response(encode_json(listing.describe(handler)), media_type="application/json")

    @get("/v1/policies/{name}", "policies", default, 404, 503, response_model=Contract)
    async def get_policy(name: str) -> Response:
        return Response(contract_json(handler.store().get(name).contract), media_type="application/json")

    @get("/v1/policies/{name}/versions/{version}", "policies", chosen, 404, 503, response_model=Contract)
    async def get_policy_version(name: str, version: str) -> Response:
        return Response(contract_json(handler.store().get(name, version).contract), media_type="application/json")
