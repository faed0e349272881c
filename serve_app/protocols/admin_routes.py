"""Administration over HTTP: load, unload, alias, rollback, canary, shadow.

A command answers when the change is proven, written into the repository's plan, and served by the process that took
it; the other processes follow. `access_checks.authorize` admits no one without an admin key. The Open Inference
Protocol's `load` and `unload` are two of these under other names.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import orjson
from fastapi import Depends, FastAPI, Request
from fastapi.responses import Response

from rlservo.serve_app.protocols.fastapi_routes import Endpoint, add_route
from rlservo.serve_app.protocols.media_types import accept_json
from rlservo.serve_app.protocols.oip_infer import accept_media_type
from rlservo.serve_app.protocols.oip_models import TAG
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.audit import AUDIT, OK, AuditEntry
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.plan_commands import COMMANDS, Changed, Command, Load, Unload
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.serving_plan import Plan

STATUSES = (404, 409, 415, 503)


def add_admin(app: FastAPI, handler: RequestHandler, control: PlanFollower) -> None:
    """Add /v1/admin and the repository extension's load and unload to the application."""
    post = partial(add_route, app, Access.admin, "POST")

    async def carry_out(request: Request, name: str, command: str, given: Command) -> Plan:
        entry: AuditEntry = request.scope[AUDIT]
        what = f"{command} {name} {given.words()}".strip()
        entry.command, entry.policy, entry.change, entry.version = command, name, what, given.version
        after = await given.give(control, name, what)
        entry.code, entry.generation = OK, after.generation
        return after

    @add_route(
        app,
        Access.admin,
        "GET",
        "/v1/admin/policies",
        "admin",
        "What the process that answers serves, in a list",
        *STATUSES,
        response_model=list[listing.PolicyList],
    )
    async def status() -> Response:
        return Response(orjson.dumps([listing.describe(handler)]), media_type="application/json")

    def add_command(command: str, kind: type[Command]) -> None:
        async def endpoint(request: Request, name: str, given: Command) -> Response:
            after = await carry_out(request, name, command, given)
            return Response(Changed.of(after, name).model_dump_json(), media_type="application/json")

        endpoint.__annotations__ |= {"request": Request, "given": kind}
        endpoint.__name__ = command
        path, accepted = f"/v1/admin/policies/{{name}}/{command}", [Depends(accept_json)]
        post(path, "admin", kind.summary, *STATUSES, response_model=Changed, dependencies=accepted)(endpoint)

    for command, kind in COMMANDS.items():
        add_command(command, kind)

    # Triton's clients send a body, as JSON or as octets, whose parameters mean nothing here: it is not read.
    def repository(path: str, summary: str) -> Callable[[Endpoint], Endpoint]:
        path, accepted = f"/v2/repository/models/{{name}}/{path}", [Depends(accept_media_type)]
        return post(path, TAG, summary, *STATUSES, response_class=Response, dependencies=accepted)

    # As a Triton that serves what its configuration pins: loading changes what clients get only where the model was not
    # there at all. Moving `production` is /v1/admin's, with a way back.
    @repository("load", "Load a model's newest version; in use at once only if the model was not served")
    async def load_model(request: Request, name: str) -> Response:
        await carry_out(request, name, "load", Load())
        return Response(b"{}", media_type="application/json")

    @repository("unload", "Unload a model, all its versions")
    async def unload_model(request: Request, name: str) -> Response:
        await carry_out(request, name, "unload", Unload())
        return Response(b"{}", media_type="application/json")
