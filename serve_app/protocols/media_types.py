"""Check of a request's content type.

A web page can send forms, plain text and bodies of no type to any server; for another type a browser asks the server
first.
"""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import Request

from rlservo.export.contract.errors import MediaTypeError
from rlservo.serve_app.protocols.http_errors import JSON
from rlservo.serve_app.server.access_checks import HEADERS


def check_media_type(headers: Mapping[bytes, bytes], *accepted: bytes, optional: bool = False) -> None:
    """Raise MediaTypeError unless the body is of an accepted content type.

    Triton's client names no type: `optional` lets through who does not, unless it is a browser.
    """
    given = headers.get(b"content-type")
    usage = f"send {accepted[0].decode()} (curl: -H 'content-type: {accepted[0].decode()}')"
    if given is None:
        if not optional or b"origin" in headers or b"sec-fetch-site" in headers:
            raise MediaTypeError(f"the request has no content type: {usage}")
    elif given not in accepted and given.split(b";", 1)[0].strip().lower() not in accepted:
        raise MediaTypeError(f"the content type is '{given[:64].decode('latin-1')}': {usage}")


async def accept_json(request: Request) -> None:
    """Raise MediaTypeError for what is not JSON: a dependency of the routes that FastAPI runs."""
    check_media_type(request.scope[HEADERS], JSON)
