"""Open Inference Protocol over gRPC: the methods of `GRPCInferenceService`, called by an engine's gRPC server.

The same policies, options and errors as over HTTP (`oip_infer.py`); an error's HTTP status becomes a gRPC status, its
code goes into the trailing metadata. The messages are in `oip_messages.py`; a reply's tensors are raw or typed as the
request's were.
"""

from __future__ import annotations

import asyncio
import functools
import ipaddress
import logging
import math
import secrets
import time
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any
from urllib.parse import unquote

import grpc
import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from rlservo.export.contract.errors import (
    ActionError,
    DeadlineError,
    ForbiddenError,
    InternalError,
    ObservationError,
    RateLimitError,
    RequestError,
    RlservoError,
    TooLargeError,
    UnavailableError,
)
from rlservo.serve_app.episodes.request import Request
from rlservo.serve_app.protocols import oip_infer, oip_models
from rlservo.serve_app.protocols.http_errors import retry_after_s, status_of
from rlservo.serve_app.protocols.oip_messages import DATA_TYPES, messages
from rlservo.serve_app.protocols.oip_tensors import DTYPES, check_form, check_size, datatype_of, from_bytes
from rlservo.serve_app.runtime.input_numbers import parse_array
from rlservo.serve_app.server.access_checks import StreamKey, authorize, presented_key
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL, SPARE, check_length
from rlservo.serve_app.server.request_handler import BUG, RequestHandler
from rlservo.serve_app.versions.policy_store import Decision
from rlservo.serve_app.wire.request_names import LABEL_HEADER

Incoming = tuple[bytes, float | None]
"""A request's bytes, and the seconds for which its caller still waits (None: indefinitely)."""

logger = logging.getLogger(__name__)

PROTOCOL = "grpc"
REQUEST_ID = "x-request-id"
CODES = {
    400: grpc.StatusCode.INVALID_ARGUMENT,
    401: grpc.StatusCode.UNAUTHENTICATED,
    403: grpc.StatusCode.PERMISSION_DENIED,
    404: grpc.StatusCode.NOT_FOUND,
    408: grpc.StatusCode.DEADLINE_EXCEEDED,
    409: grpc.StatusCode.FAILED_PRECONDITION,
    410: grpc.StatusCode.FAILED_PRECONDITION,
    413: grpc.StatusCode.RESOURCE_EXHAUSTED,  # gRPC's own status for a message beyond its limit
    415: grpc.StatusCode.INVALID_ARGUMENT,
    422: grpc.StatusCode.INVALID_ARGUMENT,
    429: grpc.StatusCode.RESOURCE_EXHAUSTED,
    503: grpc.StatusCode.UNAVAILABLE,
}
OPEN = frozenset({"ServerLive", "ServerReady"})  # probed by orchestrators; every other method needs a key's role `act`
# The field of InferTensorContents that holds a datatype; FP16 has none and is sent raw.
FIELDS = {
    "BOOL": "bool_contents",
    **dict.fromkeys(("INT8", "INT16", "INT32"), "int_contents"),
    "INT64": "int64_contents",
    **dict.fromkeys(("UINT8", "UINT16", "UINT32"), "uint_contents"),
    "UINT64": "uint64_contents",
    "FP32": "fp32_contents",
    "FP64": "fp64_contents",
}
FIELD_DTYPES = {
    "bool_contents": "?",
    "int_contents": "i4",
    "int64_contents": "i8",
    "uint_contents": "u4",
    "uint64_contents": "u8",
    "fp32_contents": "f4",
    "fp64_contents": "f8",
}


class Grpc:
    """Answers gRPC calls with the handler."""

    def __init__(self, handler: RequestHandler, *, local_only: bool = False) -> None:
        """Take the handler. `local_only`: Serve binds its gRPC ports to every interface, whatever its host option."""
        self._handler = handler
        self._codec = OipGrpcCodec(handler)
        self._local_only = local_only

    async def answer(self, method: str, incoming: Incoming, context: Any) -> Any:
        """Return the reply to one call. An error sets the status, and the empty reply is ignored."""
        try:
            request = self._begin(method, context)
            if request.request_id is not None:
                context.set_trailing_metadata([(REQUEST_ID, request.request_id)])
            if method == "ModelInfer":
                return await self._handler.answer(self._codec, request, incoming)
            return METHODS[method](self._handler, incoming)
        except Exception as error:
            _fail(context, error)
            return messages.ServerLiveResponse()

    async def stream(self, requests: AsyncIterator[bytes], context: Any) -> AsyncIterator[Any]:
        """Yield a reply to each request of a stream; an error is also a reply, and the stream continues.

        A stream that is silent for `stream_idle_s` is closed.
        """
        handler = self._handler
        idle_s = handler.settings.stream_idle_s
        try:
            opening = self._begin("ModelStreamInfer", context)
            opening.label = opening.label or secrets.token_hex(8)  # one version for all when a canary runs
            handler.open_stream(opening)
        except Exception as error:
            _fail(context, error)
            return
        key = StreamKey(handler.keys, presented_key(opening.headers))
        try:
            while True:
                try:
                    content = await asyncio.wait_for(anext(requests), idle_s)
                except StopAsyncIteration:
                    return
                except asyncio.TimeoutError:
                    _fail(context, DeadlineError(f"the stream was silent for {idle_s:g} s: open another one"))
                    return
                request = Request(
                    PROTOCOL, "", None, time.perf_counter(), label=opening.label, request_id=opening.request_id
                )
                try:
                    key.check()
                    request.may_explore = key.may_explore
                except RlservoError as error:
                    peer = context.peer()
                    handler.record_failure(request, error.code, error.message, peer=peer)
                    if not isinstance(error, RateLimitError):  # the key is no longer accepted
                        _fail(context, error)
                        return
                    yield _error_reply(error, content)
                    continue
                try:
                    reply = await handler.answer(self._codec, request, (content, None))
                    yield messages.ModelStreamInferResponse(infer_response=reply)
                except RlservoError as error:
                    yield _error_reply(error, content)
        finally:
            handler.close_stream(opening)

    def _begin(self, method: str, context: Any) -> Request:
        """Return a call's request, whose content is still to be read. Raises ForbiddenError, UnauthenticatedError."""
        if self._local_only and not is_local(context.peer()):
            raise ForbiddenError("this server accepts only clients on its own machine: serve it with --host for others")
        metadata = context.invocation_metadata()
        headers: dict[bytes, bytes] = {}
        texts: dict[str, str] = {}
        for name, value in metadata:
            if type(value) is str:
                texts[name] = value
                headers.setdefault(name.encode(), value.encode())
            else:
                headers.setdefault(name.encode(), value)
        request = Request(
            PROTOCOL,
            "",
            None,
            time.perf_counter(),
            label=texts.get(LABEL_HEADER),
            request_id=texts.get(REQUEST_ID),
            headers=headers,
        )
        try:
            access = Access.open if method in OPEN else Access.act
            key = authorize(self._handler.keys, presented_key(headers), access)
            request.may_explore = key is None or key.may_explore
        except RlservoError as error:
            peer = context.peer()
            self._handler.record_failure(request, error.code, error.message, peer=peer)
            raise
        return request


def _model_ready(handler: RequestHandler, incoming: Incoming) -> Any:
    message = _parse(messages.ModelReadyRequest, incoming[0])
    return messages.ModelReadyResponse(ready=handler.has(message.name, message.version or None))


def _model_metadata(handler: RequestHandler, incoming: Incoming) -> Any:
    message = _parse(messages.ModelMetadataRequest, incoming[0])
    return messages.ModelMetadataResponse(**oip_models.model_metadata(handler, message.name, message.version or None))


def _model_config(handler: RequestHandler, incoming: Incoming) -> Any:
    message = _parse(messages.ModelConfigRequest, incoming[0])
    config = oip_models.model_config(handler, message.name, message.version or None)
    return messages.ModelConfigResponse(config=_numbered(config))


def _model_statistics(handler: RequestHandler, incoming: Incoming) -> Any:
    message = _parse(messages.ModelStatisticsRequest, incoming[0])
    found = oip_models.statistics(handler, message.name or None, message.version or None)
    return messages.ModelStatisticsResponse(model_stats=found)


def _index(handler: RequestHandler, incoming: Incoming) -> Any:
    message = _parse(messages.RepositoryIndexRequest, incoming[0])
    return messages.RepositoryIndexResponse(models=oip_models.repository_index(handler, ready=message.ready))


METHODS: dict[str, Callable[[RequestHandler, Incoming], Any]] = {
    "ServerLive": lambda _handler, _incoming: messages.ServerLiveResponse(live=True),
    "ServerReady": lambda handler, _incoming: messages.ServerReadyResponse(ready=handler.ready),
    "ServerMetadata": lambda _handler, _incoming: messages.ServerMetadataResponse(**oip_models.server_metadata()),
    "ModelReady": _model_ready,
    "ModelMetadata": _model_metadata,
    "ModelConfig": _model_config,
    "ModelStatistics": _model_statistics,
    "RepositoryIndex": _index,
}


class OipGrpcCodec:
    """The protocol's bytes over gRPC (`Codec`)."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler

    async def receive(self, request: Request, source: Incoming) -> bytes:
        """Return the message. Raises TooLargeError."""
        content, remaining_s = source
        limit = self._handler.settings.max_body_bytes
        if len(content) > limit:
            raise TooLargeError(f"the message is larger than {limit} bytes", {"max_bytes": limit})
        request.deadline_ms = None if remaining_s is None else remaining_s * 1e3
        return content

    def parse(self, request: Request, content: bytes) -> None:
        """Fill the request. Raises RequestError, ObservationError, UnknownPolicyError."""
        message = _parse(messages.ModelInferRequest, content)
        request.policy, request.version = message.model_name, message.model_version or None
        self._handler.store().get(request.policy, request.version)
        if len(content) > SMALL:
            check_length(self._handler.store(), request.policy, content, self._handler.settings.max_batch)
        for field in ("inputs", "outputs", "parameters", "raw_input_contents"):
            if len(getattr(message, field)) > SPARE:
                raise TooLargeError(f"the message has more than {SPARE} {field}")
        document = {
            "parameters": _parameters(message.parameters),
            "outputs": [
                {"name": output.name, "parameters": _parameters(output.parameters)} for output in message.outputs
            ],
        }
        oip_infer.fill_request(self._handler, request, document, _inputs(message))
        request.reply_options.request_id = message.id
        request.reply_options.binary = bool(message.raw_input_contents)

    def encode(self, request: Request, decision: Decision) -> Any:
        """Return the reply's message."""
        answer = oip_infer.answer_of(request, decision)
        reply = messages.ModelInferResponse(
            model_name=answer.name, model_version=answer.version, id=request.reply_options.request_id
        )
        for name, value in answer.parameters.items():
            _set(reply.parameters[name], value)
        arrays = {name: np.ascontiguousarray(array) for name, array in answer.outputs.items()}
        datatypes = {name: datatype_of(array.dtype) for name, array in arrays.items()}
        # A reply is bytes altogether or typed fields altogether, and not every type has a field.
        raw = request.reply_options.binary or any(datatype not in FIELDS for datatype in datatypes.values())
        for name, array in arrays.items():
            output = reply.outputs.add(name=name, datatype=datatypes[name], shape=array.shape)
            if raw:
                reply.raw_output_contents.append(array.astype(DTYPES[datatypes[name]], copy=False).tobytes())
            else:
                getattr(output.contents, FIELDS[datatypes[name]]).extend(array.ravel().tolist())
        return reply


def _numbered(document: Any) -> Any:
    """Return a configuration with the names of its data types as the numbers that stand for them in a message."""
    if isinstance(document, dict):
        return {key: DATA_TYPES[value] if key == "data_type" else _numbered(value) for key, value in document.items()}
    return [_numbered(each) for each in document] if isinstance(document, list) else document


def _set(parameter: Any, value: Any) -> None:
    if isinstance(value, bool):
        parameter.bool_param = value
    elif isinstance(value, int):
        setattr(parameter, "int64_param" if value < 2**63 else "uint64_param", value)
    elif isinstance(value, float):
        parameter.double_param = value
    else:
        parameter.string_param = str(value)


def _inputs(message: Any) -> dict[str, NDArray[Any]]:
    """Return the inputs by name. Raises RequestError if the form is wrong, ObservationError if numbers are."""
    raw = message.raw_input_contents
    if not message.inputs:
        raise RequestError("'inputs' must hold at least one tensor, with name, datatype and shape")
    if raw and len(raw) != len(message.inputs):
        raise RequestError(
            f"there are {len(message.inputs)} inputs and {len(raw)} raw_input_contents: expected one for each, or none"
        )
    seen: set[str] = set()
    for tensor in message.inputs:
        if tensor.name in seen:
            raise RequestError(f"input '{tensor.name[:64]}' is given twice")
        seen.add(tensor.name)
    inputs: dict[str, NDArray[Any]] = {}
    for index, tensor in enumerate(message.inputs):
        name, shape = tensor.name, tuple(tensor.shape)
        label = name[:64]
        dtype = check_form(label, shape, tensor.datatype, tensor.parameters)
        if raw:
            content = raw[index]
            check_size(label, shape, dtype, len(content), "raw_input_contents are")
            inputs[name] = from_bytes(label, memoryview(content), shape, dtype)
        else:
            inputs[name] = _typed(label, tensor, shape, dtype)
    return inputs


def _typed(label: str, tensor: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    field = FIELDS.get(tensor.datatype)
    if field is None:
        raise RequestError(f"input '{label}': datatype {tensor.datatype} has no typed contents: use raw_input_contents")
    others = [given.name for given, _ in tensor.contents.ListFields() if given.name != field]
    if others:
        raise RequestError(f"input '{label}' of datatype {tensor.datatype} belongs in '{field}', not '{others[0]}'")
    values = getattr(tensor.contents, field)
    if len(values) != math.prod(shape):
        raise ObservationError(
            f"input '{label}': '{field}' has {len(values)} values, expected {math.prod(shape)} for shape {list(shape)}",
            {"expected_shape": list(shape), "numbers": len(values)},
        )
    array = np.array(values, FIELD_DTYPES[field])
    return parse_array(array, dtype, f"input '{label}'", ObservationError).reshape(shape)


def _parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters as plain values, without those that have none."""
    plain = {}
    for name, value in given.items():
        choice = value.WhichOneof("parameter_choice")
        if choice is not None:
            plain[name] = getattr(value, choice)
    return plain


def _parse(kind: Any, content: bytes) -> Any:
    try:
        return kind.FromString(content)
    except DecodeError as error:
        raise RequestError(f"the message is not a {kind.DESCRIPTOR.name}: {error}") from None


def _id_of(content: bytes) -> str:
    """Return the id of a request that failed, if it can be read."""
    try:
        return str(messages.ModelInferRequest.FromString(content).id)
    except DecodeError:
        return ""


def _error_reply(error: RlservoError, content: bytes) -> Any:
    """Return a stream's reply to a request that failed."""
    return messages.ModelStreamInferResponse(
        error_message=_explain(error)[1], infer_response=messages.ModelInferResponse(id=_id_of(content))
    )


def _fail(context: Any, error: Exception) -> None:
    """Set the status of a call. Serve would log an exception with its traceback, too much for a client's fault."""
    status, sentence, code = _explain(error)
    context.set_code(status)
    context.set_details(sentence)
    given = [(name, value) for name, value in context.invocation_metadata() or () if name == REQUEST_ID]
    trailing = [("rlservo-code", code), *given]
    if isinstance(error, UnavailableError):
        trailing.append(("retry-after", str(retry_after_s(error))))
    context.set_trailing_metadata(trailing)


def _explain(error: Exception) -> tuple[grpc.StatusCode, str, str]:
    """Return (status, sentence, code) of an error, without internal details."""
    if not isinstance(error, RlservoError):
        logger.error("a gRPC call failed", exc_info=error)
        return grpc.StatusCode.INTERNAL, BUG, InternalError.code
    if isinstance(error, InternalError):  # already logged
        return grpc.StatusCode.INTERNAL, BUG, error.code
    status = CODES.get(status_of(error), grpc.StatusCode.INTERNAL)
    if status is grpc.StatusCode.INTERNAL:
        logger.error("%s", error.message)
        if not isinstance(error, ActionError):
            return status, BUG, InternalError.code
    return status, error.message, error.code


@functools.lru_cache(maxsize=1024)  # the peers of open connections
def is_local(peer: str) -> bool:
    """Whether a gRPC peer ('ipv4:127.0.0.1:4711', 'ipv6:%5B::1%5D:4711', 'unix:...') is on this machine."""
    scheme, _, address = peer.partition(":")
    if scheme == "unix":
        return True
    try:
        host = ipaddress.ip_address(unquote(address).rsplit(":", 1)[0].strip("[]"))
    except ValueError:
        return False
    mapped = getattr(host, "ipv4_mapped", None)
    return host.is_loopback if mapped is None else bool(mapped.is_loopback)
