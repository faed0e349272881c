"""Commands of `rlservo policy` on a repository, without a server: proven here; servers of the repository follow."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlservo.bundle.bundle import load_bundle
from rlservo.errors import RequestError, UsageError
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import plan_follower
from rlservo.serve_app.versions.deployment_plan import Plan
from rlservo.serve_app.versions.plan_commands import Changed, Evaluate, parse


class OfflineCommands:
    """Commands of `AdminClient` without a server. Each raises an error for a fault of the repository or the command."""

    def __init__(self, places: Sequence[str]) -> None:
        """Take the places that `rlservo serve` gets, in the same order. Raises UsageError."""
        self._control = plan_follower(places, ServerSettings.from_environment())

    def command(self, name: str, command: str, document: dict[str, Any]) -> dict[str, Any]:
        """Carry out a command on a policy; return its new listing, as the server would."""
        try:
            given = parse(command, document)
        except RequestError as error:
            raise UsageError(error.message) from None
        plan = asyncio.run(self._control.write(given, name))
        return {**Changed.of(plan, name, given.notes).model_dump(), "place": self._control.files.place}

    def listing(self) -> dict[str, Any]:
        """Return the newest plan, and for each policy the versions of the repository that it does not load.

        Raises BundleError or UnavailableError if there is neither a plan nor a policy.
        """
        return asyncio.run(self._listing())

    async def _listing(self) -> dict[str, Any]:
        files = self._control.files
        plan = await files.call(files.newest)
        listing = await self._control.loader.look()
        if plan is None:
            if not listing.digests:
                listing.available(needs_all=True)
            plan = Plan(generation=0, policies={}, changed_by="")
        others: dict[str, list[str]] = {name: [] for name, policy in plan.policies.items() if policy.versions}
        for name, versions in listing.digests.items():
            loaded = plan.policies[name].versions if name in plan.policies else {}
            others[name] = [version for version in versions if version not in loaded]
        described = {
            name: Changed.of(plan, name).model_dump(exclude={"generation", "policy", "notes"}) for name in others
        }
        return {
            "place": files.place,
            "generation": plan.generation,
            "changed_by": plan.changed_by or None,
            "changed_at": plan.changed_at or None,
            "policies": [{"name": name, **described[name], "not_loaded": others[name]} for name in sorted(others)],
            "errors": [error.message for error in listing.errors.values()],
        }


def accept_evaluation(folder: Path, before: str) -> list[str]:
    """Replace a bundle's hash from before its evaluation in every plan of its folders; return the plans' places.

    Those are the bundle's own, its policy's and the repository's, as served: each may be what a server was given.
    Raises RefusedError if the bundle cannot be served, UnavailableError if a plan cannot be read or written.
    """
    bundle, settings = load_bundle(folder), ServerSettings.from_environment()
    name, version = bundle.contract.name, bundle.contract.version
    command, places = Evaluate.of(version, before, bundle.digest), list[str]()
    for place in (folder, folder.parent, folder.parent.parent):
        control = plan_follower([place], settings)
        if control.files.place in places:  # RLSERVO_PLAN
            continue
        plan = control.files.newest()
        if plan is not None and command.change(plan, name) != plan.policies:
            asyncio.run(control.write(command, name))
            places.append(control.files.place)
    return places
