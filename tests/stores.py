"""Policy stores: loaded as a server loads its folders, or made from given policies."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rlservo.bundle.contract import version_key
from rlservo.policy.acting_policy import PRODUCTION
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.deployment_plan import Plan, PolicyPlan, ServedConfig
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_follower import VersionState
from rlservo.serve_app.versions.policy_store import PolicyStore


def load_store(*folders: Path, options: Mapping[str, PolicyOptions] | None = None) -> PolicyStore:
    """Load what a server of these folders would start with."""
    with tempfile.TemporaryDirectory() as plans:
        return load_served(folders, ServedConfig(), ServerSettings(policy_options=dict(options or {}), plan=plans))


def store_of(*policies: Policy, **given: Any) -> PolicyStore:
    """Serve loaded policies, of each name the newest by default."""
    plans: dict[str, PolicyPlan] = {}
    for policy in sorted(policies, key=lambda each: version_key(each.contract.version)):
        name, version = policy.contract.name, policy.contract.version
        before = plans[name].versions if name in plans else {}
        plans[name] = PolicyPlan(versions={**before, version: policy.digest}, aliases={PRODUCTION: version})
    return PolicyStore(policies, plans, **given)


def control_of(store: PolicyStore | Callable[[], PolicyStore | None] | None) -> Any:
    """What a server serves, in a `PlanFollower`'s place: a store, or what a function returns at each request."""
    return _Given(store if callable(store) else lambda: store)


class _Given:
    behind = ()
    recent = ()

    def not_loaded(self) -> dict[str, list[str]]:
        return {}

    def __init__(self, provide: Callable[[], PolicyStore | None]) -> None:
        self._provide = provide

    @property
    def store(self) -> PolicyStore | None:
        return self._provide()

    @property
    def plan(self) -> Plan:
        return Plan(generation=0, policies={} if self.store is None else dict(self.store.plans))

    def states(self) -> dict[str, dict[str, VersionState]]:
        assert self.store is not None
        ready = VersionState("ready")
        return {name: dict.fromkeys(self.store.versions(name), ready) for name in self.store.names}


def plan_files(folder: Path, **given: Any) -> PlanFiles:
    """Plans in a folder of their own."""
    return PlanFiles([folder], root=str(folder), **given)
