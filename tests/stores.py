"""Policy stores: loaded as a server loads its folders, or made of policies at hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlservo.export.contract.contract import version_key
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.plan import PRODUCTION, PolicyPlan, ServedConfig
from rlservo.serve_app.versions.policy_store import PolicyStore


def load_store(*folders: Path, options: Mapping[str, PolicyOptions] | None = None) -> PolicyStore:
    """Load what a server of these folders would start with."""
    return load_served(folders, ServedConfig(), ServerSettings(policy_options=dict(options or {})))


def store_of(*policies: Policy, **given: Any) -> PolicyStore:
    """Serve loaded policies, of each name the newest by default."""
    plans: dict[str, PolicyPlan] = {}
    for policy in sorted(policies, key=lambda each: version_key(each.contract.version)):
        name, version = policy.contract.name, policy.contract.version
        before = plans[name].versions if name in plans else {}
        plans[name] = PolicyPlan(versions={**before, version: policy.digest}, aliases={PRODUCTION: version})
    return PolicyStore(policies, plans, **given)


class MemoryLedger:
    """The plans of one process, without Ray; the ledger in Ray is tested with Ray."""

    def __init__(self) -> None:
        self.plans: dict[int, bytes] = {}

    def newest(self) -> int:
        return max(self.plans, default=0)

    def fetch(self, generation: int) -> bytes | None:
        return self.plans.get(generation)

    def append(self, generation: int, content: bytes) -> bool:
        return self.plans.setdefault(generation, content) is content
