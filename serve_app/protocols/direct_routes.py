"""Routes that `PolicyApp` answers by itself; FastAPI documents them and never runs them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi.routing import APIRoute
from starlette.routing import WebSocketRoute
from starlette.types import ASGIApp

from rlservo.serve_app.server.api_keys import Access


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
        responses: dict[int | str, dict[str, Any]],
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
            responses=responses,
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


class StreamRoute(WebSocketRoute):
    """A path of WebSockets; its `app` is a bare ASGI callable."""

    access = Access.act
