"""JSON: body of an act request to `Request`, decision to a reply's body.

Options and episode fields are the same in MessagePack and in the Open Inference Protocol's `parameters`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from itertools import islice
from typing import Any

import orjson

from rlservo.export.contract.contract import contract_json
from rlservo.export.contract.errors import MediaTypeError, ObservationError, RequestError
from rlservo.serve_app.episodes.request import (
    EPISODE_FIELDS,
    LONGEST_SESSION_ID,
    MAX_SEED,
    REQUEST_FIELDS,
    Episode,
    Request,
    reply_fields,
)
from rlservo.serve_app.protocols.http_endpoint import Body, HttpEndpoint, receive_body
from rlservo.serve_app.protocols.http_errors import JSON, JSON_HEADERS, Headers, check_media_type
from rlservo.serve_app.protocols.json_text import encode_json, json_type, parse_json
from rlservo.serve_app.protocols.routes import GET, POST, Call, Route, of_policy
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL, check_json
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.policy_store import Decision
from rlservo.serve_app.wire.asgi import Receive
from rlservo.serve_app.wire.request_names import LONGEST_STATUS

SUCH_AS = '{"obs": [...]}'


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v1: actions, and the policies served."""

    async def policies(_call: Call) -> tuple[bytes, Headers]:
        return encode_json(listing.describe(handler)), JSON_HEADERS

    async def contract(call: Call) -> tuple[bytes, Headers]:
        policy = handler.store().get(call.params["name"], call.params.get("version"))
        return contract_json(policy.contract).encode(), JSON_HEADERS

    act = HttpEndpoint("json", JsonCodec(handler), handler)
    return [
        *of_policy(POST, "/v1/policies", "/act", "Act", app=act),
        Route(GET, "/v1/policies", Access.act, "Policies and versions served", policies),
        *of_policy(GET, "/v1/policies", "", "Contract", answer=contract),
    ]


class JsonCodec:
    """The JSON protocol's bytes (`Codec`)."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler

    async def receive(self, request: Request, source: Receive) -> Body:
        """Return the body. Raises MediaTypeError, and what `receive_body` raises."""
        headers = request.headers
        if headers.get(b"content-type") != JSON:
            check_media_type(headers, JSON)
        encoding = headers.get(b"content-encoding")
        if encoding is not None and encoding.lower() != b"identity":
            raise MediaTypeError(
                f"the content encoding '{encoding[:32].decode('latin-1')}' is not supported: send plain JSON"
            )
        return await receive_body(self._handler, headers, source)

    def parse(self, request: Request, content: Body) -> None:
        """Fill the request; the policy checks the observation itself.

        Raises TooLargeError when the body holds more than `max_batch` observations can need, RequestError when it is
        not a JSON object of the known fields, ObservationError when it has no `obs`.
        """
        if len(content) > SMALL:
            check_json(self._handler.store(), request.policy, content, self._handler.settings.max_batch)
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


def parse_options(request: Request, document: Mapping[str, Any]) -> None:
    """Set the request's options. Raises RequestError."""
    explore = document.get("explore")
    if explore is not None and type(explore) is not bool:
        raise RequestError(f"'explore' must be true or false, got {json_type(explore)}")
    request.explore = bool(explore)
    request.seed = seed = parse_integer(document, "seed")
    if seed is not None and not 0 <= seed <= MAX_SEED:
        raise RequestError(f"'seed' must be in 0..{MAX_SEED}, got {json_type(seed)}")
    request.seq = parse_integer(document, "seq")
    request.deadline_ms = parse_finite(document, "deadline_ms", "a number of milliseconds")
    request.timestamp = parse_finite(document, "timestamp", "a number of seconds")


def parse_episode(document: Mapping[str, Any]) -> Episode | None:
    """Return a request's episode fields; None if it has none. Raises RequestError."""
    if EPISODE_FIELDS.isdisjoint(document):
        return None
    found = {name: document[name] for name in EPISODE_FIELDS if document.get(name) is not None}
    if not found:
        return None
    if type(found.get("state", {})) is not dict:
        raise RequestError(f"'state' must be an object, state names to numbers, got {json_type(found['state'])}")
    session_id = found.get("session_id", "-")
    if type(session_id) is not str or not 0 < len(session_id) <= LONGEST_SESSION_ID:
        raise RequestError(f"'session_id' must be a string of 1 to {LONGEST_SESSION_ID} characters")
    for name in ("reset", "end", "truncated"):
        if type(found.get(name, False)) is not bool:
            raise RequestError(f"'{name}' must be true or false, got {json_type(found[name])}")
    status = found.get("final_status", "-")
    if type(status) is not str or not 0 < len(status) <= LONGEST_STATUS:
        raise RequestError(f"'final_status' must be a string of 1 to {LONGEST_STATUS} characters")
    return Episode(**found)


def parse_integer(document: Mapping[str, Any], name: str) -> int | None:
    """Return an optional integer field. Raises RequestError when it is something else."""
    value = document.get(name)
    if value is None or type(value) is int:
        return value
    raise RequestError(f"'{name}' must be an integer, got {json_type(value)}")


def parse_finite(
    document: Mapping[str, Any], name: str, expected: str, *, kinds: tuple[type, ...] = (int, float)
) -> float | None:
    """Return an optional field as a float. Raises RequestError if it is anything else, or too large for a float."""
    value = document.get(name)
    if value is None:
        return None
    if type(value) in kinds:
        with contextlib.suppress(OverflowError):  # JSON's integers are unbounded
            number = float(value)
            if math.isfinite(number):
                return number
    raise RequestError(f"'{name}' must be {expected}, got {json_type(value)}")


def _check_fields(document: dict[str, Any]) -> None:
    unknown = [*islice((name for name in document if name not in REQUEST_FIELDS), 8)]
    if unknown:
        shown = ", ".join(repr(name[:64]) for name in unknown)
        known = sorted(REQUEST_FIELDS)
        raise RequestError(
            f"unknown field{'s' if len(unknown) > 1 else ''} {shown}: expected one of {', '.join(known)}",
            {"known": known},
        )
    if "obs" not in document:
        raise ObservationError(f"the request has no 'obs': send {SUCH_AS}")


def _plain(action: Any) -> Any:
    """Return an action or a state in a form for orjson, which rejects 0-d arrays."""
    if isinstance(action, dict):
        return {key: _plain(part) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_plain(part) for part in action]
    if isinstance(action, str):  # the policy that a state belongs to
        return action
    return action if action.ndim else action.item()
