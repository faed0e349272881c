"""Interactive API documentation at /docs, served whole from this machine: no CDN.

Swagger UI comes from the package `swagger-ui-bundle` (4.15), which draws OpenAPI 3.0 and not 3.1, so the document is
served as 3.0.
"""

from __future__ import annotations

import base64
import hashlib
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse
from starlette.routing import Mount
from starlette.staticfiles import StaticFiles

from rlservo.serve_app.server.api_keys import Access, grant

OPENAPI_VERSION = "3.0.3"

# Addresses are relative, so that the page also works behind a route prefix. No validator badge: it would ask
# validator.swagger.io.
TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>rlservo API</title>
<link rel="stylesheet" href="docs/files/swagger-ui.css">
<link rel="icon" type="image/png" href="docs/files/favicon-32x32.png">
</head>
<body>
<div id="swagger-ui"></div>
<script src="docs/files/swagger-ui-bundle.js"></script>
<script>%(script)s</script>
</body>
</html>
"""
SCRIPT = """
SwaggerUIBundle({url: "openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout"});
"""
SCRIPT_HASH = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
HEADERS = {
    # "Try it out" acts in the name of the visitor: no other page may put this one under its visitor's mouse.
    "Content-Security-Policy": (
        f"default-src 'none'; script-src 'self' 'sha256-{SCRIPT_HASH}'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
PAGE = TEMPLATE % {"script": SCRIPT}


class _Files(Mount):
    """Swagger UI's own files, the same for every client."""

    access = Access.open


def add_docs(app: FastAPI) -> None:
    """Serve /docs, its files, and /openapi.json as OpenAPI 3.0."""
    # Here: a server without /docs does not need the package.
    from swagger_ui_bundle import swagger_ui_path  # type: ignore[import-untyped]

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
                servers=app.servers,
            )
            app.openapi_schema = {**to_openapi_30(document), "openapi": OPENAPI_VERSION}
        return app.openapi_schema

    @app.get("/docs", include_in_schema=False)
    @grant(Access.open)
    async def docs() -> HTMLResponse:
        return HTMLResponse(PAGE, headers=HEADERS)

    app.router.routes.append(_Files("/docs/files", StaticFiles(directory=swagger_ui_path), name="docs-files"))
    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's own documented way


def to_openapi_30(node: Any) -> Any:
    """Return an OpenAPI 3.1 document, as FastAPI and pydantic write it, in 3.0's words.

    Differences met here: null in anyOf, const, prefixItems, numeric exclusive bounds and local `$defs`
    (OpenAPI Specification 3.0.3, section 4.7.24, against JSON Schema 2020-12).
    """
    if isinstance(node, list):
        return [to_openapi_30(item) for item in node]
    if not isinstance(node, dict):
        return node
    node = {key: to_openapi_30(value) for key, value in node.items()}
    choices = node.get("anyOf")
    if isinstance(choices, list) and {"type": "null"} in choices:
        rest = [choice for choice in choices if choice != {"type": "null"}]
        del node["anyOf"]
        node["nullable"] = True
        if len(rest) == 1 and "$ref" not in rest[0]:
            node = {**rest[0], **node}
        else:
            node["allOf" if len(rest) == 1 else "anyOf"] = rest
    if "const" in node and not isinstance(node["const"], dict):
        node["enum"] = [node.pop("const")]
    if isinstance(node.get("prefixItems"), list):
        node["items"] = {"anyOf": node.pop("prefixItems")}
    for bound in ("Minimum", "Maximum"):
        value = node.get(f"exclusive{bound}")
        if isinstance(value, int | float) and not isinstance(value, bool):
            node[bound.lower()] = value
            node[f"exclusive{bound}"] = True
    return node
