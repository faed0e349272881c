"""MessagePack as openpi's policy server speaks it: frame to `Request`, decision to a frame.

A request is `{"obs": ...}` with the JSON protocol's options, or the observation map itself, from element name to value.
Further fields of openpi's clients (`prompt`) are ignored, unless an element has that name.
`actions` in the reply is a chunk of one action, `(1, ...)`, as openpi's clients expect; a batch of observations gets
one chunk each.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import RequestError, TooLargeError
from rlservo.export.contract.spaces import DictSpec
from rlservo.serve_app.episodes.request import Episode, Request, reply_fields
from rlservo.serve_app.protocols.request_fields import ACT, fill_request, parse_fields
from rlservo.serve_app.server.content_bounds import SMALL, check_length
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.policy_store import Decision
from rlservo.serve_app.wire.asgi import Message
from rlservo.serve_app.wire.msgpack_arrays import pack, unpack

IGNORED = frozenset({"prompt", "env_id"})
"""Fields that openpi's clients send for other policies (task, robot); ignored here."""


class MsgpackCodec:
    """The stream's bytes (`Codec`)."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler
        self._max_bytes = handler.settings.max_body_bytes

    async def receive(self, request: Request, source: Message) -> Mapping[Any, Any]:
        """Return the map in a frame, and note its `seq` for an error's frame. Raises RequestError."""
        content = source.get("bytes")
        if content is None:
            raise RequestError("the message is a text frame: send msgpack in a binary frame")
        if len(content) > self._max_bytes:
            raise TooLargeError(f"the message is larger than {self._max_bytes} bytes", {"max_bytes": self._max_bytes})
        document = unpack(content, most=self._most_values(request, content) if len(content) > SMALL else None)
        if type(document) is not dict:
            raise RequestError(f"the message must be a map such as {{'obs': ...}}, got {type(document).__name__}")
        if "obs" in document and type(document.get("seq")) is int:
            request.seq = document["seq"]
        return document

    def parse(self, request: Request, content: Mapping[Any, Any]) -> None:
        """Fill the request. Raises RequestError."""
        if not IGNORED.isdisjoint(content):
            content = {key: value for key, value in content.items() if key not in IGNORED or self._names(request, key)}
        if "obs" not in content:  # element names and values
            request.obs = content
            if type(content.get("reset")) is bool and not self._names(request, "reset"):
                request.obs = {name: value for name, value in content.items() if name != "reset"}
                request.episode = Episode(reset=content["reset"])
        else:
            request.obs = content["obs"]
            if len(content) > 1:
                request.episode = fill_request(request, parse_fields(ACT, content))

    def encode(self, request: Request, decision: Decision) -> bytes:
        """Return the reply's frame; `reply_options` are further timings."""
        fields = reply_fields(request, decision)
        fields["actions"] = _chunks(decision.action, batch=decision.batch is not None)
        fields["server_timing"] = {"infer_ms": fields.pop("infer_ms"), **(request.reply_options or {})}
        return pack(fields)

    def _most_values(self, request: Request, content: bytes) -> int:
        store, max_batch = self._handler.store(), self._handler.settings.max_batch
        return max(bounds.values for bounds in check_length(store, request.policy, content, max_batch))

    def _names(self, request: Request, name: str) -> bool:
        """Return whether an observation of the request's policy has a part or an element of that name."""
        stream = request.stream
        policy = self._handler.store().get(request.policy, request.version) if stream is None else stream.policy
        space = policy.contract.observation_space
        if isinstance(space, DictSpec):
            return name in space.spaces or name in space.ignored
        return any(name == element.name for element in space.elements)


def encode_metadata(contract: Contract) -> bytes:
    """Return the frame that a client gets on connecting: the policy's name and version, and the whole contract."""
    return pack(
        {
            "server": "rlservo",
            "policy": contract.name,
            "version": contract.version,
            "control_rate_hz": contract.control_rate_hz,
            "action_horizon": 1,  # steps in a chunk, as in a reply's `actions`
            "contract": contract.model_dump(mode="json"),
        }
    )


def _chunks(action: Any, *, batch: bool) -> Any:
    """Return the action as chunks of one; each leaf of a nested one is a chunk."""
    if isinstance(action, dict):
        return {key: _chunks(part, batch=batch) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_chunks(part, batch=batch) for part in action]
    return action[:, None, ...] if batch else action[None, ...]
