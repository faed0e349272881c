"""Open Inference Protocol v2 over HTTP: inference with binary tensors, as in Triton's clients.

A policy is a model with the contract's inputs (`obs`, or `obs.<path>` for each leaf of a nested space,
`state_in.<name>` and `reward`; `last_action` or `last_action.<path>`, if its step is limited) and outputs (`action`
or `action.<path>`, `state_out.<name>`); every call is for a batch, as the protocol's shapes imply. The request
parameters `explore`, `seed`, `seq`, `deadline_ms` and `timestamp` are those of the JSON protocol; `sequence_id`,
`sequence_start` and `sequence_end` are its sessions, and `state_policy`, which the reply returns with the states, is
its `@policy`.

Specification: github.com/kserve/open-inference-protocol, and Triton's extension_binary_data.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any
from weakref import WeakKeyDictionary

import orjson
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, SkipValidation, TypeAdapter, with_config
from starlette.types import Receive
from typing_extensions import Required, TypedDict

from rlservo.bundle.contract import REWARD
from rlservo.bundle.nested import action_leaves, build_action
from rlservo.client.formats.request_names import BELONGS_TO
from rlservo.errors import ObservationError, RequestError, quoted
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, Headers, too_large
from rlservo.serve_app.protocols.http_endpoint import (
    OCTETS,
    Body,
    act_over_http,
    check_media_type,
    content_encoding,
    receive_body,
)
from rlservo.serve_app.protocols.open_inference.tensors import DTYPES, read_inputs, write_tensor
from rlservo.serve_app.protocols.request_fields import Options, fill_request, parse_fields, parse_json, strict
from rlservo.serve_app.protocols.routing import POST, Route, of_policy
from rlservo.serve_app.server.content_bounds import SMALL, check_json
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.sessions.request import LONGEST_SESSION_ID, Request, reply_fields
from rlservo.serve_app.versions.policy_store import Decision

LENGTH_HEADER = b"inference-header-content-length"  # of the JSON; binary tensors follow it
STATE_IN, STATE_OUT = "state_in.", "state_out."
LAST_ACTION = "last_action"  # inputs named like the outputs `action` and `action.<path>`
MOST_DIMENSIONS = 32  # numpy itself stops at 64
ENCODINGS = {b"gzip": zlib.MAX_WBITS | 16, b"deflate": zlib.MAX_WBITS}  # and zlib's `wbits`
SMALLEST_COMPRESSED = 1024  # [bytes] a shorter reply fits into one packet anyway
COMPRESSION_LEVEL = 1  # a robot's numbers hardly compress, and a control loop waits for them
SUCH_AS = '{"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": [...]}]}'


@strict
class Tensor(TypedDict, total=False):
    """A tensor, in JSON or (with the parameter `binary_data_size`) as bytes after the JSON."""

    name: Required[str]
    shape: Required[Annotated[list[int], Field(max_length=MOST_DIMENSIONS)]]
    datatype: Required[Annotated[str, Field(description="One of " + ", ".join(DTYPES))]]
    parameters: dict[str, Any] | None
    data: Annotated[Any, Field(description="Nested or flat, in row-major order.")]


@with_config(ConfigDict(strict=True, extra="allow"))
class OutputParameters(TypedDict, total=False):
    """Parameters of a requested output."""

    binary_data: Annotated[bool | None, Field(description="Reply with bytes after the JSON.")]


@strict
class RequestedOutput(TypedDict, total=False):
    """An output to reply with."""

    name: Required[str]
    parameters: OutputParameters | None


@strict
class Parameters(Options, total=False):
    """Parameters of a request: the options of the JSON protocol, and those of the protocol and its clients."""

    binary_data_output: bool | None
    sequence_id: int | Annotated[str, Field(max_length=LONGEST_SESSION_ID - 1)] | None
    sequence_start: bool | None
    sequence_end: bool | None
    state_policy: Annotated[str | None, Field(description="From the reply that had the states.")]
    timeout: Annotated[int | None, Field(ge=0, lt=2**64, description="[us] Triton's: how long the request may wait.")]
    priority: Annotated[Any, Field(description="Ignored: there is no queue.")]
    headers: Annotated[Any, Field(description="Ignored.")]
    content_type: Annotated[Any, Field(description="Ignored.")]


@strict
class InferRequest(TypedDict, total=False):
    """Request a batch of actions."""

    id: Annotated[str | None, Field(description="Echoed.")]
    model_name: Annotated[str | None, Field(description="Same name as in the path; optional.")]
    parameters: Annotated[Parameters | None, SkipValidation]  # checked on its own
    inputs: Required[list[Tensor]]
    outputs: list[RequestedOutput] | None


INFER: TypeAdapter[InferRequest] = TypeAdapter(InferRequest)
PARAMETERS: TypeAdapter[Parameters] = TypeAdapter(Parameters)


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v2 for actions."""
    infer = act_over_http("oip", OipHttpCodec(), handler)
    return of_policy(POST, "/v2/models", "/infer", "Infer", infer, reads_body=True)


class Model:
    """The tensors that this protocol has for a policy, by name."""

    def __init__(self, policy: Policy) -> None:
        self.contract = policy.contract
        self.outputs = {
            tensor.name: tensor
            for tensor in self.contract.outputs
            if tensor.name == "action" or tensor.name.startswith(("action.", STATE_OUT))
        }
        """Actions and states, not the network's internal values."""
        last_action = {
            LAST_ACTION + name.removeprefix("action"): tensor
            for name, tensor in self.outputs.items()
            if not name.startswith(STATE_OUT)
        }
        own = {tensor.name: tensor for tensor in self.contract.inputs}
        self.inputs = own | last_action
        """Those that a request may have: a last action may also be sent for recordings."""
        self.offered = self.inputs if policy.has_step_limit else own


_models: WeakKeyDictionary[Policy, Model] = WeakKeyDictionary()


def model_of(policy: Policy) -> Model:
    """Return a policy's tensors."""
    model = _models.get(policy)
    if model is None:
        model = _models[policy] = Model(policy)
    return model


def is_optional(name: str) -> bool:
    """Return whether a request may lack this input, as at an episode's start."""
    return name == REWARD or name.startswith((STATE_IN, LAST_ACTION))


@dataclass(slots=True)
class ReplyOptions:
    """Form of a request's reply."""

    model: Model
    outputs: dict[str, bool]
    """The outputs, in order, and whether as bytes."""
    request_id: str | None
    """The protocol's own `id`, echoed."""


class OipHttpCodec:
    """The protocol's bytes over HTTP (`Codec`): JSON and raw tensors in, JSON and raw tensors out."""

    async def receive(self, handler: RequestHandler, request: Request, source: Receive) -> Body:
        """Return the body, still compressed. Raises MediaTypeError, and what `receive_body` raises.

        Triton's client sends no content type, others send JSON or octets: the length header distinguishes them.
        """
        check_media_type(request.headers, OCTETS, optional=True)
        content_encoding(request.headers, *ENCODINGS)
        return await receive_body(handler, request.headers, source)

    def parse(self, handler: RequestHandler, request: Request, content: Body) -> None:
        """Fill the request. Raises RequestError, ObservationError, TooLargeError, UnknownPolicyError."""
        handler.store().get(request.policy, request.version)  # an unknown one is reported first
        length = _parse_length(request.headers.get(LENGTH_HEADER))
        encoding = content_encoding(request.headers, *ENCODINGS)
        if encoding:
            content = _decompress(content, encoding, handler.settings.max_body_bytes)
        view = memoryview(content)
        if length is not None and length > len(view):
            raise RequestError(f"Inference-Header-Content-Length is {length}, but the body has {len(view)} bytes")
        header, raw = (view, view[:0]) if length is None else (view[:length], view[length:])
        if len(view) > SMALL:
            check_json(handler.store(), request.policy, header, handler.settings.max_batch)
        document, request.non_finite = parse_json(header, such_as=SUCH_AS)
        fill(handler, request, document, raw)

    def encode(self, request: Request, decision: Decision) -> tuple[bytes, Headers]:
        """Return the reply's body and headers."""
        reply, parts = reply_of(request, decision)
        content = orjson.dumps(reply, option=orjson.OPT_SERIALIZE_NUMPY)
        headers = JSON_HEADERS
        if parts:
            headers = ((b"content-type", OCTETS), (LENGTH_HEADER, b"%d" % len(content)))
            content += b"".join(parts)
        accepted = request.headers.get(b"accept-encoding")
        if accepted is not None and len(content) >= SMALLEST_COMPRESSED:
            return _compress(content, headers, accepted.lower())
        return content, headers


def fill(handler: RequestHandler, request: Request, document: Mapping[str, Any], raw: memoryview) -> None:
    """Fill a request of either transport from its document and the bytes of its binary tensors.

    A deadline already set is the transport's own: the earlier one counts. Raises RequestError and ObservationError.
    """
    given: InferRequest = parse_fields(INFER, document)
    if given.get("model_name") not in (None, request.policy):
        raise RequestError(f"'model_name' differs from '{request.policy[:64]}', which the path names")
    if not given["inputs"]:
        raise RequestError(f"'inputs' must hold at least one tensor: send {SUCH_AS}")
    inputs = read_inputs(given["inputs"], raw)
    parameters: Parameters = parse_fields(PARAMETERS, given.get("parameters") or {}, "parameter")
    states: dict[str, Any] = {
        name.removeprefix(STATE_IN): array for name, array in inputs.items() if name.startswith(STATE_IN)
    }
    identity = parameters.get("state_policy") if states else None
    if identity is not None:
        states[BELONGS_TO] = identity
    sequence, starts = parameters.get("sequence_id") or None, bool(parameters.get("sequence_start"))
    # The policy of the session, or of the state with that identity, even if the default has changed.
    model = model_of(handler.episodes.policy_of(handler.store(), request.policy, request.version, sequence, identity))
    request.reply_options = ReplyOptions(
        model, _wanted_outputs(model, given, parameters, sequenced=sequence is not None), given.get("id")
    )
    _check_inputs(model, inputs)
    request.obs = build_action(model.contract.observation_space, inputs, "obs")
    if not parameters and len(inputs) == 1:  # the usual request
        return
    deadlines = (request.deadline_ms, parameters.get("deadline_ms"), (parameters.get("timeout") or 0) / 1e3 or None)
    fill_request(
        request,
        {
            **parameters,
            "deadline_ms": min((each for each in deadlines if each is not None), default=None),
            "state": states or ({} if starts and sequence is None else None),  # a client that will carry it
            "session_id": sequence,
            "reset": (starts and sequence is not None) or None,
            "end": (parameters.get("sequence_end") and sequence is not None) or None,
            "reward": inputs.get(REWARD, parameters.get("reward")),
            "last_action": _last_action(model, inputs),
        },
    )


def reply_of(request: Request, decision: Decision) -> tuple[dict[str, Any], list[bytes]]:
    """Return the reply's document, and the bytes of its binary tensors."""
    options: ReplyOptions = request.reply_options
    fields = reply_fields(request, decision)
    reply: dict[str, Any] = {"model_name": fields.pop("policy"), "model_version": fields.pop("version")}
    outputs: dict[str, NDArray[Any]] = action_leaves(options.model.contract.action_space, decision.action)
    if "warnings" in fields:
        fields["warnings"] = "; ".join(fields["warnings"])
    if "session_id" in fields:
        fields["sequence_id"] = fields.pop("session_id")
    if "state" in fields:
        carried = fields.pop("state")
        fields["state_policy"] = carried[BELONGS_TO]
        outputs.update({STATE_OUT + state.name: carried[state.name] for state in options.model.contract.state})
    reply["parameters"] = fields
    if options.request_id is not None:
        reply["id"] = options.request_id
    written = [
        write_tensor(name, outputs[name], binary=binary) for name, binary in options.outputs.items() if name in outputs
    ]
    reply["outputs"] = [tensor for tensor, _ in written]
    return reply, [part for _, part in written if part is not None]


def _check_inputs(model: Model, inputs: Mapping[str, NDArray[Any]]) -> None:
    """Raise ObservationError unless the inputs are the model's, of its shapes, and of one batch."""
    whose = f"policy '{model.contract.name}'"
    for name, array in inputs.items():
        expected = model.inputs.get(name)
        if expected is None:
            raise ObservationError(f"{whose} has no input '{name[:64]}': expected {quoted(model.offered)}")
        if array.shape[1:] != expected.shape[1:] or array.ndim != len(expected.shape):
            raise ObservationError(
                f"{whose} expects input '{name}' of shape {list(expected.shape)} (-1 is the batch), got "
                f"{list(array.shape)}",
                {"policy": model.contract.name, "expected_shape": list(expected.shape), "shape": list(array.shape)},
            )
    missing = next((name for name in model.inputs if name not in inputs and not is_optional(name)), None)
    if missing is not None:
        raise ObservationError(f"{whose} needs the input '{missing}', which is missing")
    if len({len(array) for array in inputs.values()}) > 1:
        batches = ", ".join(f"{name} {len(inputs[name])}" for name in model.inputs if name in inputs)
        raise ObservationError(f"the inputs of {whose} have different batch sizes: {batches}")


def _last_action(model: Model, inputs: Mapping[str, NDArray[Any]]) -> Any:
    """Return the last action that the inputs hold, in the action space's form, or None. Raises ObservationError."""
    names = [name for name in model.inputs if name.startswith(LAST_ACTION)]
    missing = [name for name in names if name not in inputs]
    if len(missing) == len(names):
        return None
    if missing:
        raise ObservationError(
            f"policy '{model.contract.name}' needs '{missing[0]}' too if other last_action inputs are sent"
        )
    return build_action(model.contract.action_space, inputs, LAST_ACTION)


def _wanted_outputs(model: Model, given: InferRequest, parameters: Parameters, *, sequenced: bool) -> dict[str, bool]:
    """Return the outputs to reply with, and whether as bytes. Raises RequestError for outputs that do not exist."""
    binary = bool(parameters.get("binary_data_output"))
    wanted: dict[str, bool] = {}
    for output in given.get("outputs") or ():
        name, own = output["name"], output.get("parameters") or {}
        if name not in model.outputs:
            raise RequestError(f"the output '{name[:64]}' does not exist: expected {quoted(model.outputs)}")
        if name.startswith(STATE_OUT) and sequenced:
            raise RequestError(f"the output '{name}' is kept with the sequence: request the action, or carry the state")
        refused = next((name for name in ("classification", "shared_memory_region") if name in own), None)
        if refused is not None:
            raise RequestError(f"the output parameter '{refused}' is not supported: leave it out")
        chosen = own.get("binary_data")
        wanted[name] = binary if chosen is None else chosen
    return wanted or dict.fromkeys(model.outputs, binary)


def _parse_length(value: bytes | None) -> int | None:
    if value is None:
        return None
    if not value.isdigit() or len(value) > 15 or not int(value):  # Triton's form without JSON is not read
        raise RequestError(
            f"Inference-Header-Content-Length must be the length of the JSON, got '{value[:32].decode('latin-1')}'"
        )
    return int(value)


def _decompress(body: Body, encoding: bytes, limit: int) -> bytes:
    """Decompress gzip or deflate to at most `limit` bytes: a few kilobytes can unpack to gigabytes."""
    try:
        stream = zlib.decompressobj(ENCODINGS[encoding])
        plain = stream.decompress(body, limit + 1)
    except zlib.error as error:
        raise RequestError(f"the body is not valid {encoding.decode()}: {error}") from None
    if len(plain) > limit:
        raise too_large(limit)
    if not stream.eof or stream.unused_data:
        state = "incomplete" if not stream.eof else "followed by other bytes"
        raise RequestError(f"the {encoding.decode()} body is {state}")
    return plain


def _compress(content: bytes, headers: Headers, accepted: bytes) -> tuple[bytes, Headers]:
    """Compress for a client that sent accept-encoding."""
    offered = {part.split(b";")[0].strip() for part in accepted.split(b",") if b"q=0" not in part.replace(b"q=0.", b"")}
    for encoding, bits in ENCODINGS.items():
        if encoding in offered:
            stream = zlib.compressobj(COMPRESSION_LEVEL, wbits=bits)
            headers += ((b"content-encoding", encoding), (b"vary", b"accept-encoding"))
            return stream.compress(content) + stream.flush(), headers
    return content, headers
