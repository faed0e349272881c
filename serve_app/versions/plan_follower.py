"""Versions that one process serves: it follows the plan, and carries out commands that change it.

A change is proven here, written under the plan's next number, and refused if a conflicting one came first. A process
replaces its store as a whole, and keeps the old one if it cannot follow. Bundles and plans are read in threads with a
time-out, and nothing is locked meanwhile: requests and other changes continue, also if a file system hangs.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlservo.bundle.contract import version_key
from rlservo.bundle.production import hash_of
from rlservo.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.repository.repository import Key, Listing
from rlservo.serve_app.versions.deployment_plan import Loadable, Plan, PolicyPlan, ServedConfig
from rlservo.serve_app.versions.plan_commands import Command, Load, Poll, agrees, differences, first_policies
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.version_loader import VersionLoader

logger = logging.getLogger(__name__)

ATTEMPTS = 10  # at a number, while others change something else
RETRY_PERIOD_S = 30.0  # [s] between attempts at a version that could not be loaded
REFUSED_PERIOD_S = 300.0  # [s] between attempts at a new version that was refused, when no command asked for it


@dataclass(frozen=True)
class VersionState:
    """State of one version in this process."""

    state: str  # loading, ready or failed
    reason: str = ""
    loaded_at: str | None = None


class PlanFollower:
    """Versions that this process serves, and their changes."""

    def __init__(self, loader: VersionLoader, files: PlanFiles) -> None:
        self.store: PolicyStore | None = None
        self.plan: Plan | None = None
        self.recent: tuple[Plan, ...] = ()  # the plan and some before it, the newest first
        self.loader = loader
        self.files = files
        self._failed: dict[Loadable, RlservoError] = {}  # why this process serves something older than the plan
        self._refused: dict[Key, str] = {}  # by the last command that this process carried out
        self._refused_until: dict[Loadable, float] = {}  # new versions that polling leaves out for a while
        self._tried_at = 0.0
        self._config = ServedConfig()  # which versions polling may load
        self._listing = Listing()  # of the last look

    @property
    def behind(self) -> tuple[str, ...]:
        """Why this process serves something older than the plan, a sentence per version."""
        return tuple(error.message for error in self._failed.values())

    # Change the plan.

    async def configure(self, document: Any, server_folder: Path | None = None) -> None:
        """Serve the plan; if the repository has none yet, first write the one that a configuration means.

        If object storage is unreachable, the last plan that this machine has read is used. `server_folder` lives as
        long as the server: a process that starts in place of another begins no plan if the one that the others follow
        is lost, because it would serve other versions than they do. Raises UsageError, BundleError and
        UnavailableError.
        """
        followed = None if server_folder is None else server_folder / f"{hash_of(self.files.place)}.followed"
        self._config = ServedConfig.parse(document)
        try:
            plan = await self.files.call(self.files.newest)
        except UnavailableError as error:
            plan = await self.files.call(self.files.remembered)
            if plan is None:
                raise
            logger.warning("%s: serving plan %d, the last one that was seen here", error.message, plan.generation)
        if plan is None:
            if self.plan is not None or (followed is not None and followed.exists()):
                raise UnavailableError(
                    f"{self.files.place} has lost the plan that this server follows: restore it, or begin another with "
                    "`rlservo policy load NAME --repository PLACE`"
                )
            plan = await self._write(await self._unwritten(), None, "")
        elif document and not agrees(plan, self._config):
            logger.warning(
                "plan %d in %s (%s) differs from the configuration and is used: `rlservo policy` changes it",
                plan.generation,
                self.files.place,
                plan.changed_by,
            )
        await self.files.call(self.files.note_places)
        await self._apply(plan)
        if followed is not None:
            followed.touch()

    async def give(self, command: Command, name: str) -> Plan:
        """Carry out a command on a policy as `write` does; return the plan when this process serves it."""
        self._refused = {}
        self._generation()
        try:
            plan = await self.write(command, name)
        except RefusedError as error:
            refused = error.details.get("versions", ())
            self._refused = {(each["name"], each["version"]): each["reason"] for each in refused}
            raise
        await self._apply(plan)
        return plan

    async def write(self, command: Command, name: str) -> Plan:
        """Carry out a command on a policy, for others to serve; return the plan with it.

        Nothing has changed when this raises: what `Command.change` and `Listing.find` raise, RefusedError if a version
        cannot be served, UnavailableError if something could not be read or written, and ConflictError if another
        command changed the same alias, version, canary or shadow at the same time.
        """
        try:
            if isinstance(command, Load):
                command = Load.of(*(await self.loader.look()).find(name, command.version))
            known = 0 if self.plan is None else self.plan.generation  # before the look: later ones need not be in it
            before = await self.files.call(self.files.newest)
            if (0 if before is None else before.generation) < known:
                raise UnavailableError(f"{self.files.place} has lost plan {known}, which is served here")
            return await self._write(before or await self._unwritten(), command, name)
        except (BundleError, UsageError) as error:  # of the repository, of the proof
            raise RefusedError(f"refused, and nothing has changed: {error.message}", error.details) from None

    async def _write(self, before: Plan, command: Command | None, name: str) -> Plan:
        """Write the plan after a command (None: the first plan, as it is), unless another one came first."""
        for _ in range(ATTEMPTS):
            policies = before.policies if command is None else command.change(before, name)
            if policies == before.policies and before.generation:
                return before
            notes = await self.loader.prove(policies, before.policies if before.generation else {})
            plan = before.after(policies, "configuration" if command is None else command.line(name))
            try:
                if await self.files.call(self.files.create, plan):
                    if command is not None:
                        command.notes[:] = notes
                    await self.files.call(self.files.note_places)
                    return plan
            except UnavailableError as error:
                if before.generation:
                    raise
                raise UnavailableError(
                    f"{error.message}: the first plan could not be written; RLSERVO_PLAN names another place for it, "
                    "and `rlservo policy load NAME --repository PLACE` writes it for servers that only read"
                ) from None
            first = await self.files.call(self.files.newest)
            if first is None:
                raise UnavailableError(f"{self.files.place} has lost the plan that was just there")
            ours, theirs = (differences(before.policies, each, name) for each in (policies, first.policies))
            if ours.items() <= theirs.items():
                return first  # another operator has given the same command
            if any(key in theirs and theirs[key] != value for key, value in ours.items()):
                raise ConflictError(
                    f"another command came first (plan {first.generation}: {first.changed_by}), and this one has "
                    "changed nothing: look at `rlservo policy list`, and repeat it if it still applies"
                )
            before = first
        raise UnavailableError("other commands keep changing the plan: try again")

    async def _unwritten(self) -> Plan:
        """Return the plan before the first, which is not written."""
        self._listing = await self.loader.look()
        return Plan(generation=0, policies=first_policies(self._config, self._listing))

    def _generation(self) -> int:
        if self.plan is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return self.plan.generation

    # Follow the plan.

    async def follow(self) -> None:
        """Serve the newest plan if another one is served, and try again what could not be loaded a while ago."""
        plan = await self.files.call(self.files.after, self._generation())
        can_try_again = any(key[:2] not in self.loader.loading for key in self._failed)
        if can_try_again and time.monotonic() - self._tried_at > RETRY_PERIOD_S:
            plan = plan or self.plan
        if plan is not None:
            await self._apply(plan)

    @property
    def has_looked(self) -> bool:
        """Whether it has read what its repository holds."""
        return bool(self._listing.digests)

    async def look(self) -> set[str]:
        """Look for bundles that are not served; return a sentence for each. Raises UnavailableError."""
        self._listing = await self.loader.look()
        return set(self.not_served())

    def not_loaded(self) -> dict[str, list[str]]:
        """Return the versions that the repository held at the last look and the plan does not load, by policy."""
        policies = {} if self.plan is None else self.plan.policies
        left = {
            name: [each for each in versions if name not in policies or each not in policies[name].versions]
            for name, versions in sorted(self._listing.digests.items())
        }
        return {name: versions for name, versions in left.items() if versions}

    def not_served(self) -> list[str]:
        """Return a sentence for each bundle that no operator has left out, with the command that loads it."""
        policies = {} if self.plan is None else self.plan.policies
        return [
            f"{name} version {version} is not served: the plan is older (rlservo policy load {name} {version})"
            for name, versions in self.not_loaded().items()
            for version in versions
            if self._may_load(name) and (name not in policies or version not in policies[name].unloaded)
        ]

    async def load_newer(self) -> set[str]:
        """Load versions newer than all that the plan knows of a policy, as the command `load` does; return the faults.

        Versions that the configuration leaves out are left out here, and so are those that an operator has unloaded.
        """
        listing = await self.loader.look()
        digests, wrong = listing.digests, {error.message for error in listing.errors.values()}
        for name, version in self._newer(digests):
            key = (name, version, digests[name][version])
            if time.monotonic() < self._refused_until.get(key, 0.0):
                continue
            try:
                await self.give(Poll(version=version), name)
            except RlservoError as error:
                wrong.add(error.message)
                if not isinstance(error, UnavailableError):
                    self._refused_until[key] = time.monotonic() + REFUSED_PERIOD_S
        return wrong

    def _newer(self, digests: Mapping[str, Mapping[str, str]]) -> list[Key]:
        """Return the versions that a policy's known ones are all older than; of an unknown policy only the newest."""
        policies = {} if self.plan is None else self.plan.policies
        newer: list[Key] = []
        for name, versions in sorted(digests.items()):
            known = policies.get(name)
            if not self._may_load(name):
                continue
            before = [] if known is None else [version_key(each) for each in (*known.versions, *known.unloaded)]
            later = [(name, version) for version in versions if all(version_key(version) > each for each in before)]
            newer += later if known is not None else later[-1:]
        return newer

    def _may_load(self, name: str) -> bool:
        """Whether the configuration leaves a policy's versions to the repository."""
        listed = self._config.policies.get(name)
        return self._config.unlisted == "load" if listed is None else listed.versions is None

    def states(self) -> dict[str, dict[str, VersionState]]:
        """Return the state of every version that is served, should be, or was refused, by name."""
        states = {key: VersionState("loading") for key in self.loader.loading}
        states |= {key: VersionState("failed", reason) for key, reason in self._refused.items()}
        states |= {key[:2]: VersionState("failed", error.message) for key, error in self._failed.items()}
        for name, policy in ({} if self.store is None else self.store.plans).items():
            for key in policy.loadables(name):
                if (loaded := self.loader.get(key)) is not None:
                    reason = states[key[:2]].reason if key[:2] in states else ""
                    since = loaded.loaded_at.isoformat(timespec="milliseconds")
                    states[key[:2]] = VersionState("ready", reason, since)
        by_name: dict[str, dict[str, VersionState]] = {}
        for (name, version), state in sorted(states.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            by_name.setdefault(name, {})[version] = state
        return by_name

    async def _apply(self, plan: Plan) -> None:
        """Serve a plan policy by policy, each as a whole: one that cannot be loaded stays as it was.

        Raises BundleError if this process serves nothing yet and a default version cannot be loaded.
        """
        self._tried_at, loading = time.monotonic(), self.loader.loading
        wanted = [key for name, policy in plan.policies.items() for key in policy.loadables(name)]
        # A version that is still loading is not waited for again: a file system may hang.
        hanging = {key: error for key, error in self._failed.items() if key in wanted and key[:2] in loading}
        found = hanging | await self.loader.load_all(key for key in wanted if key not in hanging)
        if self.plan is not None and plan.generation < self.plan.generation:
            return  # a later plan has been served while this one was loading
        failed = {key: each for key, each in found.items() if isinstance(each, RlservoError)}
        serving: dict[str, PolicyPlan] = {}
        for name, policy in plan.policies.items():
            errors = {key[1]: failed[key] for key in policy.loadables(name) if key in failed}
            was = None if self.store is None else self.store.plans.get(name)
            if errors and was is not None:
                policy = was
            elif policy.default in errors:
                if self.store is not None:
                    continue  # not served here rather than as another version; `behind` reports it
                raise BundleError(
                    f"policy '{name}' cannot be served as version {policy.default}, its default in plan "
                    f"{plan.generation} of {self.files.place}: {errors[policy.default].message}"
                )
            serving[name] = policy
        kept: dict[Loadable, Policy] = {}
        for key in (key for name, policy in serving.items() for key in policy.loadables(name)):
            loaded = found[key] if key in found else self.loader.get(key)
            if loaded is not None and not isinstance(loaded, RlservoError):
                kept[key] = loaded
        self.loader.keep(kept)
        self.store = PolicyStore(kept.values(), serving, self.store)
        self.plan = plan
        self._failed = failed
        self.recent = (plan,)
        if failed:
            logger.error("plan %d cannot be served as it should: %s", plan.generation, "; ".join(self.behind))
        else:
            logger.info("serving plan %d (%s)", plan.generation, plan.changed_by)
        with contextlib.suppress(UnavailableError):  # an earlier plan is only shown
            recent = await self.files.call(self.files.recent, plan)
            if self.plan is plan:
                self.recent = recent
