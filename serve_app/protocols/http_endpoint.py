"""HTTP requests for actions: their headers, their body, and whether their client still waits."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from functools import partial

from starlette.types import Receive

from rlservo.errors import MediaTypeError
from rlservo.serve_app.protocols.error_statuses import JSON, Headers, too_large
from rlservo.serve_app.protocols.routing import Answer, Call
from rlservo.serve_app.server.request_handler import Codec, RequestHandler
from rlservo.serve_app.sessions.request import ClientGoneError

HANG_UP_TURNS = 4
OCTETS = b"application/octet-stream"

Body = bytes | bytearray


def act_over_http(protocol: str, codec: Codec[Receive, tuple[bytes, Headers]], handler: RequestHandler) -> Answer:
    """Return the answer to a protocol's requests for actions; its name is for metrics and logs."""

    async def answer(call: Call) -> tuple[bytes, Headers]:
        request = call.request(protocol, call.params["name"], call.params.get("version"))
        client = call.scope.get("client")
        request.connection = client if client is not None and client[1] else None  # 0: a proxy
        request.has_hung_up = partial(has_hung_up, call.receive)
        return await handler.answer(codec, request, call.receive)

    return answer


async def has_hung_up(receive: Receive) -> bool:
    """Return whether the client has closed its connection after sending a complete request.

    The event loop takes one turn to read the close, one to close the connection, and two to report it here.
    """
    message = asyncio.ensure_future(receive())
    for _ in range(HANG_UP_TURNS):
        await asyncio.sleep(0)
    if not message.done():
        message.cancel()
        return False
    return bool(message.result()["type"] == "http.disconnect")


def check_media_type(headers: Mapping[bytes, bytes], *others: bytes, optional: bool = False) -> None:
    """Raise MediaTypeError unless the body is JSON, or of one of the `others`.

    A web page can send forms, plain text and bodies of no type to any server; for other types a browser asks the server
    first. Triton's client names no type: `optional` accepts that, except from a browser.
    """
    given = headers.get(b"content-type")
    if given == JSON:
        return
    usage = f"send {JSON.decode()} (curl: -H 'content-type: {JSON.decode()}')"
    if given is None:
        if not optional or b"origin" in headers or b"sec-fetch-site" in headers:
            raise MediaTypeError(f"the request has no content type: {usage}")
    elif given.split(b";", 1)[0].strip().lower() not in (JSON, *others):
        raise MediaTypeError(f"the content type is '{given[:64].decode('latin-1')}': {usage}")


def content_encoding(headers: Mapping[bytes, bytes], *accepted: bytes) -> bytes:
    """Return how the body is compressed, b"" if it is not. Raises MediaTypeError if it may not be."""
    given = headers.get(b"content-encoding")
    if given is None or (encoding := given.strip().lower()) in (b"", b"identity"):
        return b""
    if encoding not in accepted:
        wanted = " or ".join([*(each.decode() for each in accepted), "plain JSON"])
        raise MediaTypeError(f"the content encoding '{given[:32].decode('latin-1')}' is not supported: send {wanted}")
    return encoding


async def receive_body(handler: RequestHandler, headers: Mapping[bytes, bytes], receive: Receive) -> Body:
    """Return a request's body within the server's limits. The first message usually holds all of it.

    Every body enters this process here; its time limit is enforced by the connection (`engines/connection_bounds.py`).
    Raises TooLargeError, OverloadedError and ClientGoneError.
    """
    max_bytes = handler.settings.max_body_bytes
    length = headers.get(b"content-length", b"")
    if length.isdigit() and len(length) < 20 and int(length) > max_bytes:
        raise too_large(max_bytes)
    message = await receive()
    body: Body = message.get("body", b"")
    if message.get("more_body", False):
        with handler.admission.reading_body():
            body = bytearray(body)
            while message.get("more_body", False) and len(body) <= max_bytes:
                message = await receive()
                body += message.get("body", b"")
    if message["type"] == "http.disconnect":
        raise ClientGoneError
    if len(body) > max_bytes:
        raise too_large(max_bytes)
    return body
