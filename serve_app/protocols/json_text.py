"""JSON text: parsed with errors that name the mistake in the client's code, and written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import orjson

from rlservo.export.contract.errors import RequestError

LONGEST_LENIENT_BODY = 1 << 20  # a larger body with NaN in it is refused without saying where the NaN is


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


def _parse_lenient(body: bytes, error: orjson.JSONDecodeError, such_as: str) -> Any:
    """Parse NaN, Infinity and numbers too large for a double, which Python's own parser takes.

    A client that sends them has a broken sensor or a division by zero; "invalid JSON" would not help it. Anything else
    that Python's parser accepts (half a surrogate pair) is not JSON.
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
