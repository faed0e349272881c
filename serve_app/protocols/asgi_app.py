"""ASGI application of the server: JSON, Open Inference Protocol, WebSocket and health over one `RequestHandler`."""

from __future__ import annotations

from prometheus_client import CONTENT_TYPE_LATEST

from rlservo.serve_app.protocols import (
    admin_routes,
    json_codec,
    oip_infer,
    oip_models,
    pages,
    recording_routes,
    websocket_stream,
)
from rlservo.serve_app.protocols.http_endpoint import PolicyApp
from rlservo.serve_app.protocols.http_errors import Headers
from rlservo.serve_app.protocols.routes import GET, Call, Route, RoutingTable
from rlservo.serve_app.server.access_checks import OriginChecks
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.metrics import exposition
from rlservo.serve_app.server.request_handler import RequestHandler, StoreProvider
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower


def create_app(
    store_provider: StoreProvider,
    settings: ServerSettings,
    *,
    replica: str = "",
    control: PlanFollower | None = None,
    host: str = "127.0.0.1",
    is_behind_serve: bool = False,
    is_alone: bool = True,
) -> PolicyApp:
    """Return the application; `store_provider` gives None for as long as the policies are being loaded.

    A `control` makes the served policies administrable. `replica` is the `RequestHandler`'s; `host` is the address that
    it listens on; `is_behind_serve` is `PolicyApp`'s; `is_alone` says that requests reach only this process. Raises
    UsageError when the API keys that `settings` name cannot be read.
    """
    handler = RequestHandler(store_provider, settings, replica=replica, control=control, is_alone=is_alone)
    checks = OriginChecks(host, settings, keyed=bool(handler.keys.accepted.keys))
    routes = [
        *json_codec.routes(handler),
        *websocket_stream.routes(handler),
        *_health(handler),
        *((*admin_routes.routes(handler, control), *recording_routes.routes(handler)) if control is not None else ()),
        *oip_infer.routes(handler),
        *oip_models.routes(handler),
        *pages.routes(lambda: table),
    ]
    table = RoutingTable(routes)
    return PolicyApp(handler, checks, table, is_behind_serve=is_behind_serve)


def _health(handler: RequestHandler) -> list[Route]:
    async def healthz(_call: Call) -> tuple[bytes, Headers]:
        return b"OK", ((b"content-type", b"text/plain; charset=utf-8"),)

    async def metrics(_call: Call) -> tuple[bytes, Headers]:
        return await exposition(handler), ((b"content-type", CONTENT_TYPE_LATEST.encode()),)

    return [
        Route(GET, "/healthz", Access.open, "The process is alive", healthz),
        Route(GET, "/metrics", Access.act, "Metrics for Prometheus", metrics),
    ]
