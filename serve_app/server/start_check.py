"""Check before a server starts: load and prove everything that it would serve."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rlservo.bundle.bundle import BundleLimits
from rlservo.errors import RlservoError
from rlservo.policy.policy import Policy
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.version_loader import VersionLoader

LOOK_S = 10.0  # [s] that a start waits for a look through the repository


def load_served(places: Sequence[str | Path], served: Any, settings: ServerSettings | None = None) -> PolicyStore:
    """Load and prove the versions that a server of these folders and `served` starts with; write a missing plan.

    Raises UsageError or BundleError, and UnavailableError if a file system or storage does not answer.
    """
    return checked_start(places, served, settings)[0]


def checked_start(
    places: Sequence[str | Path], served: Any, settings: ServerSettings | None = None
) -> tuple[PolicyStore, list[str]]:
    """Return what `load_served` does, and a sentence for each bundle that is not served."""
    control = plan_follower(places, settings or ServerSettings.from_environment(environment={}))

    async def start() -> list[str]:
        await control.configure(served)
        return await not_served(control)

    left_out = asyncio.run(start())
    assert control.store is not None
    return control.store, left_out


async def not_served(control: PlanFollower) -> list[str]:
    """Return a sentence for each bundle that is not served; none if the look takes too long or fails."""
    if control.has_looked:  # for the first plan
        return control.not_served()
    look = asyncio.create_task(control.look())
    await asyncio.wait({look}, timeout=LOOK_S)
    look.cancel()
    with contextlib.suppress(RlservoError, asyncio.CancelledError):
        await look
    return control.not_served()


def plan_follower(places: Sequence[str | Path], settings: ServerSettings) -> PlanFollower:
    """Return what serves these folders and URIs; nothing is read yet. Raises UsageError."""
    limits, cache, timeout_s = BundleLimits(settings.max_policy_bytes), settings.cache, settings.load_timeout_s
    repository = Repository(
        places, limits, cache=cache, cache_bytes=settings.cache_bytes, timeout_s=timeout_s,
        keys=settings.require_signature,
    )  # fmt: skip
    load = partial(Policy.load, threads=settings.threads, limits=limits)
    loader = VersionLoader(repository, load, options=settings.policy_options, timeout_s=timeout_s)
    return PlanFollower(loader, PlanFiles(places, root=settings.plan, cache=cache, timeout_s=timeout_s))
