"""Messages of the JSON protocol, as the OpenAPI document describes them, and JSON text.

Requests are parsed by `json_codec.py`, by hand: it costs a microsecond where a pydantic model costs ten, and its
sentences name what a robot's programmer got wrong.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import orjson
from pydantic import BaseModel, ConfigDict, Field

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.episodes.request import LONGEST_SESSION_ID, MAX_SEED
from rlservo.serve_app.wire.request_names import LONGEST_STATUS

LONGEST_LENIENT_BODY = 1 << 20  # a larger body with NaN in it is refused without saying where the NaN is
OBS = (
    "One observation or a batch (distinguished by shape): nested lists as the observation space is shaped, or, if the "
    "contract names the elements, a map from each name to a number (a batch: to a list of numbers). Dict spaces are "
    "maps, Tuple spaces lists of their parts."
)


class ActRequest(BaseModel):
    """Ask for an action."""

    model_config = ConfigDict(extra="forbid")

    obs: Any = Field(description=OBS)
    explore: bool = Field(False, description="Sample the policy's action distribution instead of taking its mode.")
    seed: int | None = Field(None, ge=0, le=MAX_SEED, description="Makes an exploring action repeatable.")
    seq: int | None = Field(None, description="Echoed in the reply, so that a late reply is not taken for a new one.")
    deadline_ms: float | None = Field(
        None,
        description="Milliseconds left, from when the server receives the request. Work that cannot arrive in time is "
        "not done: 408.",
    )
    timestamp: float | None = Field(
        None, description="Your clock [s], echoed together with the server's when it received and answered."
    )
    state: dict[str, Any] | None = Field(
        None,
        description="A recurrent policy's memory, carried by you: {} begins an episode, then what the last reply gave, "
        "all of it: it names the version that it is of (`@policy`), and goes to no other. Where a policy's action is "
        "limited in its step, it also holds the last action.",
    )
    session_id: str | None = Field(
        None,
        min_length=1,
        max_length=LONGEST_SESSION_ID,
        description="An id of your choice for requests that belong together. Where a canary runs they get the same "
        "version. A recurrent policy's memory stays with the server under it; its requests are computed one at a "
        "time, in the order they arrive, and one with the seq of the last gets its answer again.",
    )
    reset: bool = Field(False, description="Begin an episode: the first request of a recurrent policy's session.")
    end: bool = Field(False, description="Forget the session after this request.")
    reward: Any = Field(
        None,
        description="What the last action brought: for policies trained to see it, and for a recording.",
    )
    last_action: Any = Field(
        None,
        description="What the robot was last commanded: where the policy's action is limited in its step, and for a "
        "recording.",
    )
    final_status: str | None = Field(
        None,
        min_length=1,
        max_length=LONGEST_STATUS,
        description="How the episode ended, for a recording: `obs` is what followed its last action, and "
        "the action of the reply is not used.",
    )
    truncated: bool = Field(False, description="With `final_status`: the episode was broken off, as by a time limit.")


class ActReply(BaseModel):
    """An action, ready for the environment's `step`."""

    action: Any = Field(description="Shaped as the action space is; for a batch, one such action per observation.")
    policy: str
    version: str
    seq: int | None = Field(None, description="As sent.")
    infer_ms: float = Field(
        description="Milliseconds spent on checking the observation, the network (where it ran for several requests at "
        "once, the whole run) and checking the action."
    )
    state: dict[str, Any] | None = Field(None, description="For the next request, where you carry the state.")
    session_id: str | None = Field(None, description="As sent.")
    session_step: int | None = Field(None, description="Which action of the session's episode this is, from 1.")
    warnings: list[str] | None = Field(None, description="What was out of bounds or limited, and used all the same.")
    timestamp: float | None = Field(None, description="As sent.")
    received_at: float | None = Field(None, description="The server's clock [s since 1970] when the request came.")
    sent_at: float | None = Field(None, description="The same when the reply was written.")


class ErrorReply(BaseModel):
    """Every answer that is not a success."""

    error: str = Field(description="A sentence: what was given, what was expected, which element.")
    code: str = Field(description="Kebab-case, for programs: for example `bad-observation`.")
    details: dict[str, Any] | None = None


def parse_json(body: bytes | bytearray | memoryview, *, such_as: str) -> tuple[dict[str, Any], bool]:
    """Return the JSON object in `body`, and whether it holds NaN or Infinity, which JSON does not have.

    Raises RequestError.
    """
    non_finite = False
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        document = _parse_lenient(bytes(body), error, such_as)
        non_finite = True
    if type(document) is not dict:
        raise RequestError(f"the request body must be a JSON object such as {such_as}, got {json_type(document)}")
    return document, non_finite


def json_type(value: Any) -> str:
    """Say what a JSON value is, for an error's sentence."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    names: dict[type, str] = {str: "a string", list: "a list", dict: "an object"}
    if type(value) not in (int, float, *names):  # msgpack brings other things than JSON
        return f"a {type(value).__name__}"
    return names.get(type(value)) or f"the number {value!r:.40}"


def encode_json(document: Mapping[str, Any]) -> bytes:
    """Return any small document's JSON; text that UTF-8 cannot hold is escaped rather than refused."""
    try:
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    except TypeError:
        return json.dumps(document, default=str).encode()


def _parse_lenient(body: bytes, error: orjson.JSONDecodeError, such_as: str) -> Any:
    """Parse NaN, Infinity and numbers too large for a double, which Python's own parser takes.

    A policy's client that sends them has a broken sensor or a division by zero; "invalid JSON" would not help it. What
    else Python's parser takes (half a surrogate pair) is not JSON.
    """
    non_finite = False

    def number(text: str) -> int | float:
        nonlocal non_finite
        non_finite = non_finite or not math.isfinite(float(text))
        return int(text) if text.lstrip("-").isdigit() else float(text)

    if len(body) <= LONGEST_LENIENT_BODY:
        try:
            document = json.loads(body, parse_float=number, parse_int=number, parse_constant=number)
        except (ValueError, RecursionError):
            document = None
        if non_finite and document is not None:
            return document
    if not body.strip():
        raise RequestError(f"the request body is empty: send a JSON object such as {such_as}") from error
    raise RequestError(f"the request body is not JSON: {error}") from error
