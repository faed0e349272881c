"""Open Inference Protocol v2: metadata of server and models, health, and the repository index."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import orjson
from fastapi import Depends, FastAPI, Request
from fastapi.responses import Response
from pydantic import BaseModel, Field

import rlservo
from rlservo.export.contract.contract import TensorSpec
from rlservo.serve_app.protocols.action_routes import PostRoute, post_routes
from rlservo.serve_app.protocols.fastapi_routes import add_route
from rlservo.serve_app.protocols.http_endpoint import HttpEndpoint
from rlservo.serve_app.protocols.http_errors import too_large
from rlservo.serve_app.protocols.json_messages import parse_json
from rlservo.serve_app.protocols.oip_infer import (
    InferReply,
    InferRequest,
    OipHttpCodec,
    accept_media_type,
    offered_inputs,
    offered_outputs,
)
from rlservo.serve_app.protocols.oip_tensors import datatype_of, parse_flag
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL
from rlservo.serve_app.server.listing import states_of
from rlservo.serve_app.server.request_handler import RequestHandler

TAG = "open inference protocol"
MODEL, VERSION = "/v2/models/{name}", "/v2/models/{name}/versions/{version}"
PLATFORM = "onnx_onnxv1"
EXTENSIONS = (
    "binary_tensor_data",
    "model_configuration",
    "model_repository",
    "parameters",
    "sequence",
    "statistics",
)
STATES = {"ready": "READY", "loading": "LOADING", "failed": "UNAVAILABLE"}


class ServerMetadata(BaseModel):
    name: str
    version: str
    extensions: list[str]


class TensorMetadata(BaseModel):
    name: str
    datatype: str
    shape: list[int] = Field(description="-1 is the batch.")


class ModelMetadata(BaseModel):
    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]


class ModelState(BaseModel):
    """A line of the repository index."""

    name: str
    version: str
    state: str
    reason: str


def add_routes(app: FastAPI, handler: RequestHandler, add: Callable[[PostRoute], None]) -> None:
    """Add /v2 to the application; `add` adds routes that FastAPI only documents."""
    infer = HttpEndpoint("oip", OipHttpCodec(handler), handler)
    _add_health(app, handler)
    _add_models(app, handler)
    body = {
        "application/json": {"schema": _request_schema()},
        "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
    }
    for route in post_routes("/v2/models", "infer", infer, tag=TAG, reply=InferReply, body=body):
        add(route)


def _request_schema() -> dict[str, Any]:
    """The request's schema; the tensor's is already among the document's, through the reply."""
    schema = InferRequest.model_json_schema(ref_template="#/components/schemas/{model}")
    schema.pop("$defs")
    return schema


def _add_health(app: FastAPI, handler: RequestHandler) -> None:
    get = partial(add_route, app, Access.open, "GET")

    @get("/v2/health/live", "health", "The process answers (Open Inference Protocol)")
    async def live() -> Response:
        return json_response({"live": True})

    @get("/v2/health/ready", "health", "The policies are loaded and proven", 503)
    async def ready() -> Response:
        handler.store()
        return json_response({"ready": True})


def _add_models(app: FastAPI, handler: RequestHandler) -> None:
    get = partial(add_route, app, Access.act, "GET")

    @get("/v2", TAG, "The server and the extensions it speaks", response_model=ServerMetadata)
    async def server() -> Response:
        return json_response(server_metadata())

    @get(MODEL, TAG, "A model", 404, 503, response_model=ModelMetadata)
    async def model(name: str) -> Response:
        return json_response(model_metadata(handler, name, None))

    @get(VERSION, TAG, "One version of a model", 404, 503, response_model=ModelMetadata)
    async def model_version(name: str, version: str) -> Response:
        return json_response(model_metadata(handler, name, version))

    @get(f"{MODEL}/ready", TAG, "The model is loaded and proven", 404, 503)
    async def model_ready(name: str) -> Response:
        return json_response({"name": handler.store().get(name).contract.name, "ready": True})

    @get(f"{VERSION}/ready", TAG, "The version is loaded", 404, 503)
    async def model_version_ready(name: str, version: str) -> Response:
        return json_response({"name": handler.store().get(name, version).contract.name, "ready": True})

    @add_route(
        app,
        Access.act,
        "POST",
        "/v2/repository/index",
        TAG,
        "Every version of every model",
        415,
        503,
        dependencies=[Depends(accept_media_type)],
        response_model=list[ModelState],
    )
    async def index(request: Request) -> Response:
        body = await request.body()
        if len(body) > SMALL:
            raise too_large(SMALL)
        ready = False
        if body:
            document, _ = parse_json(body, such_as='{"ready": true}')
            ready = bool(parse_flag(document, "ready"))
        return json_response(repository_index(handler, ready=ready))


# What can be asked, as the protocol's documents; gRPC's messages have the same fields.


def server_metadata() -> dict[str, Any]:
    """Return who this is, and the extensions it speaks."""
    return {"name": "rlservo", "version": rlservo.__version__, "extensions": EXTENSIONS}


def repository_index(handler: RequestHandler, *, ready: bool = False) -> list[dict[str, str]]:
    """Return every version of every model and how it stands; `ready` leaves the others out."""
    handler.store()
    return [
        {"name": name, "version": version, "state": STATES[state.state], "reason": state.reason}
        for name, versions in states_of(handler).items()
        for version, state in versions.items()
        if state.state == "ready" or not ready
    ]


def model_metadata(handler: RequestHandler, name: str, version: str | None) -> dict[str, Any]:
    """Return a model's inputs and outputs; `version` None is the default."""
    policy = handler.store().get(name, version)
    contract = policy.contract
    versions = handler.store().versions(name) if version is None else (contract.version,)

    def described(tensor: TensorSpec) -> dict[str, Any]:
        return {"name": tensor.name, "datatype": datatype_of(tensor.dtype), "shape": tensor.shape}

    return {
        "name": name,
        "versions": versions,
        "platform": PLATFORM,
        "inputs": [described(tensor) for tensor in offered_inputs(policy)],
        "outputs": [described(tensor) for tensor in offered_outputs(contract)],
    }


def json_response(document: Any) -> Response:
    return Response(orjson.dumps(document), media_type="application/json")
