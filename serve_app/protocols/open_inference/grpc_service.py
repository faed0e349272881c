"""Open Inference Protocol over gRPC: the methods of `GRPCInferenceService`, called by an engine's gRPC server.

The same policies, options and errors as over HTTP (`infer.py`); an error's HTTP status becomes a gRPC status, its
code goes into the trailing metadata. The messages are in `messages.py`; a reply's tensors are raw or typed as the
request's were.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import secrets
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import unquote

import grpc
import orjson
from google.protobuf import json_format
from google.protobuf.message import DecodeError

from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import (
    DeadlineError,
    ForbiddenError,
    RequestError,
    RlservoError,
    TooLargeError,
    UnauthenticatedError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.serve_app.protocols.error_statuses import describe
from rlservo.serve_app.protocols.open_inference import model_info
from rlservo.serve_app.protocols.open_inference.infer import ReplyOptions, fill, reply_of
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.protocols.open_inference.tensors import DTYPES, datatype_of
from rlservo.serve_app.server.access_checks import LABEL, StreamKey, authorize, header_text, presented_key
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL, SPARE, check_length
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.sessions.request import TRACEPARENT, Request, trace_id
from rlservo.serve_app.versions.policy_store import Decision

PROTOCOL = "grpc"
REQUEST_ID = "x-request-id"
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
# The field of InferParameter that holds a value.
PARAMETER = {bool: "bool_param", int: "int64_param", float: "double_param", str: "string_param"}


class Grpc:
    """Answers gRPC calls with the handler."""

    def __init__(self, handler: RequestHandler, *, local_only: bool = False) -> None:
        """Take the handler. `local_only`: Serve binds its gRPC ports to every interface, whatever its host option."""
        self._handler = handler
        self._local_only = local_only

    async def answer(self, method: str, content: bytes, context: Any, remaining_s: float | None = None) -> Any:
        """Return the reply to one call. An error sets the status, and the empty reply is ignored.

        The caller waits for `remaining_s`; None: indefinitely.
        """
        try:
            request = self._begin(method, context)
            request.deadline_ms = None if remaining_s is None else remaining_s * 1e3
            echoed = [] if request.request_id is None else [(REQUEST_ID, request.request_id)]
            if trace_id(request.headers) is not None:
                echoed.append((TRACEPARENT.decode(), request.headers[TRACEPARENT].decode()))
            context.set_trailing_metadata(echoed)
            if method == "ModelInfer":
                return await self._handler.answer(CODEC, request, content)
            return self._look_up(method, content)
        except Exception as error:
            _fail(context, error)
            return messages.ServerLiveResponse()

    def _look_up(self, name: str, content: bytes) -> Any:
        """Return the reply to a method without an action."""
        asked, reply = _parse(getattr(messages, f"{name}Request"), content), getattr(messages, f"{name}Response")()
        method = model_info.METHODS[name]
        try:
            document = method.document(self._handler, **{field.name: value for field, value in asked.ListFields()})
        except (UnavailableError, UnknownPolicyError):
            if name not in ("ServerReady", "ModelReady"):
                raise
            document = {"ready": False}
        document = {method.field: document} if method.field else document
        return json_format.Parse(orjson.dumps(document), reply, ignore_unknown_fields=name == "ModelReady")

    async def stream(self, requests: AsyncIterator[bytes], context: Any) -> AsyncIterator[Any]:
        """Yield a reply to each request of a stream; an error is also a reply, and the stream continues.

        A stream that is silent for `stream_idle_s` is closed.
        """
        handler = self._handler
        idle_s = handler.settings.stream_idle_s
        try:
            opening = self._begin("ModelStreamInfer", context)
            opening.peer = context.peer()
            opening.label = opening.label or secrets.token_hex(8)  # one version for all when a canary runs
            key = StreamKey(handler.keys, presented_key(opening.headers))
            with handler.open_stream(opening):
                while True:
                    content = await asyncio.wait_for(anext(requests), idle_s)
                    request = replace(opening, received=time.perf_counter(), arrived=time.perf_counter())
                    try:
                        reply = await handler.answer(CODEC, request, content, key)
                        yield messages.ModelStreamInferResponse(infer_response=reply)
                    except UnauthenticatedError:  # the key is no longer accepted
                        raise
                    except RlservoError as error:
                        yield _error_reply(error, content)
        except StopAsyncIteration:
            return
        except asyncio.TimeoutError:
            _fail(context, DeadlineError(f"the stream was silent for {idle_s:g} s: open another one"))
        except Exception as error:
            _fail(context, error)

    def _begin(self, method: str, context: Any) -> Request:
        """Return a call's request, whose content is still to be read. Raises ForbiddenError, UnauthenticatedError."""
        if self._local_only and not is_local(context.peer()):
            raise ForbiddenError(
                "this server accepts only clients on its own machine: set http_options.host for others"
            )
        headers: dict[bytes, bytes] = {}
        for name, value in context.invocation_metadata():
            headers.setdefault(name.encode(), value.encode() if type(value) is str else value)
        label, request_id = header_text(headers, LABEL), header_text(headers, REQUEST_ID.encode())
        request = Request(PROTOCOL, label=label, request_id=request_id, headers=headers)
        try:
            access = model_info.METHODS[method].access if method in model_info.METHODS else Access.act
            key = authorize(self._handler.keys, presented_key(headers), access)
            request.may_explore = key is None or key.may_explore
        except RlservoError as error:
            request.peer = context.peer()
            self._handler.record_failure(request, error)
            raise
        return request


class OipGrpcCodec:
    """The protocol's bytes over gRPC (`Codec`)."""

    async def receive(self, handler: RequestHandler, request: Request, source: bytes) -> bytes:  # noqa: ARG002
        """Return the message. Raises TooLargeError."""
        limit = handler.settings.max_body_bytes
        if len(source) > limit:
            raise TooLargeError(f"the message is larger than {limit} bytes", {"max_bytes": limit})
        return source

    def parse(self, handler: RequestHandler, request: Request, content: bytes) -> None:
        """Fill the request. Raises RequestError, ObservationError, UnknownPolicyError."""
        message = _parse(messages.ModelInferRequest, content)
        request.policy, request.version = message.model_name, message.model_version or None
        store = handler.store()
        store.get(request.policy, request.version)
        if len(content) > SMALL:
            bounds = check_length(store, request.policy, content, handler.settings.max_batch)
            _check_counts(message, max(each.values for each in bounds))
        document, raw = _document_of(message)
        fill(handler, request, document, memoryview(b"".join(raw)))
        # A reply is bytes altogether or typed fields altogether, and not every type has a field.
        options: ReplyOptions = request.reply_options
        binary = bool(raw) or any(datatype_of(tensor.dtype) not in FIELDS for tensor in options.model.outputs.values())
        options.outputs = dict.fromkeys(options.outputs, binary)

    def encode(self, request: Request, decision: Decision) -> Any:
        """Return the reply's message."""
        document, raw = reply_of(request, decision)
        parameters, outputs = document.pop("parameters"), document.pop("outputs")
        reply = messages.ModelInferResponse(**document, raw_output_contents=raw)
        for name, value in parameters.items():
            kind = "uint64_param" if type(value) is int and value >= 2**63 else PARAMETER[type(value)]
            setattr(reply.parameters[name], kind, value)
        for tensor in outputs:
            output = reply.outputs.add(name=tensor["name"], datatype=tensor["datatype"], shape=tensor["shape"])
            if "data" in tensor:
                getattr(output.contents, FIELDS[tensor["datatype"]]).extend(tensor["data"].tolist())
        return reply


CODEC = OipGrpcCodec()


def _check_counts(message: Any, most_numbers: int) -> None:
    """Raise TooLargeError for more of anything repeated than a request can need."""
    tensors = [*message.inputs[: SPARE + 1], *message.outputs[: SPARE + 1]]
    contents = [field for tensor in message.inputs[: SPARE + 1] for _, field in tensor.contents.ListFields()]
    counts = {
        "inputs": len(message.inputs),
        "outputs": len(message.outputs),
        "parameters": sum(len(each.parameters) for each in (message, *tensors)),
        "sizes": sum(len(each.shape) for each in message.inputs[: SPARE + 1]),
        "raw_input_contents": len(message.raw_input_contents),
    }
    for what, count in counts.items():
        if count > SPARE:
            raise TooLargeError(f"the message has more than {SPARE} {what}")
    if sum(map(len, contents)) > most_numbers:
        raise TooLargeError(f"the message has more than {most_numbers} numbers")


def _document_of(message: Any) -> tuple[dict[str, Any], Sequence[bytes]]:
    """Return a request in the form that it has over HTTP, and the bytes of its tensors. Raises RequestError."""
    raw = message.raw_input_contents
    if raw and len(raw) != len(message.inputs):
        raise RequestError(
            f"there are {len(message.inputs)} inputs and {len(raw)} raw_input_contents: expected one for each, or none"
        )
    inputs = [_tensor(tensor, raw[index] if raw else None) for index, tensor in enumerate(message.inputs)]
    outputs = [{"name": output.name, "parameters": _parameters(output.parameters)} for output in message.outputs]
    return {"id": message.id, "parameters": _parameters(message.parameters), "inputs": inputs, "outputs": outputs}, raw


def _tensor(tensor: Any, raw: bytes | None) -> dict[str, Any]:
    name, datatype, parameters = tensor.name, tensor.datatype, _parameters(tensor.parameters)
    document = {"name": name, "datatype": datatype, "shape": list(tensor.shape), "parameters": parameters}
    if raw is not None:
        parameters["binary_data_size"] = len(raw)
        return document
    field = FIELDS.get(datatype, "raw_input_contents")
    other = next((given.name for given, _ in tensor.contents.ListFields() if given.name != field), None)
    if other is not None and datatype in DTYPES:
        raise RequestError(f"input '{name[:64]}' of datatype {datatype} belongs in '{field}', not '{other}'")
    return {**document, "data": list(getattr(tensor.contents, field, ()))}


def _parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters as plain values, without those that have none."""
    chosen = {name: (value, value.WhichOneof("parameter_choice")) for name, value in given.items()}
    return {name: getattr(value, choice) for name, (value, choice) in chosen.items() if choice is not None}


def _parse(kind: Any, content: bytes) -> Any:
    try:
        return kind.FromString(content)
    except DecodeError as error:
        raise RequestError(f"the message is not a {kind.DESCRIPTOR.name}: {error}") from None


def _error_reply(error: RlservoError, content: bytes) -> Any:
    """Return a stream's reply to a request that failed, with its id if that can be read."""
    reply = messages.ModelStreamInferResponse(error_message=describe(error)[1]["error"])
    with contextlib.suppress(DecodeError):
        reply.infer_response.id = messages.ModelInferRequest.FromString(content).id
    return reply


def _fail(context: Any, error: Exception) -> None:
    """Set the status of a call. Serve would log an exception with its traceback, too much for a client's fault."""
    (_, status), document, wait_s = describe(error)
    context.set_code(grpc.StatusCode[status])
    context.set_details(document["error"])
    given = [(name, value) for name, value in context.invocation_metadata() or () if name == REQUEST_ID]
    retry = [] if wait_s is None else [("retry-after", str(wait_s))]
    context.set_trailing_metadata([("rlservo-code", document["code"]), *given, *retry])


@functools.lru_cache(maxsize=1024)  # the peers of open connections
def is_local(peer: str) -> bool:
    """Whether a gRPC peer ('ipv4:127.0.0.1:4711', 'ipv6:%5B::1%5D:4711', 'unix:...') is on this machine."""
    scheme, _, address = peer.partition(":")
    host = unquote(address).rpartition(":")[0].strip("[]").removeprefix("::ffff:")
    return scheme == "unix" or (host != "localhost" and is_loopback(host))  # a name proves nothing
