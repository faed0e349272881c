"""OpenAPI document of the routing table, written by FastAPI, and the replies that it describes.

FastAPI is imported when a client requests the document: it takes a third of a server's start. The requests it shows are
those that pydantic checks (`request_fields.py`, `oip_infer.py`).
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Annotated, Any

import orjson
from fastapi import Body, FastAPI
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, Field

import rlservo
from rlservo.export.contract.contract import Contract
from rlservo.serve_app.protocols.oip_infer import InferRequest, Tensor
from rlservo.serve_app.protocols.request_fields import ActRequest
from rlservo.serve_app.protocols.routes import WEBSOCKET, Route, RoutingTable
from rlservo.serve_app.versions.plan_commands import COMMANDS, Changed
from rlservo.serve_app.versions.serving_plan import Canary

DESCRIPTION = "Actions from exported policies. Every error has a sentence, a code and, where useful, details."
ANY_ROUTE = (400, 401, 403, 408, 413, 429)  # its path, key, host, page, body and rate
OF_POLICY = (404, 503)
OF_COMMAND = (*OF_POLICY, 409, 415)
OF_ACTION = (*OF_COMMAND, 410, 422, 500)


class ActReply(BaseModel):
    """An action, ready for the environment's `step`."""

    action: Any = Field(description="In the action space's shape; for a batch, one such action per observation.")
    policy: str
    version: str
    seq: int | None = Field(None, description="As sent.")
    infer_ms: float = Field(description="Milliseconds to check the observation, run the network and check the action.")
    state: dict[str, Any] | None = Field(None, description="For the next request, if you carry the state.")
    session_id: str | None = Field(None, description="As sent.")
    session_step: int | None = Field(None, description="Number of this action in the session's episode, from 1.")
    warnings: list[str] | None = Field(None, description="Values out of bounds or limited that were used anyway.")
    timestamp: float | None = Field(None, description="As sent.")
    received_at: float | None = Field(None, description="The server's clock [s since 1970] when the request came.")
    sent_at: float | None = Field(None, description="The same when the reply was written.")


class ErrorReply(BaseModel):
    """Body of every error reply."""

    error: str = Field(description="A sentence that names what was given, what was expected and the element.")
    code: str = Field(description="Kebab-case, for programs: for example `bad-observation`.")
    details: dict[str, Any] | None = None


class InferReply(BaseModel):
    """A batch of actions, ready for the environment's `step`."""

    model_name: str
    model_version: str
    id: str | None = None
    parameters: dict[str, Any]
    outputs: list[Tensor]


class VersionStatus(BaseModel):
    """One version of a policy, in the process that answers."""

    version: str
    state: str = Field(description="`loading`, `ready` or `failed`.")
    reason: str = Field(description="Why it failed; empty otherwise.")
    aliases: list[str]
    loaded_at: str | None = Field(description="UTC time at which this process finished loading and proving it.")
    requests: int = Field(description="Requests answered by this process, over all protocols.")


class ShadowStatus(BaseModel):
    """A version whose actions are computed only for comparison; the metrics have the differences."""

    version: str


class PolicySummary(BaseModel):
    """A policy and its versions."""

    name: str
    version: str = Field(description="The default: the version that the alias `production` points to.")
    versions: list[str] = Field(description="Versions that answer, oldest first.")
    description: str
    control_rate_hz: float | None
    aliases: dict[str, str]
    previous: dict[str, str] = Field(description="Version to which a rollback of each alias would lead.")
    canary: Canary | None
    shadow: ShadowStatus | None
    version_states: list[VersionStatus]


class PolicyList(BaseModel):
    """Policies served by one process."""

    policies: list[PolicySummary]
    replica: str = Field(description="The answering process; counts and states are its own.")
    generation: int = Field(description="Number of the plan; equal numbers mean equal policies.")
    changed_at: str | None
    changed_by: str | None
    behind: list[str] = Field(description="Parts of the plan that this process could not follow; usually empty.")


class ServerMetadata(BaseModel):
    """The server, in the Open Inference Protocol."""

    name: str
    version: str
    extensions: list[str]


class TensorMetadata(BaseModel):
    """An input or output of a model."""

    name: str
    datatype: str
    shape: list[int] = Field(description="-1 is the batch.")


class ModelMetadata(BaseModel):
    """A model, in the Open Inference Protocol."""

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


# By method and path without its version: body, reply, and errors besides those of every route.
DESCRIBED: dict[tuple[str, str], tuple[Any, Any, tuple[int, ...]]] = {
    ("POST", "/v1/policies/{name}/act"): (ActRequest, ActReply, OF_ACTION),
    ("POST", "/v2/models/{name}/infer"): (InferRequest, InferReply, OF_ACTION),
    ("GET", "/v1/policies"): (None, PolicyList, ()),
    ("GET", "/v1/policies/{name}"): (None, Contract, OF_POLICY),
    ("GET", "/v1/admin/policies"): (None, list[PolicyList], OF_COMMAND),
    **{("POST", f"/v1/admin/policies/{{name}}/{name}"): (kind, Changed, OF_COMMAND) for name, kind in COMMANDS.items()},
    ("POST", "/v2/repository/models/{name}/load"): (None, Any, OF_COMMAND),
    ("POST", "/v2/repository/models/{name}/unload"): (None, Any, OF_COMMAND),
    ("GET", "/v2"): (None, ServerMetadata, ()),
    ("GET", "/v2/health/ready"): (None, Any, (503,)),
    ("GET", "/v2/models/{name}"): (None, ModelMetadata, OF_POLICY),
    ("POST", "/v2/repository/index"): (None, list[ModelState], (415, 503)),
}
TEXTS = ("/healthz", "/metrics")
BINARY = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}


def openapi(table: RoutingTable) -> bytes:
    """Return the document as JSON; paths are relative to its own, so a proxy may strip a prefix."""
    app = FastAPI(title="rlservo", version=rlservo.__version__, description=DESCRIPTION, servers=[{"url": "."}])
    for route in table.routes:
        if route.method != WEBSOCKET and route.is_documented:
            _describe(app, route)
    return orjson.dumps(app.openapi())


def _describe(app: FastAPI, route: Route) -> None:
    policy = route.path.replace("/versions/{version}", "")
    body, reply, statuses = DESCRIBED.get((route.method, policy), (None, Any, OF_POLICY if "{" in policy else ()))
    extra: dict[str, Any] = {}
    if body is InferRequest:
        extra = {"requestBody": {"content": BINARY}}
    elif policy.startswith("/v2/repository/"):
        extra = {"requestBody": {"required": False, "content": {"application/json": {"schema": {"type": "object"}}}}}
    version = " (one version, or what an alias leads to)" if policy != route.path else ""
    app.add_api_route(
        route.path,
        _endpoint(route, body),
        methods=[route.method],
        summary=route.summary + version,
        tags=[_tag(policy)],
        response_model=None if policy in TEXTS else reply,
        response_class=PlainTextResponse if policy in TEXTS else JSONResponse,
        responses={status: {"model": ErrorReply} for status in sorted({*ANY_ROUTE, *statuses})},
        openapi_extra=extra,
    )


def _endpoint(route: Route, body: Any) -> Callable[..., Any]:
    """Return a function with a route's parameters; FastAPI reads only its signature."""

    async def endpoint(**_given: Any) -> None: ...

    kinds: dict[str, Any] = dict.fromkeys(re.findall(r"{(\w+)}", route.path), str)
    if body is not None:
        kinds["request"] = Annotated[body, Body()]
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind) for name, kind in kinds.items()
    ]
    endpoint.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    endpoint.__name__ = "_".join([route.method.lower(), *filter(str.isalnum, route.path.replace("/", " ").split())])
    return endpoint


def _tag(path: str) -> str:
    if path.startswith("/v1/admin"):
        return "administration"
    return (
        "actions and policies" if path.startswith("/v1") else "Open Inference Protocol" if "/v2" in path else "health"
    )
