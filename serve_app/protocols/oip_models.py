"""Open Inference Protocol v2: metadata of server and models, health, and the repository index."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import orjson
from fastapi import Depends, FastAPI, Request
from fastapi.responses import Response
from pydantic import BaseModel, Field

import rlservo
from rlservo.export.contract.contract import TensorSpec
from rlservo.serve_app.protocols.direct_routes import PostRoute
from rlservo.serve_app.protocols.http_endpoint import HttpEndpoint
from rlservo.serve_app.protocols.http_errors import error_models
from rlservo.serve_app.protocols.json_messages import parse_json
from rlservo.serve_app.protocols.oip_infer import (
    InferReply,
    InferRequest,
    OipHttpCodec,
    accept_media_type,
    last_action_inputs,
    output_names,
)
from rlservo.serve_app.protocols.oip_tensors import datatype_of, parse_flag
from rlservo.serve_app.server.api_keys import Access, grant
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.listing import states_of

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


# What can be asked about the server and its models. FastAPI runs these: nobody asks a thousand times a second.


def add_routes(app: FastAPI, core: Core, add_direct: Callable[[PostRoute], None]) -> None:
    """Add /v2 to the application; `add_direct` adds what FastAPI only documents."""
    infer = HttpEndpoint("oip", OipHttpCodec(core), core)
    _add_health(app, core)
    _add_models(app, core)
    for path, operation, summary in (
        ("/v2/models/{name}/infer", "infer", "Infer with the default version"),
        (
            "/v2/models/{name}/versions/{version}/infer",
            "infer_version",
            "Infer with one version, or with what an alias leads to",
        ),
    ):
        add_direct(
            PostRoute(
                path,
                infer,
                operation=operation,
                tag="open inference protocol",
                summary=summary,
                reply=InferReply,
                body={
                    "application/json": {"schema": _request_schema()},
                    "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
                },
                responses=error_models(400, 404, 408, 409, 410, 413, 415, 422, 500, 503),
            )
        )


def _request_schema() -> dict[str, Any]:
    """The request's schema; the tensor's is already among the document's, through the reply."""
    schema = InferRequest.model_json_schema(ref_template="#/components/schemas/{model}")
    schema.pop("$defs")
    return schema


def _add_health(app: FastAPI, core: Core) -> None:
    @app.get(
        "/v2/health/live",
        tags=["health"],
        summary="The process answers (Open Inference Protocol)",
        responses=error_models(),
    )
    @grant(Access.open)
    async def live() -> Response:
        return _json({"live": True})

    @app.get(
        "/v2/health/ready", tags=["health"], summary="The policies are loaded and proven", responses=error_models(503)
    )
    @grant(Access.open)
    async def ready() -> Response:
        core.store()
        return _json({"ready": True})


def _add_models(app: FastAPI, core: Core) -> None:
    tags: list[Any] = ["open inference protocol"]
    errors = error_models(404, 503)

    @app.get(
        "/v2",
        tags=tags,
        summary="The server and the extensions it speaks",
        response_model=ServerMetadata,
        responses=error_models(),
    )
    @grant(Access.act)
    async def server() -> Response:
        return _json(server_metadata())

    @app.get("/v2/models/{name}", tags=tags, summary="A model", response_model=ModelMetadata, responses=errors)
    @grant(Access.act)
    async def model(name: str) -> Response:
        return _json(model_metadata(core, name, None))

    @app.get(
        "/v2/models/{name}/versions/{version}",
        tags=tags,
        summary="One version of a model",
        response_model=ModelMetadata,
        responses=errors,
    )
    @grant(Access.act)
    async def model_version(name: str, version: str) -> Response:
        return _json(model_metadata(core, name, version))

    @app.get("/v2/models/{name}/ready", tags=tags, summary="The model is loaded and proven", responses=errors)
    @grant(Access.act)
    async def model_ready(name: str) -> Response:
        return _json({"name": core.store().get(name).contract.name, "ready": True})

    @app.get("/v2/models/{name}/versions/{version}/ready", tags=tags, summary="The version is loaded", responses=errors)
    @grant(Access.act)
    async def model_version_ready(name: str, version: str) -> Response:
        return _json({"name": core.store().get(name, version).contract.name, "ready": True})

    @app.post(
        "/v2/repository/index",
        tags=tags,
        summary="Every version of every model",
        dependencies=[Depends(accept_media_type)],
        response_model=list[ModelState],
        responses=error_models(415, 503),
    )
    @grant(Access.act)
    async def index(request: Request) -> Response:
        body = await request.body()
        ready = False
        if body:
            document, _ = parse_json(body, such_as='{"ready": true}')
            ready = bool(parse_flag(document, "ready"))
        return _json(repository_index(core, ready=ready))


# What can be asked, as the protocol's documents; gRPC's messages have the same fields.


def server_metadata() -> dict[str, Any]:
    """Return who this is, and the extensions it speaks."""
    return {"name": "rlservo", "version": rlservo.__version__, "extensions": EXTENSIONS}


def repository_index(core: Core, *, ready: bool = False) -> list[dict[str, str]]:
    """Return every version of every model and how it stands; `ready` leaves the others out."""
    core.store()
    return [
        {"name": name, "version": version, "state": STATES[state.state], "reason": state.reason}
        for name, versions in states_of(core).items()
        for version, state in versions.items()
        if state.state == "ready" or not ready
    ]


def model_metadata(core: Core, name: str, version: str | None) -> dict[str, Any]:
    """Return a model's inputs and outputs; `version` None is the default."""
    policy = core.store().get(name, version)
    contract = policy.contract
    versions = core.store().versions(name) if version is None else (contract.version,)
    inputs = [*contract.inputs, *(last_action_inputs(contract) if policy.has_step_limit else ())]

    def described(tensor: TensorSpec) -> dict[str, Any]:
        return {"name": tensor.name, "datatype": datatype_of(tensor.dtype), "shape": tensor.shape}

    return {
        "name": name,
        "versions": versions,
        "platform": PLATFORM,
        "inputs": [described(tensor) for tensor in inputs],
        "outputs": [described(tensor) for tensor in contract.outputs if tensor.name in output_names(contract)],
    }


def _json(document: Any) -> Response:
    return Response(orjson.dumps(document), media_type="application/json")
