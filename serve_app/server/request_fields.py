"""Fields of a request that every protocol has: options and episode, checked.

JSON and MessagePack have them in the message itself, the Open Inference Protocol has the options in its `parameters`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.episodes.request import Episode, Request

MAX_SEED = 2**63 - 1
LONGEST_SESSION_ID = 128
OPTIONS = ("explore", "seed", "seq", "deadline_ms", "timestamp")
LONGEST_STATUS = 64
EPISODE_FIELDS = frozenset(
    {"state", "session_id", "reset", "end", "reward", "last_action", "final_status", "truncated"}
)
REQUEST_FIELDS = frozenset({"obs", *OPTIONS, *EPISODE_FIELDS})


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
    """Return what a request says of its episode; None when it says nothing. Raises RequestError."""
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
    """Return an optional field as a float. Raises RequestError when it is something else, or no float can hold it."""
    value = document.get(name)
    if value is None:
        return None
    if type(value) in kinds:
        with contextlib.suppress(OverflowError):  # JSON's integers have no end
            number = float(value)
            if math.isfinite(number):
                return number
    raise RequestError(f"'{name}' must be {expected}, got {json_type(value)}")


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
