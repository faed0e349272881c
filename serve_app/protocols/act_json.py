"""JSON: body of an act request to `Request`, decision to a reply's body."""

from __future__ import annotations

import numpy as np
import orjson
from starlette.types import Receive

from rlservo.bundle.contract import contract_json
from rlservo.errors import ObservationError
from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, Headers
from rlservo.serve_app.protocols.http_endpoint import (
    Body,
    act_over_http,
    check_media_type,
    content_encoding,
    receive_body,
)
from rlservo.serve_app.protocols.request_fields import ACT, encode_json, fill_request, parse_fields, parse_json
from rlservo.serve_app.protocols.routing import GET, POST, Call, Route, of_policy
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.content_bounds import SMALL, check_json
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.sessions.request import Request, reply_fields
from rlservo.serve_app.versions.policy_store import Decision

SUCH_AS = '{"obs": [...]}'


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v1: actions, and the policies served."""

    async def policies(_call: Call) -> tuple[bytes, Headers]:
        return encode_json(listing.describe(handler)), JSON_HEADERS

    async def contract(call: Call) -> tuple[bytes, Headers]:
        policy = handler.store().get(call.params["name"], call.params.get("version"))
        return contract_json(policy.contract).encode(), JSON_HEADERS

    act = act_over_http("json", JsonCodec(), handler)
    return [
        *of_policy(POST, "/v1/policies", "/act", "Act", act, reads_body=True),
        Route(GET, "/v1/policies", Access.act, "Policies and versions served", policies),
        *of_policy(GET, "/v1/policies", "", "Contract", contract),
    ]


class JsonCodec:
    """The JSON protocol's bytes (`Codec`)."""

    async def receive(self, handler: RequestHandler, request: Request, source: Receive) -> Body:
        """Return the body. Raises MediaTypeError, and what `receive_body` raises."""
        check_media_type(request.headers)
        content_encoding(request.headers)
        return await receive_body(handler, request.headers, source)

    def parse(self, handler: RequestHandler, request: Request, content: Body) -> None:
        """Fill the request; the policy checks the observation itself.

        Raises TooLargeError when the body holds more than `max_batch` observations can need, RequestError when it is
        not a JSON object of the known fields, ObservationError when it has no `obs`.
        """
        if len(content) > SMALL:
            check_json(handler.store(), request.policy, content, handler.settings.max_batch)
        document, request.non_finite = parse_json(content, such_as=SUCH_AS)
        fill_request(request, parse_fields(ACT, document))
        if "obs" not in document:
            raise ObservationError(f"the request has no 'obs': send {SUCH_AS}")

    def encode(self, request: Request, decision: Decision) -> tuple[bytes, Headers]:
        """Return the reply's body and headers."""
        fields = {"action": decision.action, **reply_fields(request, decision)}
        # orjson leaves arrays without an axis, of discrete actions, to `default`.
        return orjson.dumps(fields, default=np.ndarray.tolist, option=orjson.OPT_SERIALIZE_NUMPY), JSON_HEADERS
