"""Check before a server starts: load and prove all that it would serve."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from rlservo.export.contract.errors import BundleError, RlservoError
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.loaded_policies import LoadedPolicies
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.plan_changes import plan_of
from rlservo.serve_app.versions.policy_store import PolicyStore, load_policy
from rlservo.serve_app.versions.repository import Repository, raise_all


def load_served(
    paths: Iterable[str | Path], config: ServedConfig, settings: ServerSettings | None = None
) -> PolicyStore:
    """Load and prove what a server of these folders would start with.

    Raises UsageError or BundleError, and UnavailableError where the file system hangs.
    """
    settings = settings or ServerSettings.from_environment(environment={})
    calls, limits = BlockingCalls(), settings.bundle_limits
    load = partial(load_policy, threads=settings.threads, options=settings.policy_options, limits=limits)
    library = LoadedPolicies(Repository(paths, limits), load)
    available = calls.wait(
        library.repository.available, config, timeout_s=settings.scan_timeout_s, what="looking through the folders"
    )
    plans = plan_of(config, available, None)
    policies: list[Policy] = []
    errors: list[RlservoError] = []
    for name, plan in plans.items():
        for version, digest in plan.versions.items():
            what = f"loading policy '{name}' version {version}"
            try:
                loaded = calls.wait(library.load, name, version, digest, timeout_s=settings.load_timeout_s, what=what)
                policies.append(loaded.policy)
            except BundleError as error:
                errors.append(error)
    raise_all(errors)
    return PolicyStore(policies, plans)
