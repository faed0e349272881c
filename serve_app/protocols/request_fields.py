"""Fields of a request for an action, checked by pydantic and shown in /docs, and the JSON that has them.

Options and the episode's outcome are the same in JSON, in MessagePack and in the Open Inference Protocol's parameters.
A field that is null counts as absent.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping
from functools import cache
from itertools import islice
from typing import Annotated, Any

import orjson
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from pydantic_core import from_json
from typing_extensions import TypedDict

from rlservo.client.formats.request_names import LONGEST_STATUS
from rlservo.errors import RequestError
from rlservo.serve_app.sessions.request import LONGEST_SESSION_ID, Request

MAX_SEED = 2**63 - 1
OBS = (
    "One observation or a batch (distinguished by shape): nested lists in the observation space's shape or, if the "
    "contract names the elements, a map from each name to a number (a batch: to a list of numbers). Dict spaces are "
    "maps, Tuple spaces are lists of their parts."
)
REWARD = "Reward of the last action: for policies that see it, and for recordings."
STATUS = "How the episode ended: the observation is the one after the last action; the reply's action is unused."
DEADLINE = "Milliseconds left when the server receives the request. A late action is not computed."
TIMESTAMP = "Your clock [s], echoed together with the server's times of receipt and reply."
STATE = "A recurrent policy's memory: {} begins an episode; then the last reply's `state`, unchanged."
SESSION = "An id of your choice for requests that belong together; the policy's memory is kept under it."
LAST_ACTION = "The robot's last command: needed if the action's step is limited, and for recordings."

strict = with_config(ConfigDict(strict=True, extra="forbid", allow_inf_nan=False))


class Options(TypedDict, total=False):
    """Options of a request, and the outcome of the last action."""

    explore: Annotated[bool | None, Field(description="Sample the policy's distribution instead of taking its mode.")]
    seed: Annotated[int | None, Field(ge=0, le=MAX_SEED, description="Makes an exploratory action repeatable.")]
    seq: Annotated[int | None, Field(description="Echoed in the reply, so that a late reply is recognised.")]
    deadline_ms: Annotated[float | None, Field(description=DEADLINE)]
    timestamp: Annotated[float | None, Field(description=TIMESTAMP)]
    reward: Annotated[Any, Field(description=REWARD)]
    final_status: Annotated[str | None, Field(min_length=1, max_length=LONGEST_STATUS, description=STATUS)]
    truncated: Annotated[bool | None, Field(description="With `final_status`: cut off, as by a time limit.")]


@strict
class ActRequest(Options, total=False):
    """Request an action."""

    obs: Annotated[Any, Field(description=OBS)]
    state: Annotated[dict[str, Any] | None, Field(description=STATE)]
    session_id: Annotated[str | None, Field(min_length=1, max_length=LONGEST_SESSION_ID, description=SESSION)]
    reset: Annotated[bool | None, Field(description="Begin an episode: a recurrent policy's session needs it first.")]
    end: Annotated[bool | None, Field(description="Forget the session after this request.")]
    last_action: Annotated[Any, Field(description=LAST_ACTION)]


ACT: TypeAdapter[ActRequest] = TypeAdapter(ActRequest)
USUAL = {"obs", "seq", "deadline_ms"}  # fields of every request of our clients
EXPECTED = {  # by pydantic's type of error, for clients that do not speak Python
    "bool_type": "be true or false",
    "dict_type": "be an object",
    "int_type": "be an integer",
    "list_type": "be a list",
    "missing": "be given",
    "string_type": "be a string",
}


@cache
def _known_fields(kind: TypeAdapter[Any]) -> list[str]:
    return sorted(kind.json_schema()["properties"])


def parse_fields(kind: TypeAdapter[Any], document: Mapping[Any, Any], what: str = "field") -> Any:
    """Return a document's checked fields, `what` each is called. Raises RequestError."""
    if kind is ACT and document.keys() <= USUAL and _is_usual(**document):
        return document
    known = _known_fields(kind)
    # Before pydantic describes each of a hundred thousand.
    unknown = [*islice((name for name in document if name not in known), 8)]
    if unknown:
        shown = ", ".join(repr(str(name)[:64]) for name in unknown)
        what += "s" if len(unknown) > 1 else ""
        raise RequestError(f"unknown {what} {shown}: expected one of {', '.join(known)}", {"known": known})
    try:
        return kind.validate_python(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    place = ".".join(str(part)[:64] for part in first["loc"] if part not in ("int", "str")) or f"{what}s"
    if first["type"] == "extra_forbidden":
        raise RequestError(f"unknown {what} '{place}': leave it out")
    expected = EXPECTED.get(first["type"]) or first["msg"].partition(" should ")[2] or first["msg"]
    got = "" if first["type"] == "missing" else f", got {json_type(first['input'])}"
    if first["type"] in ("string_too_short", "string_too_long"):
        got = f", got {len(first['input'])}"
    raise RequestError(f"'{place}' must {expected}{got}")


def _is_usual(obs: Any = None, seq: Any = 0, deadline_ms: Any = 0.0) -> bool:  # noqa: ARG001
    """Return whether pydantic, whose code is seldom in the processor's cache, has nothing to find."""
    return type(seq) is int and type(deadline_ms) is float and math.isfinite(deadline_ms)


def fill_request(request: Request, given: Mapping[str, Any]) -> None:
    """Set a request's fields to checked ones; those that only a protocol has are left to it."""
    for name, value in given.items():
        if value is not None and name in ActRequest.__optional_keys__:
            setattr(request, name, value)


def parse_json(body: bytes | bytearray | memoryview, *, such_as: str) -> tuple[dict[str, Any], bool]:
    """Return the JSON object in `body`, and whether it holds NaN or Infinity, which JSON does not have.

    Raises RequestError.
    """
    document: Any = None
    non_finite = False
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        # A client that sends NaN, Infinity or 1e400 has a broken sensor or a division by zero: pydantic reads these.
        with contextlib.suppress(ValueError):
            document, non_finite = from_json(bytes(body), allow_inf_nan=True), True
        if not non_finite:
            if not bytes(body).strip():
                raise RequestError(f"the request body is empty: send a JSON object such as {such_as}") from error
            raise RequestError(f"the request body is not JSON: {error}") from error
    if type(document) is not dict:
        raise RequestError(f"the request body must be a JSON object such as {such_as}, got {json_type(document)}")
    return document, non_finite


def json_type(value: Any) -> str:
    """Return a JSON value's type, for an error message."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    names: dict[type, str] = {str: "a string", list: "a list", dict: "an object"}
    if type(value) not in (int, float, *names):  # msgpack has other types besides JSON's
        return f"a {type(value).__name__}"
    return names.get(type(value)) or f"the number {value!r:.40}"


def encode_json(document: Mapping[str, Any] | list[Any]) -> bytes:
    """Return a small document's JSON; text that UTF-8 cannot encode is escaped rather than refused."""
    try:
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    except TypeError:
        return json.dumps(document, default=str).encode()
