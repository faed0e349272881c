"""Check before a server starts: load and prove all that it would serve."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from rlservo.export.contract.errors import BundleError, RlservoError
from rlservo.serve_app.runtime.network_memory import NetworkMemory
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.plan_changes import plan_of
from rlservo.serve_app.versions.policy_store import PolicyStore, load_policy
from rlservo.serve_app.versions.repository import Repository, raise_all
from rlservo.serve_app.versions.version_loader import VersionLoader


def load_served(
    paths: Iterable[str | Path], config: ServedConfig, settings: ServerSettings | None = None
) -> PolicyStore:
    """Load and prove what a server of these folders would start with.

    Raises UsageError or BundleError, and UnavailableError where a file system or storage does not answer.
    """
    loader = version_loader(paths, settings or ServerSettings.from_environment(environment={}))
    return asyncio.run(_load_all(loader, config))


def version_loader(places: Iterable[str | Path], settings: ServerSettings) -> VersionLoader:
    """Return what loads the versions of these folders and URIs as the settings say. Raises UsageError."""
    limits = settings.bundle_limits
    memory = None if settings.network_bytes is None else NetworkMemory(settings.network_bytes)
    options = settings.policy_options
    load = partial(load_policy, threads=settings.threads, options=options, limits=limits, memory=memory)
    repository = Repository(
        places,
        limits,
        cache=settings.cache,
        cache_bytes=settings.cache_bytes,
        storage_timeout_s=settings.storage_timeout_s,
    )
    return VersionLoader(
        repository,
        load,
        scan_timeout_s=settings.scan_timeout_s,
        load_timeout_s=settings.load_timeout_s,
    )


async def _load_all(loader: VersionLoader, config: ServedConfig) -> PolicyStore:
    plans = plan_of(config, await loader.available(config), None)
    policies: list[Policy] = []
    errors: list[RlservoError] = []
    for name, plan in plans.items():
        for version, digest in plan.versions.items():
            try:
                policies.append(await loader.load(name, version, digest))
            except BundleError as error:
                errors.append(error)
    raise_all(errors)
    return PolicyStore(policies, plans)
