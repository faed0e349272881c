"""Messages of the JSON protocol: act request and reply, errors, listings.

The pydantic models describe the wire in the OpenAPI document. Act requests themselves are read by `read_request`, by
hand: it costs a microsecond where a model costs ten, and its sentences name what a robot's programmer got wrong.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import orjson
from pydantic import BaseModel, ConfigDict, Field

from rlservo.export.contract.errors import ObservationError, RequestError
from rlservo.serve_app.episodes.episodes import Episode
from rlservo.serve_app.versions.policy_store import Decision, EpisodeNote

MAX_SEED = 2**63 - 1
LONGEST_SESSION_ID = 128
LONGEST_LENIENT_BODY = 1 << 20  # a larger body with NaN in it is refused without saying where the NaN is
OBS = (
    "One observation or a batch (told apart by shape): nested lists as the observation space is shaped, or, where the "
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
        "limited in its step, it holds the last action, too.",
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
    reward: Any = Field(None, description="What the last action brought, for policies trained to see it.")
    last_action: Any = Field(
        None, description="What the robot was last commanded, where the policy's action is limited in its step."
    )


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


@dataclass(slots=True)  # not frozen, as `Decision`
class Act:
    """An act request whose form has been checked; the observation itself is the policy's to judge."""

    obs: Any
    explore: bool
    seed: int | None
    seq: int | None
    deadline_ms: float | None
    non_finite: bool = False  # the body held NaN or Infinity, which JSON does not have
    episode: Episode | None = None
    timestamp: float | None = None


KNOWN = frozenset(ActRequest.model_fields)
OPTIONS = ("explore", "seed", "seq", "deadline_ms", "timestamp")
OF_EPISODE = frozenset({"state", "session_id", "reset", "end", "reward", "last_action"})


def read_request(body: bytes | bytearray) -> Act:
    """Parse the body of an act request.

    Raises RequestError when it is not a JSON object of the known fields, or ObservationError when it has no `obs`.
    """
    document, non_finite = read_json(body, such_as='{"obs": [...]}')
    if "obs" not in document:
        _check_fields(document)
        raise ObservationError("the request has no 'obs': send {\"obs\": [...]}")
    if len(document) == 1 and not non_finite:  # the usual request
        return Act(document["obs"], False, None, None, None)
    _check_fields(document)
    return Act(document["obs"], *read_options(document), non_finite, read_episode(document), read_timestamp(document))


def read_json(body: bytes | bytearray | memoryview, *, such_as: str) -> tuple[dict[str, Any], bool]:
    """Return the JSON object in `body`, and whether it holds NaN or Infinity, which JSON does not have.

    Raises RequestError.
    """
    non_finite = False
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        document = _read_lenient(bytes(body), error, such_as)
        non_finite = True
    if type(document) is not dict:
        raise RequestError(f"the request body must be a JSON object such as {such_as}, got {json_type(document)}")
    return document, non_finite


def encode_decision(decision: Decision, seq: int | None, clock: Mapping[str, float] | None = None) -> bytes:
    """Return the reply's JSON; `clock` is what `clock()` gave."""
    action = decision.action
    reply = {
        "action": _plain(action),
        "policy": decision.name,
        "version": decision.version,
        "infer_ms": round(decision.infer_ms, 4),
    }
    if seq is not None:
        reply["seq"] = seq
    if decision.notices:
        reply["warnings"] = decision.notices
    if decision.episode is not None:
        reply.update(describe_episode(decision.episode))
        if decision.episode.state is not None:
            reply["state"] = _plain(decision.episode.state)
    if clock is not None:
        reply.update(clock)
    return orjson.dumps(reply, option=orjson.OPT_SERIALIZE_NUMPY)


def describe_episode(note: EpisodeNote) -> dict[str, Any]:
    """Return what a reply says of its session, in every protocol's names."""
    found = {"session_id": note.session_id, "session_step": note.step}
    return {name: value for name, value in found.items() if value is not None}


def clock(timestamp: float, received: float) -> dict[str, float]:
    """Return the client's timestamp and the server's clock at receiving (`time.perf_counter`) and now."""
    now = time.time()
    return {"timestamp": timestamp, "received_at": now - (time.perf_counter() - received), "sent_at": now}


def _plain(action: Any) -> Any:
    """Return an action, or a state, for orjson, which takes no 0-d arrays."""
    if isinstance(action, dict):
        return {key: _plain(part) for key, part in action.items()}
    if isinstance(action, tuple):
        return [_plain(part) for part in action]
    if isinstance(action, str):  # what a state belongs to
        return action
    return action if action.ndim else action.item()


def encode_json(document: Mapping[str, Any]) -> bytes:
    """Return any small document's JSON; text that UTF-8 cannot hold is escaped rather than refused."""
    try:
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    except TypeError:
        return json.dumps(document, default=str).encode()


def _read_lenient(body: bytes, error: orjson.JSONDecodeError, such_as: str) -> Any:
    """Parse what only Python's own parser takes: NaN, Infinity and numbers too large for a double.

    A policy's client that sends them has a broken sensor or a division by zero; "invalid JSON" would not help it.
    """
    if len(body) <= LONGEST_LENIENT_BODY:
        try:
            return json.loads(body)
        except (ValueError, RecursionError):
            pass
    if not body.strip():
        raise RequestError(f"the request body is empty: send a JSON object such as {such_as}") from error
    raise RequestError(f"the request body is not JSON: {error}") from error


def _check_fields(document: dict[str, Any]) -> None:
    unknown = sorted(document.keys() - KNOWN)
    if unknown:
        shown = ", ".join(repr(name[:64]) for name in unknown[:8])
        raise RequestError(
            f"unknown field{'s' if len(unknown) > 1 else ''} {shown}: known are {', '.join(sorted(KNOWN))}",
            {"known": sorted(KNOWN)},
        )


def read_options(document: Mapping[str, Any]) -> tuple[bool, int | None, int | None, float | None]:
    """Return (explore, seed, seq, deadline_ms), the options every protocol has. Raises RequestError."""
    explore = document.get("explore")
    if explore is not None and type(explore) is not bool:
        raise RequestError(f"'explore' must be true or false, got {json_type(explore)}")
    seed = read_integer(document, "seed")
    if seed is not None and not 0 <= seed <= MAX_SEED:
        raise RequestError(f"'seed' must be in 0..{MAX_SEED}, got {json_type(seed)}")
    return bool(explore), seed, read_integer(document, "seq"), read_deadline(document)


def read_episode(document: Mapping[str, Any]) -> Episode | None:
    """Return what a request says of its episode; None when it says nothing. Raises RequestError."""
    if OF_EPISODE.isdisjoint(document):
        return None
    found = {name: document[name] for name in OF_EPISODE if document.get(name) is not None}
    if not found:
        return None
    if type(found.get("state", {})) is not dict:
        raise RequestError(f"'state' must be an object, state names to numbers, got {json_type(found['state'])}")
    session_id = found.get("session_id", "-")
    if type(session_id) is not str or not 0 < len(session_id) <= LONGEST_SESSION_ID:
        raise RequestError(f"'session_id' must be a string of 1 to {LONGEST_SESSION_ID} characters")
    for name in ("reset", "end"):
        if type(found.get(name, False)) is not bool:
            raise RequestError(f"'{name}' must be true or false, got {json_type(found[name])}")
    return Episode(**found)


def read_timestamp(document: Mapping[str, Any]) -> float | None:
    """Return the optional field `timestamp`. Raises RequestError when it is not a finite number."""
    return read_finite(document, "timestamp", "a number of seconds")


def read_integer(document: Mapping[str, Any], name: str) -> int | None:
    """Return an optional integer field. Raises RequestError when it is something else."""
    value = document.get(name)
    if value is None or type(value) is int:
        return value
    raise RequestError(f"'{name}' must be an integer, got {json_type(value)}")


def read_deadline(document: Mapping[str, Any]) -> float | None:
    """Return the optional field `deadline_ms`. Raises RequestError when it is not a finite number."""
    return read_finite(document, "deadline_ms", "a number of milliseconds")


def read_finite(
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


def refuse_non_finite() -> NoReturn:
    """Refuse a body with NaN or Infinity outside of the observation."""
    raise RequestError("the request body holds NaN or Infinity, which JSON does not have: send finite numbers")
