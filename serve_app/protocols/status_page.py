"""Web page at `/` that shows what runs, for browsers alone: a program gets there what it gets where nothing is.

The page is static: anyone may open it, without a key. What it shows it asks of `/v1/policies` and
`/metrics`, with the key that its user types if the server wants one, from where it stays in a variable.

Sources: RFC 9110, section 12.5.1 (Accept); Content Security Policy Level 3; Trusted Types (W3C).
"""

from __future__ import annotations

import re
from pathlib import Path

from fastapi import FastAPI, Request
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match, Route
from starlette.types import Scope

from rlservo.serve_app.server.api_keys import Access

FOLDER = Path(__file__).with_name("page")
INDEX = "index.html"
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'",
    "script-src 'self'",
    "style-src 'self'",
    "img-src 'self'",
    "connect-src 'self'",
    "base-uri 'none'",
    "form-action 'none'",  # the key's form is read by the script; where that does not run, it goes nowhere
    "frame-ancestors 'none'",
    "require-trusted-types-for 'script'",  # text never becomes markup, not even by a mistake of the script
    "trusted-types 'none'",
)
HEADERS = {
    "Content-Security-Policy": "; ".join(POLICY),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
QUALITY = re.compile(r"0(\.[0-9]{0,3})?|1(\.0{0,3})?")


def add_status_page(app: FastAPI) -> None:
    """Serve the page at `/` to who prefers HTML, and its files under /page."""
    files = {path.name: path.read_bytes() for path in FOLDER.iterdir() if path.suffix in MEDIA_TYPES}
    page = files.pop(INDEX)

    async def index(_request: Request) -> Response:
        return _reply(INDEX, page, {"Vary": "Accept"})

    async def file(request: Request) -> Response:
        name = request.path_params["file"]
        if name not in files:
            raise HTTPException(404)
        return _reply(name, files[name], {})

    app.router.routes += [_PageRoute("/", index), _FileRoute("/page/{file}", file)]


class _FileRoute(Route):
    """The page's script, style and icon, the same for every client."""

    access = Access.open


class _PageRoute(Route):
    """The page; for who does not prefer HTML, and for other methods, there is no such route."""

    access = Access.open

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        match, child = super().matches(scope)
        if match is Match.FULL and prefers_html(",".join(Headers(scope=scope).getlist("accept"))):
            return match, child
        return Match.NONE, {}


def prefers_html(accept: str) -> bool:
    """Return whether an `Accept` header asks for HTML rather than for JSON; `*/*` and none at all do not."""
    html, json = (_quality(accept, *kind) for kind in (("text", "html"), ("application", "json")))
    return html > json


def _quality(accept: str, kind: str, subtype: str) -> float:
    """Return how much a media type is wanted, from 0 to 1: as the range says that names it most closely."""
    ranges = (f"{kind}/{subtype}", f"{kind}/*", "*/*")
    found: dict[str, float] = {}
    for part in accept.lower().split(","):
        media_range, *parameters = (item.strip() for item in part.split(";"))
        quality = next((item[2:] for item in parameters if item.startswith("q=")), "1")
        if media_range in ranges and QUALITY.fullmatch(quality):
            found[media_range] = max(float(quality), found.get(media_range, 0.0))
    return next((found[each] for each in ranges if each in found), 0.0)


def _reply(name: str, content: bytes, headers: dict[str, str]) -> Response:
    return Response(content, headers={**HEADERS, **headers}, media_type=MEDIA_TYPES[Path(name).suffix])
