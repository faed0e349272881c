"""Check before a server starts: load and prove everything that it would serve."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from rlservo.export.contract.errors import UnavailableError
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.serving_plan import ServedConfig
from rlservo.serve_app.versions.version_loader import VersionLoader


def load_served(
    paths: Sequence[str | Path], config: ServedConfig, settings: ServerSettings | None = None
) -> PolicyStore:
    """Load and prove the versions that a server of these folders starts with; write a missing plan.

    Raises UsageError or BundleError, and UnavailableError if a file system or storage does not answer.
    """
    settings = settings or ServerSettings.from_environment(environment={})
    control = PlanFollower(version_loader(paths, settings), plan_files(paths, settings))
    asyncio.run(control.configure(config.model_dump(exclude_unset=True)))
    if control.store is None:
        raise UnavailableError("no policies were loaded")
    return control.store


def version_loader(places: Iterable[str | Path], settings: ServerSettings) -> VersionLoader:
    """Return the loader for versions of these folders and URIs, under the settings. Raises UsageError."""
    limits = settings.bundle_limits
    load = partial(Policy.load, threads=settings.threads, limits=limits)
    repository = Repository(
        places,
        limits,
        cache=settings.cache,
        cache_bytes=settings.cache_bytes,
        timeout_s=settings.load_timeout_s,
    )
    return VersionLoader(repository, load, options=settings.policy_options, timeout_s=settings.load_timeout_s)


def plan_files(places: Sequence[str | Path], settings: ServerSettings) -> PlanFiles:
    """Return the plan's files for these folders and URIs, under the settings. Raises UsageError."""
    return PlanFiles(places, root=settings.plan, cache=settings.cache, timeout_s=settings.load_timeout_s)
