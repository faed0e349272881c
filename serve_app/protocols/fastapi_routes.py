"""Routes that FastAPI runs: those that are seldom called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import FastAPI

from rlservo.serve_app.protocols.http_errors import error_models
from rlservo.serve_app.server.api_keys import Access, grant

Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


def add_route(
    app: FastAPI, access: Access, method: str, path: str, tag: str, summary: str, *statuses: int, **options: Any
) -> Callable[[Endpoint], Endpoint]:
    """Return a decorator that adds a route: who may use it, and which errors it answers besides every route's."""
    responses = error_models(*statuses)

    def add(endpoint: Endpoint) -> Endpoint:
        granted = grant(access)(endpoint)
        app.add_api_route(path, granted, methods=[method], tags=[tag], summary=summary, responses=responses, **options)
        return granted

    return add
