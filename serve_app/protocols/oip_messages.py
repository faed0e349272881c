"""Protobuf messages of the Open Inference Protocol, built at import: no generated code.

Generated code is tied to the protobuf it was made with, and would claim the names `inference.*` in the process-wide
descriptor pool, where KServe's and Triton's own packages register theirs. These live in a pool of their own.

Source of names and numbers: github.com/kserve/open-inference-protocol, open_inference_grpc.proto, and for streaming
and the repository index github.com/triton-inference-server/common, grpc_service.proto.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PACKAGE = "inference"
SERVICE = f"{PACKAGE}.GRPCInferenceService"

_Field = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "bool": _Field.TYPE_BOOL,
    "int32": _Field.TYPE_INT32,
    "int64": _Field.TYPE_INT64,
    "uint32": _Field.TYPE_UINT32,
    "uint64": _Field.TYPE_UINT64,
    "float": _Field.TYPE_FLOAT,
    "double": _Field.TYPE_DOUBLE,
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
}
_TENSOR = ["string name", "string datatype", "repeated int64 shape"]
_VALUES = ["map InferParameter parameters", "InferTensorContents contents"]
# message -> its fields in the order of their numbers, or with a number of their own (`= 17`); `oneof` fields share the
# one oneof of their message, and `map` is from string. A nested message is written Outer.Inner, after its outer one.
_MESSAGES: dict[str, list[str]] = {
    "ServerLiveRequest": [],
    "ServerLiveResponse": ["bool live"],
    "ServerReadyRequest": [],
    "ServerReadyResponse": ["bool ready"],
    "ModelReadyRequest": ["string name", "string version"],
    "ModelReadyResponse": ["bool ready"],
    "ServerMetadataRequest": [],
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
        "oneof bool bool_param",
        "oneof int64 int64_param",
        "oneof string string_param",
        "oneof double double_param",
        "oneof uint64 uint64_param",
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
    # Of Triton's configuration and statistics only what is told here (`oip_config.py`). On the wire an enumeration is
    # an int32: DATA_TYPES has its names.
    "ModelConfigRequest": ["string name", "string version"],
    "ModelConfigResponse": ["ModelConfig config"],
    "ModelConfig": [
        "string name = 1",
        "string platform = 2",
        "int32 max_batch_size = 4",
        "repeated ModelConfig.Input input = 5",
        "repeated ModelConfig.Output output = 6",
        "string default_model_filename = 8",
        "ModelConfig.DynamicBatching dynamic_batching = 11",
        "ModelConfig.SequenceBatching sequence_batching = 13",
        "string backend = 17",
        "ModelConfig.TransactionPolicy model_transaction_policy = 19",
    ],
    "ModelConfig.Input": ["string name = 1", "int32 data_type = 2", "repeated int64 dims = 4", "bool optional = 8"],
    "ModelConfig.Output": ["string name = 1", "int32 data_type = 2", "repeated int64 dims = 3"],
    "ModelConfig.DynamicBatching": ["repeated int32 preferred_batch_size", "uint64 max_queue_delay_microseconds"],
    "ModelConfig.SequenceBatching": [
        "uint64 max_sequence_idle_microseconds = 1",
        "repeated ModelConfig.State state = 5",
    ],
    "ModelConfig.State": ["string input_name", "string output_name", "int32 data_type", "repeated int64 dims"],
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
_DATA_TYPES = "INVALID BOOL UINT8 UINT16 UINT32 UINT64 INT8 INT16 INT32 INT64 FP16 FP32 FP64"
DATA_TYPES = {f"TYPE_{name}": number for number, name in enumerate(_DATA_TYPES.split())}
"""Triton's numbers of the data types in a ModelConfig."""


def _file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name="rlservo_open_inference.proto", package=PACKAGE, syntax="proto3")
    made: dict[str, Any] = {}
    for name, fields in _MESSAGES.items():
        outer, _, inner = name.rpartition(".")
        message = made[outer].nested_type.add(name=inner) if outer else file.message_type.add(name=inner)
        made[name] = message
        for position, declaration in enumerate(fields, start=1):
            field, _, number = declaration.partition(" = ")
            _add_field(message, f".{PACKAGE}.{name}", int(number or position), field)
    return file


def _add_field(message: Any, path: str, number: int, declaration: str) -> None:
    kind, name = declaration.rsplit(" ", 1)
    modifier, _, kind = kind.rpartition(" ")
    field = message.field.add(name=name, number=number, label=_Field.LABEL_OPTIONAL)
    if modifier == "map":  # on the wire a repeated message of key and value
        entry = message.nested_type.add(name=f"{name.capitalize()}Entry")
        entry.options.map_entry = True
        _add_field(entry, path, 1, "string key")
        _add_field(entry, path, 2, f"{kind} value")
        field.label, field.type, field.type_name = _Field.LABEL_REPEATED, _Field.TYPE_MESSAGE, f"{path}.{entry.name}"
        return
    if modifier == "repeated":
        field.label = _Field.LABEL_REPEATED
    elif modifier == "oneof":
        if not message.oneof_decl:
            message.oneof_decl.add(name="parameter_choice")
        field.oneof_index = 0
    if kind in _TYPES:
        field.type = _TYPES[kind]
    else:
        field.type, field.type_name = _Field.TYPE_MESSAGE, f".{PACKAGE}.{kind}"


_pool = descriptor_pool.DescriptorPool()
_pool.AddSerializedFile(_file().SerializeToString())


def _message(name: str) -> Any:
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))


# Classes made at run time have no static type: Any is all a type checker can be told.
ServerLiveResponse: Any = _message("ServerLiveResponse")
ServerReadyResponse: Any = _message("ServerReadyResponse")
ServerMetadataResponse: Any = _message("ServerMetadataResponse")
ModelReadyRequest: Any = _message("ModelReadyRequest")
ModelReadyResponse: Any = _message("ModelReadyResponse")
ModelMetadataRequest: Any = _message("ModelMetadataRequest")
ModelMetadataResponse: Any = _message("ModelMetadataResponse")
ModelConfigRequest: Any = _message("ModelConfigRequest")
ModelConfigResponse: Any = _message("ModelConfigResponse")
ModelStatisticsRequest: Any = _message("ModelStatisticsRequest")
ModelStatisticsResponse: Any = _message("ModelStatisticsResponse")
ModelInferRequest: Any = _message("ModelInferRequest")
ModelInferResponse: Any = _message("ModelInferResponse")
ModelStreamInferResponse: Any = _message("ModelStreamInferResponse")
RepositoryIndexRequest: Any = _message("RepositoryIndexRequest")
RepositoryIndexResponse: Any = _message("RepositoryIndexResponse")
