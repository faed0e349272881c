"""Pages for browsers, from this machine alone: the server's status at `/`, the API's documentation at /docs.

They are static: anyone may open them without a key. The status page fetches its content from `/v1/policies` and
`/metrics`, with the key that its user types if the server requires one, which stays in a variable. A program that
requests `/` gets the reply for an unknown path. /docs is Swagger UI, whose files come with the package
`fastapi-offline`.

Sources: Content Security Policy Level 3; Trusted Types (W3C).
"""

from __future__ import annotations

import asyncio
import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path

from rlservo.serve_app.protocols.error_statuses import JSON_HEADERS, Headers
from rlservo.serve_app.protocols.routing import GET, Answer, Call, Route, RoutingTable
from rlservo.serve_app.server.api_keys import Access

FOLDER = Path(__file__).with_name("page")
SWAGGER_FILES = ("swagger-ui.css", "swagger-ui-bundle.js", "favicon.png")
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
SUMMARIES = {"/": "Status page", "/docs": "Interactive API documentation"}
POLICY = (  # no other page may embed these (clickjacking); without the script, the form with the key goes nowhere
    "default-src 'none'; script-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; "
)
# Text never becomes markup, not even through a bug in the script.
STATUS_POLICY = "style-src 'self'; img-src 'self'; require-trusted-types-for 'script'; trusted-types 'none'"
DOCS_POLICY = "style-src 'self' 'unsafe-inline'; img-src 'self' data:"
HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


def files_of_swagger_ui() -> Path:
    """Return the folder of Swagger UI's files."""
    found = importlib.util.find_spec("fastapi_offline")
    assert found is not None and found.origin is not None  # part of the extra `serve`
    return Path(found.origin).parent / "static"


def routes(table: Callable[[], RoutingTable]) -> list[Route]:
    """Return the routes of the pages, of their files, and of a table's OpenAPI document."""

    @functools.cache
    def write() -> bytes:
        from rlservo.serve_app.protocols.openapi import openapi  # imports FastAPI

        return openapi(table())

    async def document(_call: Call) -> tuple[bytes, Headers]:
        return await asyncio.to_thread(write), JSON_HEADERS

    swagger = files_of_swagger_ui()
    files = {
        "/": FOLDER / "index.html",
        **{f"/page/{file.name}": file for file in sorted(FOLDER.iterdir()) if file.suffix in (".css", ".js", ".svg")},
        "/docs": FOLDER / "docs.html",
        **{f"/docs/{name}": swagger / name for name in SWAGGER_FILES},
    }
    return [
        Route(GET, "/openapi.json", Access.open, "OpenAPI document", document, is_documented=False),
        *(
            Route(GET, path, Access.open, summary, _file(path, file), is_page=path == "/", is_documented=False)
            for path, file in files.items()
            for summary in [SUMMARIES.get(path, "Asset of the API page")]
        ),
    ]


def _file(path: str, file: Path) -> Answer:
    is_docs = path.startswith("/docs")
    own = {
        "content-type": MEDIA_TYPES[file.suffix],
        "content-security-policy": POLICY + (DOCS_POLICY if is_docs else STATUS_POLICY),
        "cache-control": "max-age=86400" if path.startswith("/docs/") else "no-store",
        **({"vary": "Accept"} if path == "/" else {}),
    }
    headers = tuple((name.encode(), value.encode()) for name, value in {**HEADERS, **own}.items())

    async def answer(_call: Call) -> tuple[bytes, Headers]:
        return await asyncio.to_thread(file.read_bytes), headers

    return answer
