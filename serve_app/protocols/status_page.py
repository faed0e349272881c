"""Status page at `/`, only for browsers: a program gets the reply for an unknown path.

The page is static: anyone may open it without a key. It fetches its content from `/v1/policies` and `/metrics`, with
the key that its user types if the server requires one, which stays in a variable.

Sources: Content Security Policy Level 3; Trusted Types (W3C).
"""

from __future__ import annotations

from pathlib import Path

from rlservo.serve_app.protocols.http_errors import Headers
from rlservo.serve_app.protocols.routes import GET, Answer, Call, Route
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
    "form-action 'none'",  # the script reads the key's form; if the script does not run, the form goes nowhere
    "frame-ancestors 'none'",
    "require-trusted-types-for 'script'",  # text never becomes markup, not even through a bug in the script
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


def routes() -> list[Route]:
    """Return the page at `/`, and its files under /page."""
    files = {path.name: path.read_bytes() for path in FOLDER.iterdir() if path.suffix in MEDIA_TYPES}

    def reply(name: str, *headers: tuple[bytes, bytes]) -> Answer:
        own = {**HEADERS, "content-type": MEDIA_TYPES[Path(name).suffix]}
        every = (*((key.lower().encode(), value.encode()) for key, value in own.items()), *headers)

        async def answer(_call: Call) -> tuple[bytes, Headers]:
            return files[name], every

        return answer

    page = Route(
        GET, "/", Access.open, "Status page", reply(INDEX, (b"vary", b"Accept")), is_page=True, is_documented=False
    )
    others = sorted(files.keys() - {INDEX})
    return [
        page,
        *(
            Route(GET, f"/page/{name}", Access.open, "File of the status page", reply(name), is_documented=False)
            for name in others
        ),
    ]
