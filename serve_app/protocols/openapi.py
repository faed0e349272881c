"""OpenAPI document of the routing table, written by FastAPI, and the messages that it describes.

FastAPI is imported when a client requests the document: it takes a third of a server's start. Requests are answered by
the table itself and parsed by hand, in a microsecond where a pydantic model takes ten, with errors that name the
mistake in the client's code.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Annotated, Any

import orjson
from fastapi import Body, FastAPI
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field

import rlservo
from rlservo.export.contract.contract import Contract
from rlservo.serve_app.episodes.request import LONGEST_SESSION_ID, MAX_SEED
from rlservo.serve_app.protocols.oip_tensors import DTYPES
from rlservo.serve_app.protocols.routes import WEBSOCKET, Route, RoutingTable
from rlservo.serve_app.versions.plan_commands import COMMANDS, Changed
from rlservo.serve_app.versions.serving_plan import Canary
from rlservo.serve_app.wire.request_names import LONGEST_STATUS

DESCRIPTION = "Actions from exported policies. Every error has a sentence, a code and, where useful, details."
ANY_ROUTE = (400, 401, 403, 408, 413, 429)  # its path, key, host, page, body and rate
OF_POLICY = (404, 503)
OF_COMMAND = (*OF_POLICY, 409, 415)
OF_ACTION = (*OF_COMMAND, 410, 422, 500)
OBS = (
    "One observation or a batch (distinguished by shape): nested lists in the observation space's shape or, if the "
    "contract names the elements, a map from each name to a number (a batch: to a list of numbers). Dict spaces are "
    "maps, Tuple spaces are lists of their parts."
)


class ActRequest(BaseModel):
    """Request an action."""

    model_config = ConfigDict(extra="forbid")

    obs: Any = Field(description=OBS)
    explore: bool = Field(False, description="Sample the policy's action distribution instead of taking its mode.")
    seed: int | None = Field(None, ge=0, le=MAX_SEED, description="Makes an exploring action repeatable.")
    seq: int | None = Field(None, description="Echoed in the reply, so that a late reply is recognised.")
    deadline_ms: float | None = Field(
        None, description="Milliseconds left when the server receives the request. A late action is not computed."
    )
    timestamp: float | None = Field(
        None, description="Your clock [s], echoed together with the server's times of receipt and reply."
    )
    state: dict[str, Any] | None = Field(
        None, description="A recurrent policy's memory: {} begins an episode; then the last reply's `state`, unchanged."
    )
    session_id: str | None = Field(
        None, min_length=1, max_length=LONGEST_SESSION_ID,
        description="An id of your choice for requests that belong together; the policy's memory is kept under it.",
    )  # fmt: skip
    reset: bool = Field(False, description="Begin an episode: the first request of a recurrent policy's session.")
    end: bool = Field(False, description="Forget the session after this request.")
    reward: Any = Field(None, description="Reward of the last action: for policies that see it, and for recordings.")
    last_action: Any = Field(
        None, description="The robot's last command: needed if the action's step is limited, and for recordings."
    )
    final_status: str | None = Field(
        None, min_length=1, max_length=LONGEST_STATUS,
        description="How the episode ended: `obs` is the observation after the last action; the reply's is unused.",
    )  # fmt: skip
    truncated: bool = Field(False, description="With `final_status`: the episode was cut off, as by a time limit.")


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


class Tensor(BaseModel):
    """A tensor, in JSON or (with the parameter `binary_data_size`) as bytes after the JSON."""

    name: str
    shape: list[int]
    datatype: str = Field(description="One of " + ", ".join(DTYPES))
    parameters: dict[str, Any] | None = None
    data: list[Any] | None = Field(None, description="Nested or flat, in row-major order.")


class InferRequest(BaseModel):
    """Request a batch of actions."""

    model_config = ConfigDict(extra="forbid")

    id: str | None = Field(None, description="Echoed.")
    parameters: dict[str, Any] | None = Field(
        None,
        description="`explore`, `seed`, `seq`, `deadline_ms`, `timestamp`, `sequence_id`, `sequence_start`, "
        "`sequence_end`, `state_policy` (from the reply that had the states), `binary_data_output`.",
    )
    model_name: str | None = Field(None, description="Same name as in the path; optional.")
    inputs: list[Tensor]
    outputs: list[dict[str, Any]] | None = Field(
        None, description='`[{"name": "action", "parameters": {"binary_data": true}}]` for bytes after the JSON.'
    )


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
    """A version whose actions are computed only for comparison, with its counts in the answering process."""

    version: str
    compared: int
    mean_difference: float | None
    largest_difference: float | None
    failed: int
    left_out: int


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
