"""Commands of `rlservo policy` on a repository, without a server: proven here; servers of the repository follow."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from rlservo.export.contract.errors import RequestError, UsageError
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import plan_files, version_loader
from rlservo.serve_app.versions.plan_commands import Changed, parse
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.serving_plan import Plan


class OfflineCommands:
    """Commands of `AdminClient` without a server. Each raises an error for a fault of the repository or the command."""

    def __init__(self, places: Sequence[str]) -> None:
        """Take the places that `rlservo serve` gets, in the same order. Raises UsageError."""
        settings = ServerSettings.from_environment()
        self._files = plan_files(places, settings)
        self._loader = version_loader(places, settings)

    def command(self, name: str, command: str, document: dict[str, Any]) -> dict[str, Any]:
        """Carry out a command on a policy; return its new listing, as the server would."""
        try:
            given = parse(command, document)
        except RequestError as error:
            raise UsageError(error.message) from None
        plan = asyncio.run(PlanFollower(self._loader, self._files).write(given, name))
        return {**Changed.of(plan, name).model_dump(), "place": self._files.place}

    def listing(self) -> dict[str, Any]:
        """Return the newest plan, and for each policy the versions of the repository that it does not load.

        Raises BundleError or UnavailableError if there is neither a plan nor a policy.
        """
        return asyncio.run(self._listing())

    async def _listing(self) -> dict[str, Any]:
        plan = await self._files.call(self._files.newest)
        listing = await self._loader.look()
        digests, errors = listing.digests, listing.errors.values()
        if plan is None and not digests:
            listing.available(needs_all=True)
        policies = {} if plan is None else plan.policies
        others: dict[str, list[str]] = {name: [] for name, policy in policies.items() if policy.versions}
        for name, versions in digests.items():
            loaded = policies[name].versions if name in policies else {}
            others[name] = [version for version in versions if version not in loaded]
        return {
            "place": self._files.place,
            "generation": 0 if plan is None else plan.generation,
            "changed_by": plan and plan.changed_by,
            "changed_at": plan and plan.changed_at,
            "policies": [{**_described(plan, name), "not_loaded": others[name]} for name in sorted(others)],
            "errors": [error.message for error in errors],
        }


def _described(plan: Plan | None, name: str) -> dict[str, Any]:
    changed = Changed.of(plan or Plan(generation=0, policies={}), name)
    return {"name": name, **changed.model_dump(exclude={"generation", "policy"})}
