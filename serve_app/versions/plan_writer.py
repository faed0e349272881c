"""Changes of the plan: proven here, written under the next number, and refused if a conflicting one came first."""

from __future__ import annotations

import logging

from rlservo.export.contract.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.versions.plan_commands import Command, Load, differences, first_policies
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.serving_plan import Plan, ServedConfig, now
from rlservo.serve_app.versions.version_loader import VersionLoader

logger = logging.getLogger(__name__)

ATTEMPTS = 10  # at a number, while others change something else
REFUSALS = (BundleError, RefusedError, UsageError)  # of the repository, of the proof


class PlanWriter:
    """Writes the plan of a repository."""

    def __init__(self, loader: VersionLoader, files: PlanFiles) -> None:
        self._loader = loader
        self._files = files

    async def at_start(self, config: ServedConfig) -> Plan:
        """Return the newest plan; if there is none, prove and write the one that a configuration means.

        If object storage is unreachable, the last plan that this machine has read is used. Raises UsageError,
        BundleError and UnavailableError.
        """
        try:
            plan = await self._files.call(self._files.newest)
        except UnavailableError as error:
            plan = await self._files.call(self._files.remembered)
            if plan is None:
                raise
            logger.warning("%s: serving plan %d, the last one that was seen here", error.message, plan.generation)
        if plan is not None:
            return plan
        try:
            return await self._write(await self._unwritten(config), None, "", "configuration")
        except RefusedError as error:  # there is nothing that could continue to be served
            raise BundleError(error.message, error.details) from None

    async def give(self, command: Command, name: str, *, by: str = "", known: int = 0) -> Plan:
        """Carry out a command on a policy; return the plan with it.

        `by` is kept as the author of the change, the command's own line by default; `known` is the number of a plan
        that must exist. Nothing has changed when this raises: what `Command.change` and `Listing.find` raise,
        RefusedError if a version cannot be served, UnavailableError if something could not be read or written, and
        ConflictError if another command changed the same alias, version, canary or shadow at the same time.
        """
        try:
            if isinstance(command, Load):
                command = Load.of(*(await self._loader.look()).find(name, command.version))
            by = by or command.line(name)
            before = await self._files.call(self._files.newest)
            if (before.generation if before is not None else 0) < known:
                raise UnavailableError(f"{self._files.place} has lost plan {known}, which is served here")
            return await self._write(before or await self._unwritten(ServedConfig()), command, name, by)
        except REFUSALS as error:
            raise _refused(error) from None

    async def _write(self, before: Plan, command: Command | None, name: str, by: str) -> Plan:
        """Write the plan after a command (None: the first plan, as it is), unless another one came first."""
        for _ in range(ATTEMPTS):
            policies = before.policies if command is None else command.change(before, name)
            if policies == before.policies and before.generation:
                return before
            await self._loader.prove(policies, before.policies if before.generation else {})
            plan = before.after(policies, by)
            try:
                if await self._files.call(self._files.create, plan):
                    return plan
            except UnavailableError as error:
                if before.generation:
                    raise
                raise UnavailableError(
                    f"{error.message}: the first plan could not be written; RLSERVO_PLAN names another place for it, "
                    "and `rlservo policy load NAME --repository PLACE` writes it for servers that only read"
                ) from None
            first = await self._files.call(self._files.newest)
            if first is None:
                raise UnavailableError(f"{self._files.place} has lost the plan that was just there")
            ours, theirs = differences(before.policies, policies), differences(before.policies, first.policies)
            if ours.items() <= theirs.items():
                return first  # another operator has given the same command
            if any(key in theirs and theirs[key] != value for key, value in ours.items()):
                raise ConflictError(
                    f"another command came first (plan {first.generation}: {first.changed_by}), and this one has "
                    "changed nothing: look at `rlservo policy list`, and repeat it if it still applies"
                )
            before = first
        raise UnavailableError("other commands keep changing the plan: try again")

    async def _unwritten(self, config: ServedConfig) -> Plan:
        """Return the plan before the first, which is not written."""
        policies = first_policies(config, (await self._loader.look()).available(needs_all=config.wants_all))
        return Plan(generation=0, policies=policies, changed_at=now(), changed_by="configuration")


def _refused(error: RlservoError) -> RefusedError:
    return RefusedError(f"refused, and nothing has changed: {error.message}", error.details)
