"""Open Inference Protocol v2: health, metadata, configuration and statistics of models, and the repository index.

Triton's tools (perf_analyzer, model_analyzer) ask for configuration and statistics before they infer. These documents
have the fields of Triton's messages ModelConfig and ModelStatistics. Fields without a counterpart here are left out,
durations that are not measured are 0. gRPC's messages have the same fields.

Specification: github.com/triton-inference-server/server, docs/protocol/extension_model_configuration.md and
extension_statistics.md; github.com/triton-inference-server/common, protobuf/model_config.proto.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import orjson
from pydantic import TypeAdapter
from typing_extensions import TypedDict

import rlservo
from rlservo.bundle.bundle import ONNX_FILE
from rlservo.bundle.contract import TensorSpec
from rlservo.errors import RequestError
from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, Headers, too_large
from rlservo.serve_app.protocols.http_endpoint import OCTETS, check_media_type
from rlservo.serve_app.protocols.open_inference.infer import STATE_IN, STATE_OUT, is_optional, model_of
from rlservo.serve_app.protocols.open_inference.tensors import datatype_of
from rlservo.serve_app.protocols.request_fields import parse_fields, parse_json, strict
from rlservo.serve_app.protocols.routing import GET, POST, Answer, Call, Route, of_policy
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL
from rlservo.serve_app.server.metrics import IDLE, Metrics, sum_of
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


@strict
class IndexFilter(TypedDict, total=False):
    """Body of a request for the repository index."""

    ready: bool | None


INDEX: TypeAdapter[IndexFilter] = TypeAdapter(IndexFilter)


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v2 besides inference."""

    def answer_of(method: Method) -> Answer:
        async def answer(call: Call) -> tuple[bytes, Headers]:
            given: Mapping[str, Any] = call.params
            if method.verb == POST:
                check_media_type(call.headers, OCTETS, optional=True)
                if len(call.body) > SMALL:
                    raise too_large(SMALL)
                given = parse_fields(INDEX, parse_json(call.body or b"{}", such_as='{"ready": true}')[0])
            return orjson.dumps(method.document(handler, **given)), JSON_HEADERS

        return answer

    stats = answer_of(METHODS["ModelStatistics"])
    found = [Route(GET, f"{MODELS}/stats", Access.act, "Statistics of every model", stats)]  # before that model's
    for each in METHODS.values():
        if each.path.startswith(MODEL):
            found += of_policy(GET, MODELS, each.path.removeprefix(MODEL), each.summary, answer_of(each))
        else:
            found.append(Route(each.verb, each.path, each.access, each.summary, answer_of(each)))
    return found


def server_ready(handler: RequestHandler) -> dict[str, Any]:
    """Return that the policies are loaded. Raises UnavailableError."""
    return {"ready": bool(handler.store())}


def server_metadata(_handler: RequestHandler) -> dict[str, Any]:
    """Return the server's name, version and extensions."""
    return {"name": "rlservo", "version": rlservo.__version__, "extensions": EXTENSIONS}


def model_ready(handler: RequestHandler, name: str = "", version: str | None = None) -> dict[str, Any]:
    """Return that a model is loaded. Raises UnknownPolicyError, UnknownVersionError, UnavailableError."""
    return {"name": handler.store().get(name, version).contract.name, "ready": True}


def repository_index(handler: RequestHandler, *, ready: bool | None = False, **_name: str) -> list[dict[str, str]]:
    """Return every version of every model with its state; `ready` leaves the others out."""
    handler.store()
    return [
        {"name": name, "version": version, "state": STATES[state.state], "reason": state.reason}
        for name, versions in handler.control.states().items()
        for version, state in versions.items()
        if state.state == "ready" or not ready
    ]


def model_metadata(handler: RequestHandler, name: str = "", version: str | None = None) -> dict[str, Any]:
    """Return a model's inputs and outputs; `version` None is the default."""
    model = model_of(handler.store().get(name, version))

    def described(tensors: Mapping[str, TensorSpec]) -> list[dict[str, Any]]:
        return [
            {"name": name, "datatype": datatype_of(tensor.dtype), "shape": tensor.shape}
            for name, tensor in tensors.items()
        ]

    return {
        "name": name,
        "versions": handler.store().versions(name) if version is None else (model.contract.version,),
        "platform": PLATFORM,
        "inputs": described(model.offered),
        "outputs": described(model.outputs),
    }


def model_config(handler: RequestHandler, name: str = "", version: str | None = None) -> dict[str, Any]:
    """Return a model's configuration, as ModelConfig; `version` None is the default.

    Raises UnknownPolicyError, UnknownVersionError, UnavailableError.
    """
    policy = handler.store().get(name, version)
    model = model_of(policy)
    config: dict[str, Any] = {
        "name": name,
        "platform": PLATFORM,
        "backend": BACKEND,
        "max_batch_size": min(handler.settings.max_batch, LARGEST_INT32),
        "input": [
            _tensor(name, tensor) | ({"optional": True} if is_optional(name) else {})
            for name, tensor in model.offered.items()
        ],
        "output": [_tensor(name, tensor) for name, tensor in model.outputs.items()],
        "default_model_filename": ONNX_FILE,
        "model_transaction_policy": {"decoupled": False},  # a request has one reply
    }
    if policy.is_stateful:
        config["sequence_batching"] = {
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
    return config


def _tensor(name: str, tensor: TensorSpec) -> dict[str, Any]:
    """Return a tensor in the form of Triton's configuration: without the batch axis."""
    return {"name": name, "data_type": f"TYPE_{datatype_of(tensor.dtype)}", "dims": list(tensor.shape[1:])}


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
    return {"model_stats": [_statistics(handler.metrics, *which) for which in wanted]}


def _statistics(metrics: Metrics, name: str, version: str) -> dict[str, Any]:
    found = metrics.answers_of(name, version)
    count = sum(each.count for each in found)
    asked = {key: n for key, n in metrics.failures.items() if key[:2] == (name, version) and key[3] != IDLE}
    # A request is computed as soon as it is read, and `compute_infer` includes the checks of observation and action,
    # which have no time of their own. The counts are equal all the same: perf_analyzer aborts if they differ.
    seconds = {
        "success": sum(sum_of(each.latency) for each in found),
        "compute_infer": sum(sum_of(each.inference) for each in found),
    }
    seconds |= dict.fromkeys(("queue", "compute_input", "compute_output"), 0.0)
    none = {"count": 0, "ns": 0}
    return {
        "name": name,
        "version": version,
        "last_inference": round(1e3 * max((each.last_s for each in found), default=0.0)),
        "inference_count": sum(each.observations for each in found),
        "execution_count": count,
        "inference_stats": {
            **{part: {"count": count, "ns": round(taken * 1e9)} for part, taken in seconds.items()},
            "fail": {"count": sum(asked.values()), "ns": 0},  # their durations are not kept
            "cache_hit": none,
            "cache_miss": none,
        },
        "batch_stats": [],
    }


@dataclass(frozen=True)
class Method:
    """A method of the protocol without an action: a route over HTTP, and a call with the same reply over gRPC."""

    path: str
    summary: str
    document: Callable[..., Any]
    """Returns the reply for the request's fields, by name: those of gRPC's message."""
    access: Access = Access.act
    field: str = ""
    """Field of gRPC's reply that holds the document."""
    verb: str = GET


MODELS = "/v2/models"
MODEL = f"{MODELS}/{{name}}"
METHODS = {
    "ServerLive": Method("/v2/health/live", "The process is alive", lambda _handler: {"live": True}, Access.open),
    "ServerReady": Method("/v2/health/ready", "The policies are loaded and proven", server_ready, Access.open),
    "ServerMetadata": Method("/v2", "The server and its extensions", server_metadata),
    "ModelMetadata": Method(MODEL, "Metadata of a model", model_metadata),
    "ModelReady": Method(f"{MODEL}/ready", "The model is loaded and proven", model_ready),
    "ModelStatistics": Method(f"{MODEL}/stats", "Statistics of a model", statistics),
    "ModelConfig": Method(f"{MODEL}/config", "Configuration of a model", model_config, field="config"),
    "RepositoryIndex": Method(
        "/v2/repository/index", "All versions of all models", repository_index, field="models", verb=POST
    ),
}
"""By gRPC's names."""
