"""Fields of a request for an action: types, bounds and descriptions, checked by pydantic and shown in /docs.

Options and the episode's outcome are the same in JSON, in MessagePack and in the Open Inference Protocol's parameters.
A field that is null counts as absent.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import islice
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.episodes.request import EPISODE_FIELDS, LONGEST_SESSION_ID, NO_EPISODE, Episode, Request
from rlservo.serve_app.protocols.json_text import json_type
from rlservo.serve_app.wire.request_names import LONGEST_STATUS

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
    seed: Annotated[int | None, Field(ge=0, le=MAX_SEED, description="Makes an exploring action repeatable.")]
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
REQUEST_FIELDS = ActRequest.__optional_keys__
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
    known = _known_fields(kind)
    faults: list[Any] = []
    unknown: list[tuple[Any, ...]] = []
    if len(document) > len(known):  # pydantic would describe each of a hundred thousand unknown ones
        unknown = [(name,) for name in islice((name for name in document if name not in known), 8)]
    else:
        try:
            return kind.validate_python(document)
        except ValidationError as error:
            faults = error.errors(include_url=False)
        unknown = [*islice((each["loc"] for each in faults if each["type"] == "extra_forbidden"), 8)]
    if unknown:
        shown = ", ".join(repr(".".join(map(str, place))[:64]) for place in unknown)
        what += "s" if len(unknown) > 1 else ""
        if len(unknown[0]) > 1:
            raise RequestError(f"unknown {what} {shown}: leave it out")
        raise RequestError(f"unknown {what} {shown}: expected one of {', '.join(known)}", {"known": known})
    first = faults[0]
    place = ".".join(str(part)[:64] for part in first["loc"] if part not in ("int", "str")) or f"{what}s"
    expected = EXPECTED.get(first["type"]) or first["msg"].partition(" should ")[2] or first["msg"]
    raise RequestError(f"'{place}' must {expected}, got {json_type(first['input'])}")


def fill_request(request: Request, given: Mapping[str, Any]) -> Episode:
    """Set a request's options to checked fields; return those of its episode."""
    said = {}
    for name, value in given.items():
        if value is not None:
            if name in EPISODE_FIELDS:
                said[name] = value
            elif name in Options.__optional_keys__:
                setattr(request, name, value)
    return Episode(**said) if said else NO_EPISODE
