"""Check before a server starts: load and prove everything that it would serve."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rlservo.export.contract.bundle import BundleLimits
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.version_loader import VersionLoader


def load_served(places: Sequence[str | Path], served: Any, settings: ServerSettings | None = None) -> PolicyStore:
    """Load and prove the versions that a server of these folders and `served` starts with; write a missing plan.

    Raises UsageError or BundleError, and UnavailableError if a file system or storage does not answer.
    """
    control = plan_follower(places, settings or ServerSettings.from_environment(environment={}))
    asyncio.run(control.configure(served))
    assert control.store is not None
    return control.store


def plan_follower(places: Sequence[str | Path], settings: ServerSettings) -> PlanFollower:
    """Return what serves these folders and URIs; nothing is read yet. Raises UsageError."""
    limits, cache, timeout_s = BundleLimits(settings.max_policy_bytes), settings.cache, settings.load_timeout_s
    repository = Repository(places, limits, cache=cache, cache_bytes=settings.cache_bytes, timeout_s=timeout_s)
    load = partial(Policy.load, threads=settings.threads, limits=limits)
    loader = VersionLoader(repository, load, options=settings.policy_options, timeout_s=timeout_s)
    return PlanFollower(loader, PlanFiles(places, root=settings.plan, cache=cache, timeout_s=timeout_s))
