"""Listing of policies and versions: what runs here, since when, and what failed to load.

The models describe the wire. The documents are this replica's own; `/v1/admin/policies` gathers all of them.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.versions.plan_follower import VersionState
from rlservo.serve_app.versions.serving_plan import Canary


class VersionStatus(BaseModel):
    """One version of a policy, on the replica that answers."""

    version: str
    state: str = Field(description="`loading`, `ready` or `failed`.")
    reason: str = Field(description="Why it failed; empty otherwise.")
    aliases: list[str]
    loaded_at: str | None = Field(description="UTC; when this replica had loaded and proven it.")
    requests: int = Field(description="Answered by this replica, over all protocols.")


class ShadowStatus(BaseModel):
    """A version that computes along, and how it compares so far, on the replica that answers."""

    version: str
    compared: int
    mean_difference: float | None
    largest_difference: float | None
    failed: int
    left_out: int


class PolicySummary(BaseModel):
    """A policy of `GET /v1/policies`."""

    name: str
    version: str = Field(description="The default: where the alias `production` leads.")
    versions: list[str] = Field(description="Those that answer, oldest first.")
    description: str
    control_rate_hz: float | None
    aliases: dict[str, str]
    previous: dict[str, str] = Field(description="Where a rollback of an alias would lead.")
    canary: Canary | None
    shadow: ShadowStatus | None
    version_states: list[VersionStatus]


class PolicyList(BaseModel):
    policies: list[PolicySummary]
    replica: str = Field(description="Which replica answers; counts and states are its own.")
    generation: int = Field(description="Counts the changes of what is served; the same number, the same policies.")
    changed_at: str | None
    changed_by: str | None
    behind: list[str] = Field(description="What this process could not follow, a sentence each; usually empty.")


def describe(handler: RequestHandler) -> dict[str, Any]:
    """Return what `GET /v1/policies` answers, as `PolicyList`."""
    store, control = handler.store(), handler.control
    plan = control.plan if control is not None else None
    states = states_of(handler)
    policies = []
    for name in store.names:
        contract = store.get(name).contract
        arranged = store.plans[name]
        shadow = store.shadow(name)
        versions = []
        for version, state in states.get(name, {}).items():
            versions.append(
                {
                    "version": version,
                    "state": state.state,
                    "reason": state.reason,
                    "aliases": [alias for alias, target in arranged.aliases.items() if target == version],
                    "loaded_at": state.loaded_at,
                    "requests": handler.metrics.requests(name, version),
                }
            )
        policies.append(
            {
                "name": name,
                "version": contract.version,
                "versions": list(store.versions(name)),
                "description": contract.description,
                "control_rate_hz": contract.control_rate_hz,
                "aliases": arranged.aliases,
                "previous": {alias: earlier[-1] for alias, earlier in arranged.history.items() if earlier},
                "canary": arranged.canary and arranged.canary.model_dump(),
                "shadow": shadow and handler.shadows.describe(name, shadow.of, shadow.version),
                "version_states": versions,
            }
        )
    return {
        "policies": policies,
        "replica": handler.replica,
        "generation": plan.generation if plan is not None else 0,
        "changed_at": plan and plan.changed_at,
        "changed_by": plan and plan.changed_by,
        "behind": list(control.behind) if control is not None else [],
    }


def states_of(handler: RequestHandler) -> dict[str, dict[str, VersionState]]:
    """Return how every version stands, by name."""
    if handler.control is not None:
        return handler.control.states()
    store = handler.store()
    return {name: {version: VersionState("ready") for version in store.versions(name)} for name in store.names}
