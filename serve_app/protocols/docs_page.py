"""API documentation at /docs and /openapi.json, served entirely by this machine: no CDN.

The page is Swagger UI, whose files come with the package `fastapi-offline`.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import importlib.util
from collections.abc import Callable
from pathlib import Path

from rlservo.serve_app.protocols.http_errors import JSON_HEADERS, Headers
from rlservo.serve_app.protocols.routes import GET, Answer, Call, Route, RoutingTable
from rlservo.serve_app.server.api_keys import Access

MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".png": "image/png"}
FILES = ("swagger-ui.css", "swagger-ui-bundle.js", "favicon.png")
# Addresses are relative, so that the page also works behind a route prefix. No validator badge: it would contact
# validator.swagger.io.
SCRIPT = """
SwaggerUIBundle({url: "openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout"});
"""
PAGE = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>rlservo API</title>
<link rel="stylesheet" href="docs/swagger-ui.css">
<link rel="icon" type="image/png" href="docs/favicon.png">
</head>
<body>
<div id="swagger-ui"></div>
<script src="docs/swagger-ui-bundle.js"></script>
<script>{SCRIPT}</script>
</body>
</html>
"""
SCRIPT_HASH = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
HEADERS: Headers = (
    (b"content-type", b"text/html; charset=utf-8"),
    # "Try it out" acts on the visitor's behalf: no other page may embed this one (clickjacking).
    (
        b"content-security-policy",
        f"default-src 'none'; script-src 'self' 'sha256-{SCRIPT_HASH}'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'".encode(),
    ),
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
)


def files_of_swagger_ui() -> Path:
    """Return the folder of Swagger UI's files."""
    found = importlib.util.find_spec("fastapi_offline")
    assert found is not None and found.origin is not None  # part of the extra `serve`
    return Path(found.origin).parent / "static"


def routes(table: Callable[[], RoutingTable]) -> list[Route]:
    """Return the routes of the page, its files and a table's document."""
    written: list[bytes] = []

    async def page(_call: Call) -> tuple[bytes, Headers]:
        return PAGE.encode(), HEADERS

    def write() -> bytes:
        from rlservo.serve_app.protocols.openapi import openapi  # imports FastAPI

        return openapi(table())

    async def document(_call: Call) -> tuple[bytes, Headers]:
        if not written:
            written.append(await asyncio.to_thread(write))
        return written[0], JSON_HEADERS

    def file(name: str) -> Answer:
        kind = MEDIA_TYPES[Path(name).suffix].encode()

        async def answer(_call: Call) -> tuple[bytes, Headers]:
            content = await asyncio.to_thread((files_of_swagger_ui() / name).read_bytes)
            return content, ((b"content-type", kind), (b"cache-control", b"max-age=86400"))

        return answer

    return [
        Route(GET, "/openapi.json", Access.open, "OpenAPI document", document, is_documented=False),
        Route(GET, "/docs", Access.open, "Interactive API documentation", page, is_documented=False),
        *(
            Route(GET, f"/docs/{name}", Access.open, "File of the API documentation", file(name), is_documented=False)
            for name in FILES
        ),
    ]
