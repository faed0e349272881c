"""Open Inference Protocol v2: health, metadata, configuration and statistics of models, and the repository index.

Triton's tools (perf_analyzer, model_analyzer) ask for configuration and statistics before they infer. These documents
have the fields of Triton's messages ModelConfig and ModelStatistics. Fields without a counterpart here are left out,
durations that are not measured are 0. gRPC's messages have the same fields.

Specification: github.com/triton-inference-server/server, docs/protocol/extension_model_configuration.md and
extension_statistics.md; github.com/triton-inference-server/common, protobuf/model_config.proto.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import orjson
from pydantic import TypeAdapter
from typing_extensions import TypedDict

import rlservo
from rlservo.export.contract.bundle import ONNX_FILE
from rlservo.export.contract.contract import REWARD, TensorSpec
from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers, check_media_type, too_large
from rlservo.serve_app.protocols.json_text import parse_json
from rlservo.serve_app.protocols.oip_infer import (
    BINARY,
    LAST_ACTION,
    STATE_IN,
    STATE_OUT,
    offered_inputs,
    offered_outputs,
)
from rlservo.serve_app.protocols.oip_tensors import datatype_of
from rlservo.serve_app.protocols.request_fields import parse_fields, strict
from rlservo.serve_app.protocols.routes import GET, POST, Answer, Call, Route, of_policy
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL
from rlservo.serve_app.server.listing import states_of
from rlservo.serve_app.server.metrics import Totals
from rlservo.serve_app.server.request_handler import RequestHandler

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
BACKEND = "onnxruntime"
LARGEST_INT32 = 2**31 - 1
NOTHING = {"count": 0, "ns": 0}


@strict
class IndexFilter(TypedDict, total=False):
    """Body of a request for the repository index."""

    ready: bool | None


INDEX: TypeAdapter[IndexFilter] = TypeAdapter(IndexFilter)


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v2 besides inference."""

    def answer_of(method: Method) -> Answer:
        async def answer(call: Call) -> tuple[bytes, Headers]:
            found = method.document(handler, call.params.get("name", ""), call.params.get("version"))
            return orjson.dumps(found), JSON_HEADERS

        return answer

    async def index(call: Call) -> tuple[bytes, Headers]:
        check_media_type(call.headers, JSON, BINARY, optional=True)
        if len(call.body) > SMALL:
            raise too_large(SMALL)
        document, _ = parse_json(call.body or b"{}", such_as='{"ready": true}')
        ready = bool(parse_fields(INDEX, document).get("ready"))
        return orjson.dumps(repository_index(handler, ready=ready)), JSON_HEADERS

    stats = answer_of(METHODS["ModelStatistics"])
    found = [Route(GET, f"{MODELS}/stats", Access.act, "Statistics of every model", stats)]  # before that model's
    for each in METHODS.values():
        answer, suffix = answer_of(each), each.path.removeprefix(MODEL)
        if suffix == each.path:
            found.append(Route(GET, each.path, each.access, each.summary, answer))
        else:
            found += of_policy(GET, MODELS, suffix, each.summary, answer=answer)
    return [*found, Route(POST, "/v2/repository/index", Access.act, "All versions of all models", index)]


def server_ready(handler: RequestHandler, *_named: Any) -> dict[str, Any]:
    """Return that the policies are loaded. Raises UnavailableError."""
    return {"ready": bool(handler.store())}


def server_metadata(*_named: Any) -> dict[str, Any]:
    """Return the server's name, version and extensions."""
    return {"name": "rlservo", "version": rlservo.__version__, "extensions": EXTENSIONS}


def model_ready(handler: RequestHandler, name: str, version: str | None) -> dict[str, Any]:
    """Return that a model is loaded. Raises UnknownPolicyError, UnknownVersionError, UnavailableError."""
    return {"name": handler.store().get(name, version).contract.name, "ready": True}


def repository_index(handler: RequestHandler, *, ready: bool = False) -> list[dict[str, str]]:
    """Return every version of every model with its state; `ready` leaves the others out."""
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


def model_config(handler: RequestHandler, name: str, version: str | None) -> dict[str, Any]:
    """Return a model's configuration, as ModelConfig; `version` None is the default.

    Raises UnknownPolicyError, UnknownVersionError, UnavailableError.
    """
    policy = handler.store().get(name, version)
    config: dict[str, Any] = {
        "name": name,
        "platform": PLATFORM,
        "backend": BACKEND,
        "max_batch_size": min(handler.settings.max_batch, LARGEST_INT32),
        "input": [_input(tensor) for tensor in offered_inputs(policy)],
        "output": [_tensor(tensor) for tensor in offered_outputs(policy.contract)],
        "default_model_filename": ONNX_FILE,
        "model_transaction_policy": {"decoupled": False},  # a request has one reply
    }
    if policy.is_stateful:
        config["sequence_batching"] = _sequences(handler, policy)
    return config


def _input(tensor: TensorSpec) -> dict[str, Any]:
    described = _tensor(tensor)
    if tensor.name == REWARD or tensor.name.startswith((STATE_IN, LAST_ACTION)):
        described["optional"] = True  # absent at an episode's start
    return described


def _tensor(tensor: TensorSpec) -> dict[str, Any]:
    """Return a tensor in the form of Triton's configuration: without the batch axis."""
    return {"name": tensor.name, "data_type": f"TYPE_{datatype_of(tensor.dtype)}", "dims": list(tensor.shape[1:])}


def _sequences(handler: RequestHandler, policy: Policy) -> dict[str, Any]:
    return {
        "max_sequence_idle_microseconds": round(handler.settings.session_idle_s * 1e6),
        "state": [
            {
                "input_name": STATE_IN + state.name,
                "output_name": STATE_OUT + state.name,
                "data_type": f"TYPE_{datatype_of(state.dtype)}",
                "dims": list(state.shape),
            }
            for state in policy.contract.state
        ],
    }


def statistics(handler: RequestHandler, name: str = "", version: str | None = None) -> dict[str, Any]:
    """Return this replica's counts for each version since its start, as ModelStatistics.

    Without a `version`, all versions of the model; without a `name`, all models. All protocols count.
    Raises UnknownPolicyError, UnknownVersionError, UnavailableError, and RequestError for a version of no model.
    """
    if not name and version is not None:
        raise RequestError(f"the version '{version[:32]}' needs a model: also give its name")
    store = handler.store()
    if version is None:
        wanted = [(each, known) for each in ([name] if name else store.names) for known in store.versions(each)]
    else:
        wanted = [(name, store.get(name, version).contract.version)]
    return {"model_stats": [_statistics(handler.metrics.totals(*which), *which) for which in wanted]}


def _statistics(totals: Totals, name: str, version: str) -> dict[str, Any]:
    def duration(count: int, seconds: float) -> dict[str, int]:
        return {"count": count, "ns": round(seconds * 1e9)}

    return {
        "name": name,
        "version": version,
        "last_inference": totals.last_answer_ms,
        "inference_count": totals.observations,
        "execution_count": totals.requests,
        "inference_stats": {
            "success": duration(totals.requests, totals.request_s),
            "fail": duration(totals.failures, 0.0),  # their durations are not kept
            # A request is computed as soon as it is read, and `compute_infer` includes the checks of observation and
            # action, which have no time of their own. The counts are equal all the same: perf_analyzer aborts if they
            # differ.
            "queue": duration(totals.requests, 0.0),
            "compute_input": duration(totals.requests, 0.0),
            "compute_infer": duration(totals.requests, totals.inference_s),
            "compute_output": duration(totals.requests, 0.0),
            "cache_hit": NOTHING,
            "cache_miss": NOTHING,
        },
        "batch_stats": [],
    }


@dataclass(frozen=True)
class Method:
    """A method of the protocol without an action: a route over HTTP, and a call with the same reply over gRPC."""

    path: str
    summary: str
    document: Callable[[RequestHandler, str, str | None], dict[str, Any]]
    """Returns the reply for a model's name and version: '' and None if the request has none."""
    access: Access = Access.act
    field: str = ""
    """Field of gRPC's reply that holds the document."""


MODELS = "/v2/models"
MODEL = f"{MODELS}/{{name}}"
METHODS = {
    "ServerLive": Method("/v2/health/live", "The process is alive", lambda *_named: {"live": True}, Access.open),
    "ServerReady": Method("/v2/health/ready", "The policies are loaded and proven", server_ready, Access.open),
    "ServerMetadata": Method("/v2", "The server and its extensions", server_metadata),
    "ModelMetadata": Method(MODEL, "Metadata of a model", model_metadata),
    "ModelReady": Method(f"{MODEL}/ready", "The model is loaded and proven", model_ready),
    "ModelStatistics": Method(f"{MODEL}/stats", "Statistics of a model", statistics),
    "ModelConfig": Method(f"{MODEL}/config", "Configuration of a model", model_config, field="config"),
}
"""By gRPC's names."""
