"""Administration over HTTP: load, unload, alias, rollback, canary, shadow, on every replica at once.

Every command answers when all replicas serve the change, or says which do not and why. `access_checks.authorize`
lets nobody in without an admin key. The Open Inference Protocol's `load` and `unload` are two of these under other
names.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial

import orjson
from fastapi import Depends, FastAPI, Request
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.protocols.fastapi_routes import Endpoint, add_route
from rlservo.serve_app.protocols.json_messages import encode_json
from rlservo.serve_app.protocols.media_types import accept_json
from rlservo.serve_app.protocols.oip_infer import accept_media_type
from rlservo.serve_app.protocols.oip_models import TAG
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.audit import AUDIT, OK, AuditEntry
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.plan import PRODUCTION, Alias, Canary, Plan, PolicyPlan, Reference, Version
from rlservo.serve_app.versions.replica_versions import Change, ReplicaVersions

STATUSES = (404, 409, 415, 503)


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid")


class LoadCommand(_Command):
    version: Version | None = Field(None, description="The repository's newest when left out.")


class UnloadCommand(_Command):
    version: Version | None = Field(None, description="The whole policy when left out.")


class AliasCommand(_Command):
    alias: Alias = Field(description="`production` is the default version; it can be moved, not removed.")
    version: Version | None = Field(description="A loaded version; null removes the alias.")
    expected: Version | None = Field(None, description="Where the alias leads now; when it does not, nothing changes.")


class RollbackCommand(_Command):
    alias: Alias = PRODUCTION
    expected: Version | None = Field(
        None, description="Where the alias leads now; when it does not, nothing changes. Makes a repeated command safe."
    )


class CanaryCommand(_Command):
    version: Reference | None = Field(description="A loaded version or an alias; null ends the canary.")
    share: float | None = Field(None, ge=0, le=1, description="Of the sessions; 0 ends the canary.")


class ShadowCommand(_Command):
    version: Reference | None = Field(description="A loaded version or an alias; null ends the shadow.")


class Changed(BaseModel):
    """A change that every replica serves."""

    generation: int
    policy: str
    default: str | None = Field(description="The default version; null when the policy is no longer served.")
    versions: list[str]
    aliases: dict[str, str]
    canary: Canary | None
    shadow: str | None


def add_admin(app: FastAPI, core: Core, control: ReplicaVersions) -> None:
    """Add /v1/admin and the repository extension's load and unload to the application."""
    post = partial(add_route, app, Access.admin, "POST")

    def command(path: str, summary: str) -> Callable[[Endpoint], Endpoint]:
        path, accepted = f"/v1/admin/policies/{{name}}/{path}", [Depends(accept_json)]
        return post(path, "admin", summary, *STATUSES, response_model=Changed, dependencies=accepted)

    async def apply(
        request: Request, command: str, name: str, change: str, version: str | None, making: Awaitable[Plan]
    ) -> Plan:
        entry: AuditEntry = request.scope[AUDIT]
        entry.command, entry.policy, entry.change, entry.version = command, name, change, version
        after = await making
        entry.code, entry.generation = OK, after.generation
        return after

    async def changed(
        request: Request, command: str, name: str, what: str, version: str | None, change: Change
    ) -> Response:
        what = f"{command} {name} {what}".strip()
        return _answer(name, await apply(request, command, name, what, version, control.change(change, what=what)))

    @add_route(
        app,
        Access.admin,
        "GET",
        "/v1/admin/policies",
        "admin",
        "What every replica serves",
        *STATUSES,
        response_model=list[listing.PolicyList],
    )
    async def status() -> Response:
        replies = [listing.describe(core)] if control.gather is None else await control.gather()
        return Response(orjson.dumps(replies), media_type="application/json")

    @command("load", "Load a version, prove it, and keep it ready: not in use until an alias leads to it")
    async def load(request: Request, name: str, given: LoadCommand) -> Response:
        what = f"load {name} {given.version or 'newest'}"
        making = control.load(name, given.version, what=what)
        return _answer(name, await apply(request, "load", name, what, given.version, making))

    @command("unload", "Drop a version, or the policy")
    async def unload(request: Request, name: str, given: UnloadCommand) -> Response:
        version = given.version
        change = partial(plan_changes.unload, name=name, version=version)
        return await changed(request, "unload", name, version or "", version, change)

    @command("alias", "Let an alias lead to a loaded version")
    async def alias(request: Request, name: str, given: AliasCommand) -> Response:
        alias, version, expected = given.alias, given.version, given.expected
        change = partial(plan_changes.set_alias, name=name, alias=alias, version=version, expected=expected)
        return await changed(request, "alias", name, f"{alias}={version or ''}", version, change)

    @command("rollback", "Let an alias lead where it led before")
    async def rollback(request: Request, name: str, given: RollbackCommand) -> Response:
        change = partial(plan_changes.roll_back, name=name, alias=given.alias, expected=given.expected)
        return await changed(request, "rollback", name, given.alias, None, change)

    @command("canary", "Send a share of the sessions to another version")
    async def canary(request: Request, name: str, given: CanaryCommand) -> Response:
        if given.version is not None and given.share is None:
            raise RequestError(f"the canary of policy '{name}' needs a share above 0 and at most 1")
        ended = given.version is None or not given.share
        chosen = None if ended else Canary(version=str(given.version), share=given.share or 0)
        what = f"{given.version or 'off'} {given.share or ''}"
        change = partial(plan_changes.set_canary, name=name, canary=chosen)
        return await changed(request, "canary", name, what, given.version, change)

    @command("shadow", "Let another version compute along")
    async def shadow(request: Request, name: str, given: ShadowCommand) -> Response:
        change = partial(plan_changes.set_shadow, name=name, shadow=given.version)
        return await changed(request, "shadow", name, given.version or "off", given.version, change)

    # Triton's clients send a body, as JSON or as octets, whose parameters mean nothing here: nobody reads it.
    def repository(path: str, summary: str) -> Callable[[Endpoint], Endpoint]:
        path, accepted = f"/v2/repository/models/{{name}}/{path}", [Depends(accept_media_type)]
        return post(path, TAG, summary, *STATUSES, response_class=Response, dependencies=accepted)

    # As a Triton that serves what its configuration pins: loading changes what clients get only where the model was not
    # there at all. Moving `production` is /v1/admin's, with a way back.
    @repository("load", "Load a model's newest version; in use at once only if the model was not served")
    async def load_model(request: Request, name: str) -> Response:
        what = f"load {name} newest"
        await apply(request, "load", name, what, None, control.load(name, None, what=what))
        return Response(b"{}", media_type="application/json")

    @repository("unload", "Unload a model, all its versions")
    async def unload_model(request: Request, name: str) -> Response:
        what = f"unload {name}"
        making = control.change(partial(plan_changes.unload, name=name, version=None), what=what)
        await apply(request, "unload", name, what, None, making)
        return Response(b"{}", media_type="application/json")


def _answer(name: str, after: Plan) -> Response:
    policy = after.policies.get(name) or PolicyPlan(versions={})
    document = {
        "generation": after.generation,
        "policy": name,
        "default": policy.default,
        "versions": list(policy.versions),
        "aliases": policy.aliases,
        "canary": policy.canary and policy.canary.model_dump(),
        "shadow": policy.shadow,
    }
    return Response(encode_json(document), media_type="application/json")
