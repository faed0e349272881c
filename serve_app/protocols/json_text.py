"""JSON text: parsed with errors that name the mistake in the client's code, and written."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import Any

import orjson
from pydantic_core import from_json

from rlservo.export.contract.errors import RequestError


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
