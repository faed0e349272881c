"""Version changes of one replica: prove a change, write it down for all, follow the others' changes.

The plans stand in a ledger that all replicas share; whoever makes a change proves it first, appends it under the next
number, and tells the others. A replica swaps one store for the next and keeps the old one where it cannot follow.
Whatever touches the bundles happens in threads, with a time-out, and nothing is locked meanwhile: requests and other
changes go on, also where a file system hangs.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import (
    BundleError,
    PartlyAppliedError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.plan import (
    FailedVersion,
    Plan,
    PolicyPlan,
    Refusal,
    ServedConfig,
    config_hash,
    now,
    timestamp,
)
from rlservo.serve_app.versions.plan_ledger import ATTEMPTS, Ledger, PlanLedger
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.repository import Key
from rlservo.serve_app.versions.version_loader import Loadable, VersionLoader

logger = logging.getLogger(__name__)

LEDGER_POLL_S = 2.0  # [s] between looks at the ledger, for a replica that nobody told
RETRY_PERIOD_S = 30.0  # [s] between attempts of a replica that could not follow
REFUSALS = (BundleError, RefusedError, UsageError)  # of the repository, of the proof

Change = Callable[[Plan], dict[str, PolicyPlan]]


@dataclass(frozen=True)
class ReplicaProgress:
    """How far a replica has followed the plans, as it answers when it is to follow one."""

    replica: str
    generation: int
    behind: tuple[str, ...] = ()  # why it serves something older, a sentence per policy or version


@dataclass(frozen=True)
class VersionState:
    """How one version stands on this replica."""

    state: str  # loading, ready or failed
    reason: str = ""
    loaded_at: str | None = None


Broadcast = Callable[[int], Awaitable[Sequence[ReplicaProgress]]]
Gather = Callable[..., Awaitable[Sequence[Any]]]
"""What every replica says: of all policies without an argument, else what it counted of the one named."""
IsCurrent = Callable[[Any], Awaitable[bool]]


class ReplicaVersions:
    """Versions that this replica serves, and their changes."""

    def __init__(
        self,
        loader: VersionLoader,
        ledger: Ledger,
        *,
        replica: str = "",
        broadcast: Broadcast | None = None,
        gather: Gather | None = None,
        is_current: IsCurrent | None = None,
    ) -> None:
        """`broadcast` tells every replica of a number and returns what they answer, `gather` returns every replica's
        listing or counts, and `is_current` says whether a configuration is the one that the deployment has now, since a
        replica may be started with the one before. Without them this replica is the only one.
        """
        self.store: PolicyStore | None = None
        self.plan: Plan | None = None
        self.replica = replica
        self.gather = gather
        self._loader = loader
        self._ledger = PlanLedger(ledger)
        self._broadcast = broadcast
        self._is_current = is_current
        self._served: dict[str, set[str]] = {}  # every identity that was ever served here, by name
        self._proposed: list[set[Loadable]] = []  # what changes that are under way have loaded, and no plan has yet
        self._failed: dict[Key, str] = {}  # why this replica serves something older than the plan says
        self._tried_at = 0.0
        self._config = ServedConfig()  # the last one that could be parsed: what may be loaded without being asked for
        self._writing = asyncio.Lock()  # held while a change that has been proven is written down

    async def configure(self, document: Any) -> None:
        """Serve what a configuration says, unless the ledger says something later.

        A replica's first configuration has to be right: raises UsageError or BundleError. A later one that is not is
        written down as refused, and what ran before goes on.
        """
        digest = config_hash(document)
        with contextlib.suppress(UsageError):
            self._config = ServedConfig.parse(document)
        for _ in range(ATTEMPTS):
            before = await self._ledger.newest()
            if before is not None and (before.config == digest or await self._is_late(document)):
                await self._apply(before)
                return
            plan = await self._configured(document, digest, before)
            if await self._ledger.append(plan):
                await self._apply(plan)
                return
        raise UnavailableError("the other replicas keep changing what is served: configure again")

    async def load(self, name: str, version: str | None, *, what: str) -> Plan:
        """Find a version in the repository (None: the newest), and add it as `change` does.

        Raises what `Repository.find_digest` and `change` raise.
        """
        try:
            found, digest = await self._loader.find_digest(name, version)
        except REFUSALS as error:
            await self._refuse(what, error)
        return await self.change(lambda before: plan_changes.load(before, name, found, digest), what=what)

    async def change(self, change: Change, *, what: str) -> Plan:
        """Make a change and return the plan when every replica serves it.

        `change` must not block. `what` is kept as who did what. Raises what `change` raises, RefusedError when a
        version cannot be served and UnavailableError when it could not be read (then nothing has changed), and
        PartlyAppliedError when some replicas could not follow (the change stands).
        """
        before = await self._ledger.newest()
        if before is None or self.store is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        policies = change(before)
        proposed = _loadables(policies)
        self._proposed.append(proposed)
        try:
            try:
                await self._loader.prove(policies, before.policies)  # meanwhile others may change what they want
                plan = await self._write(change, what)
            except REFUSALS as error:
                await self._refuse(what, error)
            await self._apply(plan)
        finally:
            self._proposed.remove(proposed)
        behind = await self._tell(plan.generation)
        if behind:
            sentences = "; ".join(f"{each.replica}: {'; '.join(each.behind)}" for each in behind)
            raise PartlyAppliedError(
                f"the change stands, but {len(behind)} of the replicas could not follow, and serve what they had: "
                f"{sentences}",
                {"generation": plan.generation, "replicas": {each.replica: list(each.behind) for each in behind}},
            )
        return plan

    async def _write(self, change: Change | Refusal, what: str) -> Plan:
        """Append a change of the newest plan, or the refusal of one, to the ledger."""
        async with self._writing:
            for _ in range(ATTEMPTS):
                before = await self._ledger.newest()
                if before is None:
                    raise UnavailableError("the policies are still being loaded: try again shortly")
                if isinstance(change, Refusal):
                    plan = before.refusing(change)
                else:
                    policies = change(before)
                    # Loaded by now, unless others changed the same policy.
                    await self._loader.prove(policies, before.policies)
                    plan = before.after(policies, what)
                if await self._ledger.append(plan):
                    return plan
        raise UnavailableError("others keep changing what is served: try again")

    async def _refuse(self, what: str, error: RlservoError) -> NoReturn:
        """Write down for all that a change was refused, and why; raise RefusedError."""
        plan = await self._write(_refusal(what, error), what)
        await self._apply(plan)
        with contextlib.suppress(PartlyAppliedError):  # who was not told polls the ledger
            await self._tell(plan.generation)
        raise RefusedError(f"refused, and nothing has changed: {error.message}", error.details) from None

    async def follow(self, generation: int = 0, *, again: bool = False) -> ReplicaProgress:
        """Serve the newest plan; return whether this replica could. `again`: try also what was given up before."""
        if self._failed or self._generation < generation or self._generation < await self._ledger.newest_generation():
            plan = await self._ledger.newest()
            if plan is not None:
                await self._apply(plan, again=again)
        return self.progress()

    @property
    def _generation(self) -> int:
        return self.plan.generation if self.plan is not None else 0

    def progress(self) -> ReplicaProgress:
        """Return where this replica stands."""
        behind = tuple(self._failed.values())
        return ReplicaProgress(self.replica, self._generation, behind)

    async def poll_ledger(self) -> None:
        """Follow plans that this replica was not told of (it was starting, or cut off), until cancelled."""
        while True:
            await asyncio.sleep(LEDGER_POLL_S)
            try:
                newest = await self._ledger.newest_generation()
                late = bool(self._failed) and time.monotonic() - self._tried_at > RETRY_PERIOD_S
                if late or newest > self._generation:
                    await self.follow(again=late)
            except Exception as error:  # the ledger may be out of reach for a while; what is served goes on
                logger.warning("the ledger of policies could not be followed: %s", error)

    async def poll_repository(self, period_s: float) -> None:
        """Load what is newer than all versions that the plan knows of a policy, as `load` does, until cancelled.

        What the configuration leaves out is left out here, too. Each version is tried once, unless it could not be
        reached: what an operator unloads stays unloaded.
        """
        tried: set[Loadable] = set()
        told: set[str] = set()
        while True:
            await asyncio.sleep(period_s)
            try:
                digests, errors = await self._loader.look()
                wrong = {error.message for error in errors}
                for name, version in self._newer(digests):
                    digest = digests[name, version]
                    if (name, version, digest) in tried:
                        continue
                    try:
                        add = partial(plan_changes.load, name=name, version=version, digest=digest)
                        await self.change(add, what=f"poll {name} {version}")
                    except UnavailableError as error:
                        wrong.add(error.message)
                        if not isinstance(error, PartlyAppliedError):
                            continue
                    except RlservoError as error:
                        wrong.add(error.message)
                    tried.add((name, version, digest))
            except Exception as error:
                wrong = {str(error)}
            for sentence in sorted(wrong - told):
                logger.warning("looking for new versions, what is served goes on: %s", sentence)
            told = wrong

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
        """Return how every version stands that is served, should be, or was refused."""
        states: dict[Key, VersionState] = {}
        if self.plan is not None:
            for failed in self.plan.refused.versions if self.plan.refused is not None else ():
                states[failed.name, failed.version] = VersionState("failed", failed.reason)
        states.update({key: VersionState("failed", reason) for key, reason in self._failed.items()})
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

    async def _configured(self, document: Any, digest: str, before: Plan | None) -> Plan:
        """Return the plan that a configuration means, or the one that refuses it."""
        try:
            config = ServedConfig.parse(document)
            available = await self._loader.available(config)
            policies = plan_changes.plan_of(config, available, before)
            await self._loader.prove(policies, {} if before is None else before.policies)
        except RlservoError as error:
            if before is None:
                raise
            logger.error("the configuration is refused, what ran before goes on: %s", error.message)
            return before.refusing(_refusal("configuration", error), config=digest)
        if before is None:
            return Plan(generation=1, config=digest, policies=policies, changed_at=now(), changed_by="configuration")
        return before.after(policies, "configuration").model_copy(update={"config": digest})

    async def _apply(self, plan: Plan, *, again: bool = False) -> None:
        """Serve a plan: policy by policy as a whole, so that one which cannot be loaded stays as it was.

        Raises BundleError when this replica serves nothing yet and a default version cannot be loaded.
        """
        self._tried_at = time.monotonic()
        found: dict[Loadable, Policy | RlservoError] = {}
        for name, wanted in plan.policies.items():
            for version, digest in wanted.versions.items():
                try:
                    found[name, version, digest] = await self._loader.load(name, version, digest, again=again)
                except RlservoError as error:
                    found[name, version, digest] = error
        self._arrange(plan, found)

    def _arrange(self, plan: Plan, found: Mapping[Loadable, Policy | RlservoError]) -> None:
        """Serve a plan with what of it could be loaded. Nothing waits here: who asks sees all of the old or the new."""
        if self.plan is not None and plan.generation < self.plan.generation:
            return  # while this one was being loaded, a later one has been served
        serving: dict[str, PolicyPlan] = {}
        kept: dict[Loadable, Policy] = {}
        failed: dict[Key, str] = {}
        for name, wanted in plan.policies.items():
            loaded: dict[Loadable, Policy] = {}
            errors: dict[str, RlservoError] = {}
            for version, digest in wanted.versions.items():
                one = found[name, version, digest]
                if isinstance(one, RlservoError):
                    errors[version] = one
                    failed[name, version] = one.message
                else:
                    loaded[name, version, digest] = one
            was = None if self.store is None else self.store.plans.get(name)
            if errors and was is not None:
                wanted = was
                keys = [(name, version, digest) for version, digest in was.versions.items()]
                loaded = {key: each for key in keys if (each := self._loader.get(*key)) is not None}
            elif errors and wanted.default in errors:
                if self.store is not None:
                    continue  # not served here rather than as another version; `failed` says so
                raise BundleError(
                    f"policy '{name}' cannot be served as version {wanted.default}, its default: "
                    f"{errors[wanted.default].message}"
                )
            serving[name] = wanted
            kept.update(loaded)
        self._loader.keep(kept, found, set().union(*self._proposed))
        for policy in kept.values():
            self._served.setdefault(policy.contract.name, set()).add(policy.identity)
        changed = [name for name, identities in self._served.items() if len(identities) > 1]
        self.store = PolicyStore(kept.values(), serving, changed=changed, replaces=self.store)
        self.plan, self._failed = plan, failed
        if failed:
            logger.error("generation %d cannot be served as it should: %s", plan.generation, "; ".join(failed.values()))
        else:
            logger.info("serving generation %d (%s)", plan.generation, plan.changed_by)

    async def _tell(self, generation: int) -> list[ReplicaProgress]:
        """Tell every replica; return those that did not follow."""
        replies = [self.progress()] if self._broadcast is None else await self._broadcast(generation)
        return [reply for reply in replies if reply.behind or reply.generation < generation]

    async def _is_late(self, document: Any) -> bool:
        return self._is_current is not None and not await self._is_current(document)


def _loadables(policies: Mapping[str, PolicyPlan]) -> set[Loadable]:
    return {(name, version, digest) for name, each in policies.items() for version, digest in each.versions.items()}


def _refusal(change: str, error: RlservoError) -> Refusal:
    failed = error.details.get("versions", ()) if isinstance(error, (RefusedError, UnavailableError)) else ()
    versions = tuple(FailedVersion(**version) for version in failed)
    return Refusal(change=change, reason=error.message, at=now(), versions=versions)
