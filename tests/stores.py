"""Policy stores: loaded as a server loads its folders, or made from given policies."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlservo.export.contract.contract import version_key
from rlservo.serve_app.interface import PRODUCTION
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.serving_plan import PolicyPlan, ServedConfig


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


def plan_files(folder: Path, **given: Any) -> PlanFiles:
    """Plans in a folder of their own."""
    return PlanFiles([folder], root=str(folder), **given)
