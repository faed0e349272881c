"""OpenAPI document of the routing table, written by FastAPI, and the replies that it describes.

FastAPI is imported when a client requests the document: it takes a third of a server's start. The requests it shows are
those that pydantic checks (`request_fields.py`, `open_inference/infer.py`).
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any

import orjson
from fastapi import Body, FastAPI
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, Field, create_model

import rlservo
from rlservo.bundle.contract import Contract
from rlservo.serve_app.protocols.open_inference.infer import InferRequest, Tensor
from rlservo.serve_app.protocols.open_inference.model_info import METHODS
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.protocols.request_fields import ActRequest
from rlservo.serve_app.protocols.routing import POST, WEBSOCKET, Route, RoutingTable
from rlservo.serve_app.versions.deployment_plan import Canary
from rlservo.serve_app.versions.plan_commands import COMMANDS, Changed

DESCRIPTION = "Actions from exported policies. Every error has a sentence, a code and, where useful, details."
ERRORS = (400, 401, 403, 408, 413, 429, 503)  # of any route: its path, key, host, page, body and rate; or it loads
OF_NAME = (404, 422)
OF_POST = (404, 409, 410, 415, 422, 500)


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
    received_at: float | None = Field(None, description="The server's clock [s since 1970] when the request arrived.")
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


class PlanChange(BaseModel):
    """One change of the plan."""

    generation: int
    changed_at: str
    changed_by: str


class PolicyList(BaseModel):
    """Policies served by one process."""

    policies: list[PolicySummary]
    replica: str = Field(description="The answering process; counts and states are its own.")
    generation: int = Field(description="Number of the plan; equal numbers mean equal policies.")
    changed_at: str | None
    changed_by: str | None
    recent: list[PlanChange] = Field(description="Last changes of the plan, the newest first.")
    behind: list[str] = Field(description="Parts of the plan that this process could not follow; usually empty.")
    not_loaded: dict[str, list[str]] = Field(description="The repository's versions that the plan does not load.")


def _type_of(field: Any) -> Any:
    """Return the type that a field of a protobuf message has in JSON."""
    scalars = {field.CPPTYPE_STRING: str, field.CPPTYPE_ENUM: str, field.CPPTYPE_BOOL: bool}
    kind: Any = scalars.get(field.cpp_type, int) if field.message_type is None else _reply_as(field.message_type)
    return list[kind] if isinstance(field.default_value, list) else kind


@cache
def _reply_as(message: Any) -> Any:
    fields: dict[str, Any] = {field.name: (_type_of(field) | None, None) for field in message.fields}
    return create_model(message.name, **fields)


def _reply_of(method: str, part: str) -> Any:
    """Return the reply over HTTP of a method of gRPC: its message, or that part of it."""
    message = getattr(messages, f"{method}Response").DESCRIPTOR
    return _type_of(message.fields_by_name[part]) if part else _reply_as(message)


# By method and path without its version: body and reply.
DESCRIBED: dict[tuple[str, str], tuple[Any, Any]] = {
    ("POST", "/v1/policies/{name}/act"): (ActRequest, ActReply),
    ("POST", "/v2/models/{name}/infer"): (InferRequest, InferReply),
    ("GET", "/v1/policies"): (None, PolicyList),
    ("GET", "/v1/policies/{name}"): (None, Contract),
    **{("POST", f"/v1/admin/policies/{{name}}/{name}"): (kind, Changed) for name, kind in COMMANDS.items()},
    **{(method.verb, method.path): (None, _reply_of(name, method.field)) for name, method in METHODS.items()},
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
    body, reply = DESCRIBED.get((route.method, policy), (None, Any))
    extra: dict[str, Any] = {}
    if body is InferRequest:
        extra = {"requestBody": {"content": BINARY}}
    elif policy.startswith("/v2/repository/"):
        extra = {"requestBody": {"required": False, "content": {"application/json": {"schema": {"type": "object"}}}}}
    statuses = (*ERRORS, *(OF_NAME if "{" in policy else ()), *(OF_POST if route.method == POST else ()))
    version = " (one version, or what an alias leads to)" if policy != route.path else ""
    app.add_api_route(
        route.path,
        _endpoint(route, body),
        methods=[route.method],
        summary=route.summary + version,
        tags=[_tag(policy)],
        response_model=None if policy in TEXTS else reply,
        response_class=PlainTextResponse if policy in TEXTS else JSONResponse,
        responses={status: {"model": ErrorReply} for status in sorted({*statuses})},
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
