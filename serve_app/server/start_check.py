"""Check before a server starts: load and prove everything that it would serve."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rlservo.export.contract.bundle import BundleLimits
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
    control = PlanFollower(*loader_and_plans(paths, settings or ServerSettings.from_environment(environment={})))
    asyncio.run(control.configure(config.model_dump(exclude_unset=True)))
    if control.store is None:
        raise UnavailableError("no policies were loaded")
    return control.store


def loader_and_plans(places: Sequence[str | Path], settings: ServerSettings) -> tuple[VersionLoader, PlanFiles]:
    """Return the loader for versions of these folders and URIs, and the files of their plan. Raises UsageError."""
    limits, cache, timeout_s = BundleLimits(settings.max_policy_bytes), settings.cache, settings.load_timeout_s
    repository = Repository(places, limits, cache=cache, cache_bytes=settings.cache_bytes, timeout_s=timeout_s)
    load = partial(Policy.load, threads=settings.threads, limits=limits)
    loader = VersionLoader(repository, load, options=settings.policy_options, timeout_s=timeout_s)
    return loader, PlanFiles(places, root=settings.plan, cache=cache, timeout_s=timeout_s)
