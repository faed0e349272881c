"""Routes for actions and streams, which `PolicyApp` answers itself; FastAPI documents them and never runs them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi.routing import APIRoute
from starlette.routing import WebSocketRoute
from starlette.types import ASGIApp

from rlservo.serve_app.protocols.http_errors import error_models
from rlservo.serve_app.server.api_keys import Access

STATUSES = (400, 404, 408, 409, 410, 413, 415, 422, 500, 503)


class PostRoute(APIRoute):
    """A path of requests for actions; its `app` is a bare ASGI callable."""

    access = Access.act

    def __init__(
        self,
        path: str,
        endpoint: ASGIApp,
        *,
        operation: str,
        tag: str,
        summary: str,
        reply: Any,
        body: Mapping[str, Any],
    ) -> None:
        async def documented() -> None:
            """Documented, never called: `app` answers."""

        super().__init__(
            path,
            documented,
            methods=["POST"],
            name=operation,
            tags=[tag],
            summary=summary,
            description=summary + ".",
            response_model=reply,
            responses=error_models(*STATUSES),
            openapi_extra={
                "requestBody": {"required": True, "content": body},
                "parameters": [
                    {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
                    for name in ("name", "version")
                    if f"{{{name}}}" in path
                ],
            },
            generate_unique_id_function=lambda _route: operation,
        )
        self.app = endpoint


def post_routes(prefix: str, operation: str, endpoint: ASGIApp, **documentation: Any) -> list[PostRoute]:
    """Return an operation's two routes: with a policy's default version, and with one version or an alias."""
    verb, policy = operation.capitalize(), f"{prefix}/{{name}}"
    version = f"{policy}/versions/{{version}}/{operation}"
    summary = f"{verb} with the default version"
    of_version = f"{verb} with one version, or with what an alias leads to"
    return [
        PostRoute(f"{policy}/{operation}", endpoint, operation=operation, summary=summary, **documentation),
        PostRoute(version, endpoint, operation=f"{operation}_version", summary=of_version, **documentation),
    ]


class StreamRoute(WebSocketRoute):
    """A path of WebSockets; its `app` is a bare ASGI callable."""

    access = Access.act
