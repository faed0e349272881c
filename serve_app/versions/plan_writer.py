"""Changes of the plan: proven here, written under the next number, and reported if another came first."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from rlservo.export.contract.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.serving_plan import Plan, PolicyPlan, ServedConfig, now
from rlservo.serve_app.versions.version_loader import VersionLoader

logger = logging.getLogger(__name__)

ATTEMPTS = 10  # at a number, while others change something else
REFUSALS = (BundleError, RefusedError, UsageError)  # of the repository, of the proof

Change = Callable[[Plan], dict[str, PolicyPlan]]
Result = TypeVar("Result")


class PlanWriter:
    """Reads and writes the plan of a repository."""

    def __init__(self, loader: VersionLoader, files: PlanFiles) -> None:
        self._loader = loader
        self._files = files
        self._calls = BlockingCalls()

    async def newest(self) -> Plan | None:
        """Return the newest plan, if there is one. Raises UnavailableError."""
        return await self._run(self._files.newest, "reading")

    async def after(self, number: int) -> Plan | None:
        """Return the newest plan that has followed one; None where none has. Raises UnavailableError."""
        return await self._run(lambda: self._files.after(number), "reading")

    async def at_start(self, config: ServedConfig) -> Plan:
        """Return the newest plan; if there is none, write the one that a configuration means, as `change` does.

        Where object storage is unreachable, the plan that this machine saw last will do. Raises UsageError,
        BundleError and UnavailableError.
        """
        try:
            plan = await self.newest()
        except UnavailableError as error:
            plan = await self._run(self._files.remembered, "reading")
            if plan is None:
                raise
            logger.warning("%s: serving plan %d, the last one that was seen here", error.message, plan.generation)
        while plan is None:
            first = await self._unwritten(config)
            try:
                await self._loader.prove(first.policies, {})
            except RefusedError as error:  # nothing is served that could continue
                raise BundleError(error.message, error.details) from None
            plan = first.after(first.policies, "configuration")
            try:
                if not await self._create(plan):
                    plan = await self.newest()
            except UnavailableError as error:
                raise UnavailableError(
                    f"{error.message}: the first plan could not be written; RLSERVO_PLAN names another place for it, "
                    "and `rlservo policy load NAME --repository PLACE` writes it for servers that only read"
                ) from None
        return plan

    async def load(self, name: str, version: str | None, *, what: str, known: int = 0) -> Plan:
        """Find a version in the repository (None: the newest), and add it as `change` does.

        Raises what `Listing.find` and `change` raise.
        """
        try:
            found, digest = (await self._loader.look()).find(name, version)
        except REFUSALS as error:
            raise _refused(error) from None
        add = partial(plan_changes.load, name=name, version=found, digest=digest)
        return await self.change(add, what=what, known=known)

    async def change(self, change: Change, *, what: str, known: int = 0) -> Plan:
        """Make a change; return the plan with it.

        `change` must not block. `what` is kept as who did what; `known` is the number of a plan that there must be.
        Nothing has changed when this raises: what `change` raises, RefusedError when a version cannot be served,
        UnavailableError when something could not be read or written, and ConflictError when another command changed the
        same alias, version, canary or shadow at the same time.
        """
        before = await self.newest()
        if (before.generation if before is not None else 0) < known:
            raise UnavailableError(f"{self._files.place} has lost plan {known}, which is served here")
        if before is None:
            before = await self._unwritten(ServedConfig())
        for _ in range(ATTEMPTS):
            policies = change(before)
            if policies == before.policies and before.generation:
                return before
            try:
                await self._loader.prove(policies, before.policies if before.generation else {})
            except REFUSALS as error:
                raise _refused(error) from None
            plan = before.after(policies, what)
            if await self._create(plan):
                return plan
            first = await self.newest()
            if first is None:
                raise UnavailableError(f"{self._files.place} has lost the plan that was just there")
            ours = plan_changes.differences(before.policies, policies)
            theirs = plan_changes.differences(before.policies, first.policies)
            if ours.items() <= theirs.items():
                return first  # another has given the same command
            if any(key in theirs and theirs[key] != value for key, value in ours.items()):
                raise ConflictError(
                    f"another command came first (plan {first.generation}: {first.changed_by}), and this one has "
                    "changed nothing: look at `rlservo policy list`, and give it again if it still holds"
                )
            before = first
        raise UnavailableError("others keep changing what is served: try again")

    async def _unwritten(self, config: ServedConfig) -> Plan:
        available = (await self._loader.look()).available(needs_all=config.wants_all)
        policies = plan_changes.plan_of(config, available, None)
        return Plan(generation=0, policies=policies, changed_at=now(), changed_by="configuration")

    async def _create(self, plan: Plan) -> bool:
        return await self._run(lambda: self._files.create(plan), "writing")

    async def _run(self, function: Callable[[], Result], doing: str) -> Result:
        what = f"{doing} the plan of what is served"
        return await self._calls.run(function, timeout_s=self._files.timeout_s, what=what)


def _refused(error: RlservoError) -> RefusedError:
    return RefusedError(f"refused, and nothing has changed: {error.message}", error.details)
