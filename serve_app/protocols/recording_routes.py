"""Recordings over HTTP: the files' names and sizes, and their bytes from any offset, for a remote learner.

Files only grow, so a copy continues at its end. Reading them needs an admin key.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.protocols.http_errors import JSON_HEADERS, Headers
from rlservo.serve_app.protocols.json_text import encode_json
from rlservo.serve_app.protocols.routes import GET, Call, Route
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.request_handler import RequestHandler

MOST_BYTES = 8 << 20  # in a reply
OCTETS: Headers = ((b"content-type", b"application/octet-stream"),)


def routes(handler: RequestHandler) -> list[Route]:
    """Return the routes of /v1/admin/recordings."""

    def folder() -> Path:
        if handler.settings.record is None:
            raise RequestError("this server does not record: start it with --record FOLDER")
        return Path(handler.settings.record)

    def sizes() -> dict[str, int]:
        return {path.name: path.stat().st_size for path in sorted(folder().glob("*.mcap"))}

    def piece(file: str, begin: str) -> bytes:
        if not begin.isdigit() or len(begin) > 18:
            raise RequestError(f"{begin[:40]!r} is not an offset in a recording: expected a number, 0 or more")
        path = folder() / file
        if path.suffix != ".mcap" or not path.is_file():  # perhaps deleted since it was listed, as the oldest ones are
            return b""
        with path.open("rb") as stream:
            stream.seek(int(begin))
            return stream.read(MOST_BYTES)

    async def recordings(_call: Call) -> tuple[bytes, Headers]:
        return encode_json(await asyncio.to_thread(sizes)), JSON_HEADERS

    async def recording(call: Call) -> tuple[bytes, Headers]:
        return await asyncio.to_thread(piece, call.params["file"], call.params["begin"]), OCTETS

    place = "/v1/admin/recordings"
    return [
        Route(GET, place, Access.admin, "Recordings and their sizes [bytes], by name", recordings),
        Route(GET, f"{place}/{{file}}/{{begin}}", Access.admin, "Bytes of a recording, at most 8 MiB", recording),
    ]
