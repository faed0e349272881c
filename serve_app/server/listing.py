"""Listing of policies and versions: those served by this process, since when, and those that failed to load."""

from __future__ import annotations

from typing import Any

from rlservo.serve_app.server.request_handler import RequestHandler


def describe(handler: RequestHandler) -> dict[str, Any]:
    """Return the reply to `GET /v1/policies`; states and counts are this process's own.

    `version` is the target of the alias `production`, `versions` are those that answer, the oldest first, `previous` is
    the target of a rollback of each alias. A version is `loading`, `ready` or `failed`. `generation` is the plan's
    number, `recent` names the last changes of the plan; `behind` lists the parts of it that this process could not
    follow, `not_loaded` the versions of the repository that the plan does not load, by policy, at the last look.
    """
    store, control = handler.store(), handler.control
    plan, states = control.plan, control.states()
    policies = []
    for name in store.names:
        contract, arranged, shadow = store.get(name).contract, store.plans[name], store.shadow(name)
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
                "shadow": shadow and {"version": shadow.contract.version},
                "version_states": [
                    {
                        "version": version,
                        **vars(state),
                        "aliases": [alias for alias, target in arranged.aliases.items() if target == version],
                        "requests": sum(each.count for each in handler.metrics.answers_of(name, version)),
                    }
                    for version, state in states.get(name, {}).items()
                ],
            }
        )
    return {
        "policies": policies,
        "replica": handler.replica,
        "generation": plan.generation if plan is not None else 0,
        "changed_at": plan and plan.changed_at,
        "changed_by": plan and plan.changed_by,
        "recent": [each.model_dump(include={"generation", "changed_at", "changed_by"}) for each in control.recent],
        "behind": list(control.behind),
        "not_loaded": control.not_loaded(),
    }
