"""Model configuration and statistics, which Triton's tools ask for before they infer (perf_analyzer, model_analyzer).

The documents have the fields of Triton's messages ModelConfig and ModelStatistics, over HTTP as JSON. A field of theirs
that nothing here corresponds to is left out, a duration that is not measured is 0.

Specification: github.com/triton-inference-server/server, docs/protocol/extension_model_configuration.md and
extension_statistics.md; github.com/triton-inference-server/common, protobuf/model_config.proto.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from fastapi import FastAPI
from fastapi.responses import Response

from rlservo.export.contract.bundle import ONNX_FILE
from rlservo.export.contract.contract import REWARD, TensorSpec
from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.protocols import oip_infer, oip_models
from rlservo.serve_app.protocols.fastapi_routes import add_route
from rlservo.serve_app.protocols.oip_tensors import datatype_of
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.metrics import Totals
from rlservo.serve_app.server.request_handler import RequestHandler

BACKEND = "onnxruntime"
LARGEST_INT32 = 2**31 - 1
NOTHING = {"count": 0, "ns": 0}


def model_config(handler: RequestHandler, name: str, version: str | None) -> dict[str, Any]:
    """Return how a model is run, as ModelConfig; `version` None is the default.

    Raises UnknownPolicyError, UnknownVersionError, UnavailableError.
    """
    policy = handler.store().get(name, version)
    config: dict[str, Any] = {
        "name": name,
        "platform": oip_models.PLATFORM,
        "backend": BACKEND,
        "max_batch_size": min(handler.settings.max_batch, LARGEST_INT32),
        "input": [_input(tensor) for tensor in oip_infer.offered_inputs(policy)],
        "output": [_tensor(tensor) for tensor in oip_infer.offered_outputs(policy.contract)],
        "default_model_filename": ONNX_FILE,
        "model_transaction_policy": {"decoupled": False},  # a request has one reply
    }
    if handler.store().batcher_of(policy) is not None:
        # So many are run at once as soon as they are there, without waiting for others.
        most = policy.options.micro_batch
        config["dynamic_batching"] = {"preferred_batch_size": [most], "max_queue_delay_microseconds": 0}
    elif policy.is_stateful:
        config["sequence_batching"] = _sequences(handler, policy)
    return config


def _input(tensor: TensorSpec) -> dict[str, Any]:
    described = _tensor(tensor)
    if tensor.name == REWARD or tensor.name.startswith((oip_infer.STATE_IN, oip_infer.LAST_ACTION)):
        described["optional"] = True  # an episode begins without
    return described


def _tensor(tensor: TensorSpec) -> dict[str, Any]:
    """Return a tensor as Triton's configuration has it: without the axis of the batch."""
    return {"name": tensor.name, "data_type": f"TYPE_{datatype_of(tensor.dtype)}", "dims": list(tensor.shape[1:])}


def _sequences(handler: RequestHandler, policy: Policy) -> dict[str, Any]:
    return {
        "max_sequence_idle_microseconds": round(handler.settings.session_idle_s * 1e6),
        "state": [
            {
                "input_name": oip_infer.STATE_IN + state.name,
                "output_name": oip_infer.STATE_OUT + state.name,
                "data_type": f"TYPE_{datatype_of(state.dtype)}",
                "dims": list(state.shape),
            }
            for state in policy.contract.state
        ],
    }


def statistics(handler: RequestHandler, name: str | None = None, version: str | None = None) -> list[dict[str, Any]]:
    """Return what this replica has counted of each version since its start, as ModelStatistics.

    Without a `version` of every version of the model, without a `name` of every model. All protocols count.
    Raises UnknownPolicyError, UnknownVersionError, UnavailableError, and RequestError for a version of no model.
    """
    if name is None and version is not None:
        raise RequestError(f"the version '{version[:32]}' is of no model: name one")
    store = handler.store()
    if name is None:
        wanted = [(each, known) for each in store.names for known in store.versions(each)]
    elif version is None:
        wanted = [(name, known) for known in store.versions(name)]
    else:
        wanted = [(name, store.get(name, version).contract.version)]
    return [_statistics(handler.metrics.totals(*which), *which) for which in wanted]


def _statistics(totals: Totals, name: str, version: str) -> dict[str, Any]:
    def duration(count: int, seconds: float) -> dict[str, int]:
        return {"count": count, "ns": round(seconds * 1e9)}

    return {
        "name": name,
        "version": version,
        "last_inference": totals.last_answer_ms,
        "inference_count": totals.observations,
        "execution_count": totals.runs,
        "inference_stats": {
            "success": duration(totals.requests, totals.request_s),
            "fail": duration(totals.failures, 0.0),  # how long they took is not kept
            # What has been read is computed at once, and checking observation and action is in `compute_infer`: no time
            # apart. The counts are equal all the same, perf_analyzer ends where they are not.
            "queue": duration(totals.requests, 0.0),
            "compute_input": duration(totals.requests, 0.0),
            "compute_infer": duration(totals.requests, totals.inference_s),
            "compute_output": duration(totals.requests, 0.0),
            "cache_hit": NOTHING,
            "cache_miss": NOTHING,
        },
        "batch_stats": [],
    }


def add_routes(app: FastAPI, handler: RequestHandler) -> None:
    """Add both to the application: before /v2/models/{name}, which would take /v2/models/stats for a model."""
    get = partial(add_route, app, Access.act, "GET")
    model, one_version = oip_models.MODEL, oip_models.VERSION

    def statistics_reply(name: str | None = None, version: str | None = None) -> Response:
        return oip_models.json_response({"model_stats": statistics(handler, name, version)})

    @get("/v2/models/stats", oip_models.TAG, "Statistics of every model", 503)
    async def all_statistics() -> Response:
        return statistics_reply()

    @get(f"{model}/stats", oip_models.TAG, "Statistics of a model's versions", 404, 503)
    async def model_statistics(name: str) -> Response:
        return statistics_reply(name)

    @get(f"{one_version}/stats", oip_models.TAG, "A version's statistics", 404, 503)
    async def version_statistics(name: str, version: str) -> Response:
        return statistics_reply(name, version)

    @get(f"{model}/config", oip_models.TAG, "How a model is run", 404, 503)
    async def config(name: str) -> Response:
        return oip_models.json_response(model_config(handler, name, None))

    @get(f"{one_version}/config", oip_models.TAG, "How a version is run", 404, 503)
    async def version_config(name: str, version: str) -> Response:
        return oip_models.json_response(model_config(handler, name, version))
