"""Closed endpoints: Ray Serve's own HTTP paths and gRPC methods, which check no keys and so are answered to nobody.

`/-/routes` and `ListApplications` tell what is deployed. `/-/healthz` and `Healthz` are what HAProxy's health checks
ask: where the server has a secret for those checks (`rlservo serve` makes one), only they are answered. For everybody
else there are `/healthz`, `/v2/health/live` and `/v2/health/ready`. `haproxy/configuration.py` does the same in front.
"""

from __future__ import annotations

import hmac
import os
from collections.abc import Iterable
from typing import Any

import grpc
from starlette.types import Scope

from rlservo.serve_app.ray_serve.haproxy.configuration import CHECK_HEADER, CHECK_SECRET
from rlservo.serve_app.ray_serve.ray_parts import find

ROUTES, HEALTH = "/-/routes", "/-/healthz"
GRPC_SERVICE = "/ray.serve."
GRPC_HEALTH = "/ray.serve.RayServeAPIService/Healthz"
NOTHING = b'{"error":"nothing is here: policies are under /v1/policies","code":"not-found"}'
NO_METHOD = "this server has no such method"


def is_closed(scope: Scope) -> bool:
    """Whether this HTTP request is for Serve itself, and not one of HAProxy's health checks."""
    path = scope["path"].removeprefix(scope.get("root_path", ""))
    return path == ROUTES or (path == HEALTH and not _is_health_check(scope["headers"]))


def install() -> None:
    """Close the methods of gRPC servers that this process starts. Raises RuntimeError where Ray's names have moved."""
    override = find("ray.serve._private.grpc_util:gRPCGenericServer._override_method_handler")
    if getattr(override, "closes", False):
        return

    def override_method_handler(server: Any, service_method: str, handler: Any) -> Any:
        handler = override(server, service_method, handler)
        if not service_method.startswith(GRPC_SERVICE):
            return handler
        return handler._replace(unary_unary=_closed(service_method, handler.unary_unary))

    override_method_handler.closes = True  # type: ignore[attr-defined]
    find("ray.serve._private.grpc_util:gRPCGenericServer")._override_method_handler = override_method_handler


def _closed(service_method: str, answer: Any) -> Any:
    async def answer_health_checks(request: Any, context: Any) -> Any:
        headers = ((name.encode(), _bytes(value)) for name, value in context.invocation_metadata())
        if service_method != GRPC_HEALTH or not _is_health_check(headers):
            await context.abort(grpc.StatusCode.UNIMPLEMENTED, NO_METHOD)
        return await answer(request, context)

    return answer_health_checks


def _bytes(value: str | bytes) -> bytes:
    return value if isinstance(value, bytes) else value.encode()


def _is_health_check(headers: Iterable[tuple[bytes, bytes]]) -> bool:
    secret = os.environ.get(CHECK_SECRET, "")
    if not secret:
        return True
    return any(name == CHECK_HEADER.encode() and hmac.compare_digest(value, secret.encode()) for name, value in headers)
