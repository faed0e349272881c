"""JSON: body of an act request to `Request`, decision to a reply's body."""

from __future__ import annotations

from typing import Any

import orjson
from starlette.types import Receive

from rlservo.export.contract.errors import MediaTypeError, ObservationError, RequestError
from rlservo.serve_app.episodes.request import REQUEST_FIELDS, Request, parse_episode, parse_options
from rlservo.serve_app.protocols.http_endpoint import Body, receive_body
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers
from rlservo.serve_app.protocols.json_messages import parse_json
from rlservo.serve_app.protocols.media_types import check_media_type
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.reply import reply_fields
from rlservo.serve_app.versions.policy_store import Decision

SUCH_AS = '{"obs": [...]}'


class JsonCodec:
    """The JSON protocol's bytes (`Codec`)."""

    def __init__(self, core: Core) -> None:
        self._core = core

    async def receive(self, request: Request, source: Receive) -> Body:
        """Return the body. Raises MediaTypeError, and what `receive_body` raises."""
        headers = request.headers
        if headers.get(b"content-type") != JSON:
            check_media_type(headers, JSON)
        encoding = headers.get(b"content-encoding")
        if encoding is not None and encoding.lower() != b"identity":
            raise MediaTypeError(
                f"the content encoding '{encoding[:32].decode('latin-1')}' is not read: send plain JSON"
            )
        return await receive_body(self._core, headers, source)

    def parse(self, request: Request, content: Body) -> None:
        """Fill the request; the observation itself is the policy's to judge.

        Raises RequestError when the body is not a JSON object of the known fields, ObservationError when it has no
        `obs`.
        """
        try:
            document = orjson.loads(content)
        except orjson.JSONDecodeError:
            document = None
        if type(document) is not dict:
            document, request.non_finite = parse_json(content, such_as=SUCH_AS)
        if len(document) > 1 or "obs" not in document:  # not the usual request
            _check_fields(document)
            parse_options(request, document)
            request.episode = parse_episode(document)
        request.obs = document["obs"]

    def encode(self, request: Request, decision: Decision) -> tuple[bytes, Headers]:
        """Return the reply's body and headers."""
        fields = {"action": _plain(decision.action), **reply_fields(request, decision)}
        if "state" in fields:
            fields["state"] = _plain(fields["state"])
        return orjson.dumps(fields, option=orjson.OPT_SERIALIZE_NUMPY), JSON_HEADERS


def _check_fields(document: dict[str, Any]) -> None:
    unknown = sorted(document.keys() - REQUEST_FIELDS)
    if unknown:
        shown = ", ".join(repr(name[:64]) for name in unknown[:8])
        known = sorted(REQUEST_FIELDS)
        raise RequestError(
            f"unknown field{'s' if len(unknown) > 1 else ''} {shown}: known are {', '.join(known)}", {"known": known}
        )
    if "obs" not in document:
        raise ObservationError(f"the request has no 'obs': send {SUCH_AS}")


def _plain(action: Any) -> Any:
    """Return an action, or a state, for orjson, which takes no 0-d arrays."""
    if isinstance(action, dict):
        return {key: _plain(part) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_plain(part) for part in action]
    if isinstance(action, str):  # what a state belongs to
        return action
    return action if action.ndim else action.item()
