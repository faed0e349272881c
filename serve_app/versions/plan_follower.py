"""Versions that one process serves: it follows the plan, and carries out commands that change it.

A process replaces its store as a whole, and keeps the old one if it cannot follow. Bundles and plans are read in
threads with a time-out, and nothing is locked meanwhile: requests and other changes continue, also if a file system
hangs.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import BundleError, RefusedError, RlservoError, UnavailableError
from rlservo.serve_app.repository.remote_repository import Key
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions.plan_commands import Command, Load, agrees
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_writer import PlanWriter
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.serving_plan import Plan, PolicyPlan, ServedConfig, timestamp
from rlservo.serve_app.versions.version_loader import Loadable, VersionLoader

logger = logging.getLogger(__name__)

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

    def __init__(self, loader: VersionLoader, files: PlanFiles, *, replica: str = "") -> None:
        self.store: PolicyStore | None = None
        self.plan: Plan | None = None
        self.replica = replica
        self._loader = loader
        self._files = files
        self._writer = PlanWriter(loader, files)
        self._served: dict[str, set[str]] = {}  # every identity that was ever served here, by name
        self._failed: dict[Loadable, RlservoError] = {}  # why this process serves something older than the plan
        self._refused: dict[Key, str] = {}  # by the last command that this process carried out
        self._refused_until: dict[Loadable, float] = {}  # new versions that polling leaves out for a while
        self._tried_at = 0.0
        self._config = ServedConfig()  # which versions polling may load

    @property
    def behind(self) -> tuple[str, ...]:
        """Why this process serves something older than the plan, a sentence per version."""
        return tuple(error.message for error in self._failed.values())

    async def configure(self, document: Any) -> None:
        """Serve the plan; if the repository has none yet, first write the one that a configuration means.

        Raises UsageError, BundleError and UnavailableError.
        """
        self._config = ServedConfig.parse(document)
        plan = await self._writer.at_start(self._config)
        if document and not agrees(plan, self._config):
            logger.warning(
                "plan %d in %s (%s) differs from the configuration and is used: `rlservo policy` changes it",
                plan.generation,
                self._files.place,
                plan.changed_by,
            )
        await self._apply(plan)

    async def give(self, command: Command, name: str, *, by: str = "") -> Plan:
        """Carry out a command as `PlanWriter.give` does; return the plan when this process serves it."""
        self._refused = {}
        try:
            plan = await self._writer.give(command, name, by=by, known=self._generation())
        except RefusedError as error:
            refused = error.details.get("versions", ())
            self._refused = {(each["name"], each["version"]): each["reason"] for each in refused}
            raise
        await self._apply(plan)
        return plan

    def _generation(self) -> int:
        if self.plan is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return self.plan.generation

    async def follow(self) -> None:
        """Serve the newest plan if another one is served, and try again what could not be loaded a while ago."""
        plan = await self._files.call(self._files.after, self._generation())
        can_try_again = any(key[:2] not in self._loader.loading for key in self._failed)
        if can_try_again and time.monotonic() - self._tried_at > RETRY_PERIOD_S:
            plan = plan or self.plan
        if plan is not None:
            await self._apply(plan)

    async def poll_plan(self) -> None:
        """Follow the plans that others write, until cancelled."""
        warning = asyncio.create_task(self._warn_of_newer())  # the plan is followed even if that hangs
        try:
            await _always(self._files.poll_s, self.follow, "the plan cannot be followed")
        finally:
            warning.cancel()

    async def _warn_of_newer(self) -> None:
        with contextlib.suppress(UnavailableError):
            newer = ", ".join(" ".join(key) for key in self._newer((await self._loader.look()).digests)[:10])
            if newer:
                number = self._generation()
                logger.warning(
                    "newer than the versions of plan %d, and not loaded: %s (`rlservo policy load`)", number, newer
                )

    async def poll_repository(self, period_s: float) -> None:
        """Load versions newer than all that the plan knows of a policy, as the command `load` does, until cancelled.

        Versions that the configuration leaves out are left out here, and so are those that an operator has unloaded.
        """
        await _always(period_s, self._load_newer, "looking for new versions failed")

    async def _load_newer(self) -> set[str]:
        """Load the newer versions; return what was wrong with others."""
        listing = await self._loader.look()
        digests, wrong = listing.digests, {error.message for error in listing.wrong}
        for name, version in self._newer(digests):
            key = (name, version, digests[name, version])
            if time.monotonic() < self._refused_until.get(key, 0.0):
                continue
            try:
                await self.give(Load(version=version), name, by=f"poll {name} {version}")
            except RlservoError as error:
                wrong.add(error.message)
                if not isinstance(error, UnavailableError):
                    self._refused_until[key] = time.monotonic() + REFUSED_PERIOD_S
        return wrong

    def _newer(self, digests: Mapping[Key, str]) -> list[Key]:
        """Return the versions that a policy's known ones are all older than; of an unknown policy only the newest."""
        policies = {} if self.plan is None else self.plan.policies
        newer: list[Key] = []
        for name, version in sorted(digests, key=lambda key: (key[0], version_key(key[1]))):
            listed, known = self._config.policies.get(name), policies.get(name)
            if self._config.unlisted == "ignore" if listed is None else listed.versions is not None:
                continue
            if known is None and newer and newer[-1][0] == name:
                newer.pop()
            before = () if known is None else (*known.versions, *known.unloaded)
            if all(version_key(version) > version_key(each) for each in before):
                newer.append((name, version))
        return newer

    def states(self) -> dict[str, dict[str, VersionState]]:
        """Return the state of every version that is served, should be, or was refused, by name."""
        states = {key: VersionState("failed", reason) for key, reason in self._refused.items()}
        states.update({key[:2]: VersionState("failed", error.message) for key, error in self._failed.items()})
        for name, policy in ({} if self.store is None else self.store.plans).items():
            for version, digest in policy.versions.items():
                loaded = self._loader.get(name, version, digest)
                if loaded is not None:
                    reason = states[name, version].reason if (name, version) in states else ""
                    states[name, version] = VersionState("ready", reason, timestamp(loaded.loaded_at))
        states.update({key: VersionState("loading") for key in self._loader.loading if key not in states})
        by_name: dict[str, dict[str, VersionState]] = {}
        for (name, version), state in sorted(states.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            by_name.setdefault(name, {})[version] = state
        return by_name

    async def _apply(self, plan: Plan) -> None:
        """Serve a plan policy by policy, each as a whole: one that cannot be loaded stays as it was.

        Raises BundleError if this process serves nothing yet and a default version cannot be loaded.
        """
        self._tried_at, loading = time.monotonic(), self._loader.loading
        found: dict[Loadable, Policy | RlservoError] = {}
        for name, wanted in plan.policies.items():
            for version, digest in wanted.versions.items():
                key = (name, version, digest)
                try:  # a version that is still loading is not waited for again: a file system may hang
                    hanging = self._failed.get(key) if key[:2] in loading else None
                    found[key] = hanging or await self._loader.load(*key)
                except RlservoError as error:
                    found[key] = error
        self._arrange(plan, found)
        await self._loader.touch([digest for _, _, digest in found])

    def _arrange(self, plan: Plan, found: Mapping[Loadable, Policy | RlservoError]) -> None:
        """Serve the part of a plan that could be loaded. Nothing waits: a request sees the old or the new store."""
        if self.plan is not None and plan.generation < self.plan.generation:
            return  # a later plan has been served while this one was loading
        serving: dict[str, PolicyPlan] = {}
        kept: dict[Loadable, Policy] = {}
        for name, wanted in plan.policies.items():
            keys = [(name, version, digest) for version, digest in wanted.versions.items()]
            errors = {key[1]: error for key in keys if isinstance(error := found[key], RlservoError)}
            was = None if self.store is None else self.store.plans.get(name)
            if errors and was is not None:
                wanted = was
                keys = [(name, version, digest) for version, digest in was.versions.items()]
            elif errors and wanted.default in errors:
                if self.store is not None:
                    continue  # not served here rather than as another version; `behind` reports it
                raise BundleError(
                    f"policy '{name}' cannot be served as version {wanted.default}, its default in plan "
                    f"{plan.generation} of {self._files.place}: {errors[wanted.default].message}"
                )
            serving[name] = wanted
            for key in keys:
                policy = found.get(key) or self._loader.get(*key)
                if policy is not None and not isinstance(policy, RlservoError):
                    kept[key] = policy
        self._loader.keep(kept)
        for policy in kept.values():
            self._served.setdefault(policy.contract.name, set()).add(policy.identity)
        changed = [name for name, identities in self._served.items() if len(identities) > 1]
        self.store = PolicyStore(kept.values(), serving, changed=changed)
        self.plan = plan
        self._failed = {key: each for key, each in found.items() if isinstance(each, RlservoError)}
        if self._failed:
            logger.error("plan %d cannot be served as it should: %s", plan.generation, "; ".join(self.behind))
        else:
            logger.info("serving plan %d (%s)", plan.generation, plan.changed_by)


async def _always(period_s: float, step: Callable[[], Awaitable[set[str] | None]], fault: str) -> None:
    """Repeat a step until cancelled; log what it returns or raises, each sentence once until it is gone."""
    logged: set[str] = set()
    while True:
        await asyncio.sleep(period_s)
        try:
            wrong = await step() or set()
        except Exception as error:  # it may be out of reach for a while
            wrong = {str(error)}
        for sentence in sorted(wrong - logged):
            logger.warning("%s, serving continues unchanged: %s", fault, sentence)
        logged = wrong
