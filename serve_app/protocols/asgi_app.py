"""ASGI application of the server: JSON, Open Inference Protocol, WebSocket and health over one `RequestHandler`."""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException

from rlservo.export.contract.errors import InternalError, RequestError, RlservoError
from rlservo.serve_app.protocols import http_errors, json_routes, oip_config, oip_models, websocket_stream
from rlservo.serve_app.protocols.admin_routes import add_admin
from rlservo.serve_app.protocols.docs_page import add_docs
from rlservo.serve_app.protocols.fastapi_routes import add_route
from rlservo.serve_app.protocols.http_endpoint import PolicyApp
from rlservo.serve_app.protocols.json_messages import encode_json
from rlservo.serve_app.protocols.status_page import add_status_page
from rlservo.serve_app.server.access_checks import AccessChecks, Hosts
from rlservo.serve_app.server.api_keys import Access, grant
from rlservo.serve_app.server.audit import AUDIT
from rlservo.serve_app.server.request_handler import RequestHandler, StoreProvider
from rlservo.serve_app.server.sampled_metrics import exposition
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower

DESCRIPTION = "Actions from exported RLlib policies. Every error is a sentence, a code and, if it helps, details."


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

    With a `control` what is served can be administered. `replica` is the `RequestHandler`'s, which is the application's
    `state.handler`; `host` is the address that is listened on; `is_behind_serve` is `PolicyApp`'s; `is_alone` says that
    this is the only process that requests reach. Raises UsageError when the API keys that `settings` name cannot be
    read.
    """
    handler = RequestHandler(store_provider, settings, replica=replica, control=control, is_alone=is_alone)
    checks = AccessChecks(Hosts(host, settings, keyed=bool(handler.keys.accepted.keys)), handler.keys)
    # A redirect would be an answer to a path that no route has: there is none.
    app = PolicyApp(
        handler,
        checks,
        is_behind_serve=is_behind_serve,
        title="rlservo",
        description=DESCRIPTION,
        servers=[{"url": "."}],  # the paths are beside the document, under whatever prefix a proxy takes off
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    (document,) = app.routes  # FastAPI's own, /openapi.json: it reveals nothing of policies
    grant(Access.open)(document)
    add = app.router.routes.append
    app.state.handler = handler  # for gRPC and the replica, which are not part of the application
    json_routes.add_routes(app, handler, add)
    websocket_stream.add_routes(handler, add)
    _add_health(app, handler)
    if control is not None:
        add_admin(app, handler, control)
    oip_config.add_routes(app, handler)
    oip_models.add_routes(app, handler, add)
    if settings.docs:
        add_docs(app)
        add_status_page(app)
    app.add_exception_handler(RlservoError, _on_rlservo_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_bug)
    return app


def _add_health(app: FastAPI, handler: RequestHandler) -> None:
    @add_route(app, Access.open, "GET", "/healthz", "health", "The process answers", response_class=Response)
    async def healthz() -> Response:
        return Response("OK", media_type="text/plain")

    counted = "For Prometheus: what this replica answered"

    @add_route(app, Access.act, "GET", "/metrics", "health", counted, response_class=Response)
    async def metrics() -> Response:
        return Response(await exposition(handler), media_type=CONTENT_TYPE_LATEST)


# Errors of the routes that FastAPI runs; `http_errors.py` has the table.


async def _on_rlservo_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RlservoError)
    request.scope[AUDIT].code = error.code
    status, content, headers = http_errors.error_answer(error)
    return Response(content, status, {name.decode(): value.decode() for name, value in headers})


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    request.scope[AUDIT].code = http_errors.CODES.get(error.status_code, http_errors.OTHER)
    return http_errors.http_error(
        error.status_code, request.scope, detail=str(error.detail), headers=error.headers or {}
    )


async def _on_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    request.scope[AUDIT].code = RequestError.code
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    document = {"error": f"{where}: {first['msg']}", "code": RequestError.code}
    return Response(encode_json(document), 400, None, "application/json")


async def _on_bug(request: Request, _error: Exception) -> Response:
    request.scope[AUDIT].code = InternalError.code
    return Response(http_errors.encode_bug(), 500, None, "application/json")  # Starlette raises it again, for the log
