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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from rlservo.export.contract.contract import REWARD, Contract, TensorSpec
from rlservo.export.contract.errors import MediaTypeError, ObservationError, RequestError, quoted
from rlservo.export.contract.nested import action_leaves, build_action
from rlservo.serve_app.episodes.request import LONGEST_SESSION_ID, OPTIONS, Episode, Request, SessionId, reply_fields
from rlservo.serve_app.protocols.http_endpoint import Body, HttpEndpoint, receive_body
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers, check_media_type, too_large
from rlservo.serve_app.protocols.json_codec import parse_episode, parse_finite, parse_options
from rlservo.serve_app.protocols.json_text import json_type, parse_json
from rlservo.serve_app.protocols.oip_tensors import (
    DTYPES,
    datatype_of,
    from_bytes,
    parse_flag,
    parse_tensor,
    write_tensor,
)
from rlservo.serve_app.protocols.routes import POST, Route, of_policy
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.content_bounds import SMALL, check_json
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.policy_store import Decision
from rlservo.serve_app.wire.asgi import Receive
from rlservo.serve_app.wire.request_names import BELONGS_TO

LENGTH_HEADER = b"inference-header-content-length"  # of the JSON; binary tensors follow it
BINARY = b"application/octet-stream"
STATE_IN, STATE_OUT = "state_in.", "state_out."
LAST_ACTION = "last_action"  # inputs named like the outputs `action` and `action.<path>`
STATE_POLICY = "state_policy"  # identity of the policy that the states belong to
REQUEST_FIELDS = frozenset({"id", "parameters", "inputs", "outputs"})
MODEL_NAME = "model_name"  # KServe's client repeats the path's name here
# Parameters of the protocol and its clients besides our own options. Priority has no effect: there is no queue.
OUTCOME = ("reward", "final_status", "truncated")  # parameters with the meaning that they have in JSON
PARAMETERS = frozenset(
    {*OPTIONS, *OUTCOME, "binary_data_output", "sequence_id", "sequence_start", "sequence_end", STATE_POLICY}
)
TIMEOUT = "timeout"  # [us] Triton's: how long the request may wait
IGNORED = frozenset({"priority", TIMEOUT, "headers", "content_type"})
SMALLEST_COMPRESSED = 1024  # [bytes] a shorter reply fits into one packet anyway
COMPRESSION_LEVEL = 1  # a robot's numbers hardly compress, and a control loop waits for them
SUCH_AS = '{"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": [...]}]}'


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v2 for actions."""
    infer = HttpEndpoint("oip", OipHttpCodec(handler), handler)
    return of_policy(POST, "/v2/models", "/infer", "Infer", app=infer)


@dataclass(slots=True)
class ReplyOptions:
    """Form of a request's reply."""

    contract: Contract
    binary: bool
    """Whether outputs are bytes unless the request specifies each."""
    outputs: dict[str, bool]
    """The requested outputs, in order, and whether as bytes; empty means all."""
    request_id: str | None = None
    """The protocol's own `id`, echoed."""


class OipHttpCodec:
    """The protocol's bytes over HTTP (`Codec`): JSON and raw tensors in, JSON and raw tensors out."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler

    async def receive(self, request: Request, source: Receive) -> Body:
        """Return the body, still compressed. Raises MediaTypeError, and what `receive_body` raises.

        Triton's client sends no content type, others send JSON or octets: the length header distinguishes them.
        """
        check_media_type(request.headers, JSON, BINARY, optional=True)
        encoding = request.headers.get(b"content-encoding", b"")
        if encoding.strip().lower() not in (b"identity", b"gzip", b"deflate", b""):
            raise MediaTypeError(
                f"the content encoding '{encoding[:32].decode('latin-1')}' is not supported: send gzip, deflate or none"
            )
        return await receive_body(self._handler, request.headers, source)

    def parse(self, request: Request, content: Body) -> None:
        """Fill the request. Raises RequestError, ObservationError, TooLargeError, UnknownPolicyError."""
        contract = self._handler.store().get(request.policy, request.version).contract
        length = _parse_length(request.headers.get(LENGTH_HEADER))
        encoding = request.headers.get(b"content-encoding", b"").strip().lower()
        if encoding not in (b"", b"identity"):
            content = _decompress(content, encoding, self._handler.settings.max_body_bytes)
        view = memoryview(content)
        if length == 0 and len(view):
            document: dict[str, Any] = {}
            inputs = {contract.inputs[0].name: _raw_input(contract, view)}
        else:
            if len(view) > SMALL:
                check_json(self._handler.store(), request.policy, view[:length], self._handler.settings.max_batch)
            document, inputs, request.non_finite = _parse_document(view, length, request.policy)
        fill_request(self._handler, request, document, inputs)
        request.reply_options.request_id = document.get("id")

    def encode(self, request: Request, decision: Decision) -> tuple[bytes, Headers]:
        """Return the reply's body and headers."""
        answer = answer_of(request, decision)
        reply: dict[str, Any] = {
            "model_name": answer.name,
            "model_version": answer.version,
            "parameters": answer.parameters,
        }
        if request.reply_options.request_id is not None:
            reply["id"] = request.reply_options.request_id
        written = [write_tensor(name, array, binary=answer.binary[name]) for name, array in answer.outputs.items()]
        reply["outputs"] = [tensor for tensor, _ in written]
        content = orjson.dumps(reply, option=orjson.OPT_SERIALIZE_NUMPY)
        headers = JSON_HEADERS
        if any(answer.binary.values()):
            headers = ((b"content-type", BINARY), (LENGTH_HEADER, b"%d" % len(content)))
            content += b"".join(part for _, part in written)
        accepted = request.headers.get(b"accept-encoding")
        if accepted is not None and len(content) >= SMALLEST_COMPRESSED:
            return _compress(content, headers, accepted.lower())
        return content, headers


def fill_request(
    handler: RequestHandler, request: Request, document: Mapping[str, Any], inputs: dict[str, NDArray[Any]]
) -> None:
    """Fill a request of either transport, whose `parameters` and `outputs` are in `document`.

    A deadline already set is the transport's own: the earlier one counts. Raises RequestError and ObservationError.
    """
    parameters = document.get("parameters") or {}
    if parameters:
        _fill_options(request, parameters)
    sequence = parameters.get("sequence_id")
    identity = parameters.get(STATE_POLICY)
    if identity is not None and not any(name.startswith(STATE_IN) for name in inputs):
        identity = None  # there is no state that it could belong to
    session_id = _session_id(sequence) if sequence else None
    # The policy of the session, or of the state with that identity, even if the default has changed.
    policy = handler.episodes.policy_of(handler.store(), request.policy, request.version, session_id, identity)
    contract = policy.contract
    binary = bool(parse_flag(parameters, "binary_data_output")) if parameters else False
    outputs = _wanted_outputs(contract, document, parameters, binary=binary)
    request.reply_options = ReplyOptions(contract, binary, outputs)
    request.obs = _observation(contract, inputs)
    if parameters or len(inputs) > 1:
        request.episode = _episode(contract, inputs, parameters)


@dataclass(frozen=True, slots=True)
class Answer:
    """A reply of either transport."""

    name: str
    version: str
    parameters: dict[str, Any]
    outputs: dict[str, NDArray[Any]]  # in the requested order
    binary: dict[str, bool]  # by the same names: bytes or JSON


def answer_of(request: Request, decision: Decision) -> Answer:
    """Return the reply's fields by the protocol's names, and its tensors."""
    options: ReplyOptions = request.reply_options
    fields = reply_fields(request, decision)
    name, version = fields.pop("policy"), fields.pop("version")
    if "warnings" in fields:
        fields["warnings"] = "; ".join(fields["warnings"])
    if "session_id" in fields:
        fields["sequence_id"] = fields.pop("session_id")
    if "state" in fields:
        fields[STATE_POLICY] = fields.pop("state")[BELONGS_TO]
    outputs = _outputs(options.contract, decision)
    binary = options.outputs or dict.fromkeys(outputs, options.binary)
    return Answer(name, version, fields, {name: outputs[name] for name in binary}, binary)


def _outputs(contract: Contract, decision: Decision) -> dict[str, NDArray[Any]]:
    """Return all outputs of the model, by tensor name."""
    outputs: dict[str, NDArray[Any]] = action_leaves(contract.action_space, decision.action)
    if decision.episode is not None and decision.episode.state is not None:
        carried = decision.episode.state
        outputs.update({STATE_OUT + state.name: carried[state.name] for state in contract.state})
    return outputs


def _parse_document(
    view: memoryview, length: int | None, model: str
) -> tuple[dict[str, Any], dict[str, NDArray[Any]], bool]:
    """Return (the JSON document, the inputs by name, whether the JSON held NaN)."""
    if length is not None and length > len(view):
        raise RequestError(f"Inference-Header-Content-Length is {length}, but the body has {len(view)} bytes")
    header, raw = (view, view[:0]) if length is None else (view[:length], view[length:])
    document, non_finite = parse_json(header, such_as=SUCH_AS)
    if document.pop(MODEL_NAME, None) not in (None, model):
        raise RequestError(f"'{MODEL_NAME}' differs from '{model[:64]}', which the path names")
    unknown = next((field for field in document if field not in REQUEST_FIELDS), None)
    if unknown is not None:
        raise RequestError(f"unknown field '{unknown[:64]}': expected one of {', '.join(sorted(REQUEST_FIELDS))}")
    if document.get("id") is not None and type(document["id"]) is not str:
        raise RequestError(f"'id' must be a string, got {json_type(document['id'])}")
    if document.get("parameters") is not None and type(document["parameters"]) is not dict:
        raise RequestError(f"'parameters' must be an object, got {json_type(document['parameters'])}")
    tensors = document.get("inputs")
    if type(tensors) is not list or not tensors:
        raise RequestError(f"'inputs' must be a list of tensors: send {SUCH_AS}")
    inputs: dict[str, NDArray[Any]] = {}
    offset = 0
    for tensor in tensors:
        name, array, offset = parse_tensor(tensor, raw, offset)
        if name in inputs:
            raise RequestError(f"input '{name[:64]}' is given twice")
        inputs[name] = array
    if offset != len(raw):
        raise RequestError(f"the body has {len(raw) - offset} bytes after the last tensor's data")
    return document, inputs, non_finite


def _raw_input(contract: Contract, view: memoryview) -> NDArray[Any]:
    """Read a body without JSON: the only input's bytes; their number gives the batch size."""
    if len(contract.inputs) != 1:
        names = ", ".join(tensor.name for tensor in contract.inputs)
        raise RequestError(f"a body without JSON is for models with one input; this one has {names}")
    tensor = contract.inputs[0]
    dtype = DTYPES[datatype_of(tensor.dtype)]
    row = dtype.itemsize * int(np.prod(tensor.shape[1:]))
    if len(view) % row:
        raise ObservationError(
            f"input '{tensor.name}' takes {row} bytes per observation, but the body has {len(view)}: not a multiple"
        )
    return from_bytes(tensor.name, view, (len(view) // row, *tensor.shape[1:]), dtype)


def _observation(contract: Contract, inputs: Mapping[str, NDArray[Any]]) -> Any:
    """Return the policy's observation batch out of the named inputs, whose names and shapes are checked."""
    listed: Sequence[TensorSpec] = contract.inputs
    known = [tensor.name for tensor in listed]
    unknown = next((name for name in inputs if name not in known), None)
    if unknown is not None:  # a last action, which is an input that the contract does not list, or a mistake
        listed = [*listed, *last_action_inputs(contract)]
        unknown = next((name for name in inputs if all(name != tensor.name for tensor in listed)), None)
    if unknown is not None:
        raise ObservationError(f"policy '{contract.name}' has no input '{unknown[:64]}': expected {quoted(known)}")
    rows: dict[str, int] = {}
    for expected in listed:
        array = inputs.get(expected.name)
        if array is None:
            if expected.name == REWARD or expected.name.startswith((STATE_IN, LAST_ACTION)):
                continue
            raise ObservationError(f"policy '{contract.name}' needs the input '{expected.name}', which is missing")
        if array.shape[1:] != expected.shape[1:] or array.ndim != len(expected.shape):
            raise ObservationError(
                f"policy '{contract.name}' expects input '{expected.name}' of shape {list(expected.shape)} "
                f"(-1 is the batch), got {list(array.shape)}",
                {"policy": contract.name, "expected_shape": list(expected.shape), "shape": list(array.shape)},
            )
        rows[expected.name] = len(array)
    if len(set(rows.values())) > 1:
        batches = ", ".join(f"{name} {count}" for name, count in rows.items())
        raise ObservationError(f"the inputs of policy '{contract.name}' have different batch sizes: {batches}")
    return build_action(contract.observation_space, inputs, "obs")


def _episode(contract: Contract, inputs: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any]) -> Episode | None:
    """Return the episode fields of the inputs and parameters. Raises RequestError."""
    states: dict[str, Any] = {
        name.removeprefix(STATE_IN): array for name, array in inputs.items() if name.startswith(STATE_IN)
    }
    belongs_to = parameters.get(STATE_POLICY)
    if states and belongs_to is not None:
        if type(belongs_to) is not str:
            raise RequestError(f"'{STATE_POLICY}' must be the string from the last reply")
        states[BELONGS_TO] = belongs_to
    outcome = parse_episode({name: parameters[name] for name in OUTCOME if name in parameters}) or Episode()
    reward = inputs.get(REWARD, outcome.reward)
    last = _last_action(contract, inputs)
    common: dict[str, Any] = {
        "reward": reward, "last_action": last, "final_status": outcome.final_status, "truncated": outcome.truncated,
    }  # fmt: skip
    start, end = bool(parse_flag(parameters, "sequence_start")), bool(parse_flag(parameters, "sequence_end"))
    sequence_id = parameters.get("sequence_id")
    if sequence_id in (None, 0, ""):
        if start and not states:  # a single step, for a client that carries the state afterwards
            return Episode(state={}, **common)
        if not states and all(value is None or value is False for value in common.values()):
            return None
        return Episode(state=states or None, **common)
    return Episode(
        state=states or None,
        session_id=_session_id(sequence_id),
        reset=start,
        end=end,
        **common,
    )


def _session_id(sequence_id: Any) -> SessionId:
    """Return a sequence's id as a session's; an integer and a string of its digits differ. Raises RequestError."""
    if type(sequence_id) in (int, str) and len(str(sequence_id)) < LONGEST_SESSION_ID:
        return sequence_id  # type: ignore[no-any-return]  # mypy does not narrow by the type's own identity
    raise RequestError("'sequence_id' must be an integer, or a string of fewer than 128 characters")


def _last_action(contract: Contract, inputs: Mapping[str, NDArray[Any]]) -> Any:
    """Return the last action that the inputs hold, in the action space's form, or None. Raises ObservationError."""
    given = {name: array for name, array in inputs.items() if name.startswith(LAST_ACTION)}
    if not given:
        return None
    missing = next((tensor.name for tensor in last_action_inputs(contract) if tensor.name not in given), None)
    if missing is not None:
        raise ObservationError(f"policy '{contract.name}' needs '{missing}' too if other last_action inputs are sent")
    return build_action(contract.action_space, given, LAST_ACTION)


def last_action_inputs(contract: Contract) -> list[TensorSpec]:
    """Return the inputs for a last action, with the form of the outputs that gave it."""
    return [
        tensor.model_copy(update={"name": LAST_ACTION + tensor.name.removeprefix("action")})
        for tensor in contract.outputs
        if tensor.name == "action" or tensor.name.startswith("action.")
    ]


def _fill_options(request: Request, parameters: Mapping[str, Any]) -> None:
    """Set the request's options; refuse any that would otherwise be ignored silently."""
    for name in parameters:
        if name not in PARAMETERS and name not in IGNORED:
            raise RequestError(
                f"unknown parameter '{name[:64]}': expected one of {', '.join(sorted(PARAMETERS | IGNORED))}",
                {"known": sorted(PARAMETERS | IGNORED)},
            )
    transport_ms = request.deadline_ms
    parse_options(request, parameters)
    timeout_us = parse_finite(parameters, TIMEOUT, "an integer of microseconds", kinds=(int,))
    if request.deadline_ms is None and timeout_us:
        request.deadline_ms = timeout_us / 1e3
    if transport_ms is not None:
        own_ms = request.deadline_ms
        request.deadline_ms = transport_ms if own_ms is None else min(own_ms, transport_ms)


def _wanted_outputs(
    contract: Contract, document: Mapping[str, Any], parameters: Mapping[str, Any], *, binary: bool
) -> dict[str, bool]:
    """Return the requested outputs, and whether as bytes; an empty result means all.

    Raises RequestError for outputs that do not exist.
    """
    outputs = document.get("outputs")
    if not outputs:
        return {}
    if type(outputs) is not list:
        raise RequestError(f"'outputs' must be a list of {{\"name\": ...}}, got {json_type(outputs)}")
    known = [tensor.name for tensor in offered_outputs(contract)]
    wanted: dict[str, bool] = {}
    for output in outputs:
        name = output.get("name") if type(output) is dict else None
        if type(name) is not str or name not in known:
            given = json_type(output.get("name") if type(output) is dict else output)
            shown = f" '{name[:64]}'" if type(name) is str else f" {given}"
            raise RequestError(f"the output{shown} does not exist: expected {quoted(known)}")
        if name.startswith(STATE_OUT) and parameters.get("sequence_id"):
            raise RequestError(f"the output '{name}' is kept with the sequence: request the action, or carry the state")
        own = output.get("parameters") or {}
        if type(own) is not dict:
            raise RequestError(f"an output's 'parameters' must be an object, got {json_type(own)}")
        refused = next((name for name in ("classification", "shared_memory_region") if name in own), None)
        if refused is not None:
            raise RequestError(f"the output parameter '{refused}' is not supported: leave it out")
        chosen = parse_flag(own, "binary_data")
        wanted[name] = binary if chosen is None else chosen
    return wanted


def offered_inputs(policy: Policy) -> list[TensorSpec]:
    """Return the inputs that this protocol offers: the contract's, and the last action if the step is limited."""
    return [*policy.contract.inputs, *(last_action_inputs(policy.contract) if policy.has_step_limit else ())]


def offered_outputs(contract: Contract) -> list[TensorSpec]:
    """Return the outputs that this protocol offers: actions and states, not the network's internal values."""
    return [
        tensor
        for tensor in contract.outputs
        if tensor.name == "action" or tensor.name.startswith(("action.", STATE_OUT))
    ]


# Bytes: lengths and compression.


def _parse_length(value: bytes | None) -> int | None:
    if value is None:
        return None
    if not value.isdigit() or len(value) > 15:
        raise RequestError(
            f"Inference-Header-Content-Length must be the length of the JSON, got '{value[:32].decode('latin-1')}'"
        )
    return int(value)


def _decompress(body: Body, encoding: bytes, limit: int) -> bytes:
    """Decompress gzip or deflate to at most `limit` bytes: a few kilobytes can unpack to gigabytes."""
    try:
        stream = zlib.decompressobj(zlib.MAX_WBITS | (16 if encoding == b"gzip" else 0))
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
    for encoding, bits in ((b"gzip", zlib.MAX_WBITS | 16), (b"deflate", zlib.MAX_WBITS)):
        if encoding in offered:
            stream = zlib.compressobj(COMPRESSION_LEVEL, wbits=bits)
            headers += ((b"content-encoding", encoding), (b"vary", b"accept-encoding"))
            return stream.compress(content) + stream.flush(), headers
    return content, headers
