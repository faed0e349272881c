"""Protobuf messages of the Open Inference Protocol.

Source of names and numbers: github.com/kserve/open-inference-protocol, open_inference_grpc.proto, and for streaming
and the repository index github.com/triton-inference-server/common, grpc_service.proto.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rlservo.protobuf_messages import build_messages
from rlservo.serve_app.protocols.open_inference.tensors import DTYPES

PACKAGE = "inference"
SERVICE = f"{PACKAGE}.GRPCInferenceService"

_TENSOR = ["string name", "string datatype", "repeated int64 shape"]
_VALUES = ["map InferParameter parameters", "InferTensorContents contents"]
_MESSAGES: dict[str, list[str]] = {
    "ServerLiveRequest": [],
    "ServerReadyRequest": [],
    "ServerMetadataRequest": [],
    "ServerLiveResponse": ["bool live"],
    "ServerReadyResponse": ["bool ready"],
    "ModelReadyRequest": ["string name", "string version"],
    "ModelReadyResponse": ["bool ready"],
    "ServerMetadataResponse": ["string name", "string version", "repeated string extensions"],
    "ModelMetadataRequest": ["string name", "string version"],
    "ModelMetadataResponse": [
        "string name",
        "repeated string versions",
        "string platform",
        "repeated ModelMetadataResponse.TensorMetadata inputs",
        "repeated ModelMetadataResponse.TensorMetadata outputs",
    ],
    "ModelMetadataResponse.TensorMetadata": _TENSOR,
    "InferParameter": [
        "oneof parameter_choice bool bool_param",
        "oneof parameter_choice int64 int64_param",
        "oneof parameter_choice string string_param",
        "oneof parameter_choice double double_param",
        "oneof parameter_choice uint64 uint64_param",
    ],
    "InferTensorContents": [
        "repeated bool bool_contents",
        "repeated int32 int_contents",
        "repeated int64 int64_contents",
        "repeated uint32 uint_contents",
        "repeated uint64 uint64_contents",
        "repeated float fp32_contents",
        "repeated double fp64_contents",
        "repeated bytes bytes_contents",
    ],
    "ModelInferRequest": [
        "string model_name",
        "string model_version",
        "string id",
        "map InferParameter parameters",
        "repeated ModelInferRequest.InferInputTensor inputs",
        "repeated ModelInferRequest.InferRequestedOutputTensor outputs",
        "repeated bytes raw_input_contents",
    ],
    "ModelInferRequest.InferInputTensor": [*_TENSOR, *_VALUES],
    "ModelInferRequest.InferRequestedOutputTensor": ["string name", "map InferParameter parameters"],
    "ModelInferResponse": [
        "string model_name",
        "string model_version",
        "string id",
        "map InferParameter parameters",
        "repeated ModelInferResponse.InferOutputTensor outputs",
        "repeated bytes raw_output_contents",
    ],
    "ModelInferResponse.InferOutputTensor": [*_TENSOR, *_VALUES],
    "ModelStreamInferResponse": ["string error_message", "ModelInferResponse infer_response"],
    "RepositoryIndexRequest": ["string repository_name", "bool ready"],
    "RepositoryIndexResponse": ["repeated RepositoryIndexResponse.ModelIndex models"],
    "RepositoryIndexResponse.ModelIndex": ["string name", "string version", "string state", "string reason"],
    # Triton's configuration and statistics, reduced to the fields filled here (`model_info.py`).
    "ModelConfigRequest": ["string name", "string version"],
    "ModelConfigResponse": ["ModelConfig config"],
    "ModelConfig": [
        "string name = 1",
        "string platform = 2",
        "int32 max_batch_size = 4",
        "repeated ModelConfig.Input input = 5",
        "repeated ModelConfig.Output output = 6",
        "string default_model_filename = 8",
        "ModelConfig.SequenceBatching sequence_batching = 13",
        "string backend = 17",
        "ModelConfig.TransactionPolicy model_transaction_policy = 19",
    ],
    "ModelConfig.Input": ["string name = 1", "DataType data_type = 2", "repeated int64 dims = 4", "bool optional = 8"],
    "ModelConfig.Output": ["string name = 1", "DataType data_type = 2", "repeated int64 dims = 3"],
    "ModelConfig.SequenceBatching": [
        "uint64 max_sequence_idle_microseconds = 1",
        "repeated ModelConfig.State state = 5",
    ],
    "ModelConfig.State": ["string input_name", "string output_name", "DataType data_type", "repeated int64 dims"],
    "ModelConfig.TransactionPolicy": ["bool decoupled"],
    "ModelStatisticsRequest": ["string name", "string version"],
    "ModelStatisticsResponse": ["repeated ModelStatistics model_stats"],
    "ModelStatistics": [
        "string name",
        "string version",
        "uint64 last_inference",
        "uint64 inference_count",
        "uint64 execution_count",
        "InferStatistics inference_stats",
        "repeated InferBatchStatistics batch_stats",
    ],
    "InferStatistics": [
        "StatisticDuration success",
        "StatisticDuration fail",
        "StatisticDuration queue",
        "StatisticDuration compute_input",
        "StatisticDuration compute_infer",
        "StatisticDuration compute_output",
        "StatisticDuration cache_hit",
        "StatisticDuration cache_miss",
    ],
    "InferBatchStatistics": ["uint64 batch_size"],
    "StatisticDuration": ["uint64 count", "uint64 ns"],
}

UNARY = tuple(name.removesuffix("Request") for name in _MESSAGES if name.endswith("Request"))
STREAM = "ModelStreamInfer"

_DATATYPES = {"DataType": [f"TYPE_{name}" for name in ("INVALID", *DTYPES)]}
messages: Any = SimpleNamespace(**build_messages(PACKAGE, _MESSAGES, enums=_DATATYPES))
"""The classes by name; made at run time, they have no static type. A nested class is an attribute of its outer one."""
