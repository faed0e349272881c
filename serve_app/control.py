"""One replica's part in what is served: prove a change, write it down for all, follow what others wrote.

The plans stand in a ledger that all replicas share; whoever makes a change proves it first, appends it under the next
number, and tells the others. A replica swaps one store for the next and keeps the old one where it cannot follow.
Loading happens in a thread of its own, so that requests go on meanwhile. It knows nothing of ray or HTTP.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from rlservo.export.bundle import Contract, version_key
from rlservo.export.errors import (
    BundleError,
    PartlyAppliedError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.library import Key, Library, Loaded, Repository, raise_all
from rlservo.serve_app.plan import (
    FailedVersion,
    Plan,
    PolicyPlan,
    Refusal,
    ServedConfig,
    config_hash,
    now,
    plan_of,
)
from rlservo.serve_app.store import PolicyStore

logger = logging.getLogger(__name__)

ATTEMPTS = 10  # at a number in the ledger, before a change gives up
WATCH_PERIOD_S = 2.0  # [s] between looks at the ledger, for a replica that nobody told
RETRY_PERIOD_S = 30.0  # [s] between attempts of a replica that could not follow

Result = TypeVar("Result")
Change = Callable[[Plan], dict[str, PolicyPlan]]


class Ledger(Protocol):
    """Numbered plans that all replicas see and only add to."""

    def newest(self) -> int:
        """Return the highest number, 0 when there is none."""
        ...

    def read(self, generation: int) -> bytes | None:
        """Return a plan; None when it is not there (any more)."""
        ...

    def append(self, generation: int, content: bytes) -> bool:
        """Write a plan under a number that is free; return False when it is not."""
        ...


@dataclass(frozen=True)
class Following:
    """What a replica answers when it is told of a plan."""

    replica: str
    generation: int
    behind: tuple[str, ...] = ()  # why it serves something older, a sentence per policy or version


@dataclass(frozen=True)
class VersionState:
    """How one version stands on this replica."""

    state: str  # loading, ready or failed
    reason: str = ""
    loaded_at: str | None = None


Broadcast = Callable[[int], Awaitable[Sequence[Following]]]
Gather = Callable[[], Awaitable[Sequence[Any]]]
IsCurrent = Callable[[Any], Awaitable[bool]]


class Control:
    """What this replica serves, and how that changes."""

    def __init__(
        self,
        library: Library,
        ledger: Ledger,
        *,
        replica: str = "",
        broadcast: Broadcast | None = None,
        gather: Gather | None = None,
        is_current: IsCurrent | None = None,
    ) -> None:
        """`broadcast` tells every replica of a number and returns what they answer, `gather` returns every replica's
        listing, and `is_current` says whether a configuration is the one that the deployment has now, since a replica
        may be started with the one before. Without them this replica is the only one.
        """
        self.store: PolicyStore | None = None
        self.plan: Plan | None = None
        self.replica = replica
        self.gather = gather
        self._library = library
        self._ledger = ledger
        self._broadcast = broadcast
        self._is_current = is_current
        self._serving: dict[str, PolicyPlan] = {}
        self._served: dict[str, set[str]] = {}  # every identity that was ever served here, by name
        self._loading: set[Key] = set()
        self._failed: dict[Key, str] = {}
        self._behind: tuple[str, ...] = ()
        self._tried_at = 0.0
        self._lock = asyncio.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="policies")

    async def configure(self, document: Any) -> None:
        """Serve what a configuration says, unless the ledger says something later.

        A replica's first configuration has to be right: raises UsageError or BundleError. A later one that is not is
        written down as refused, and what ran before goes on.
        """
        async with self._lock:
            digest = config_hash(document)
            for _ in range(ATTEMPTS):
                before = await self._newest()
                if before is not None and (before.config == digest or await self._is_late(document)):
                    await self._apply(before)
                    return
                plan = await self._proposed(document, digest, before)
                if await self._append(plan):
                    await self._apply(plan)
                    return
        raise UnavailableError("the other replicas keep changing what is served: configure again")

    async def change(self, change: Change, *, what: str) -> Plan:
        """Make a change and return the plan when every replica serves it.

        `change` may block and runs in the loading thread. `what` is kept as who did what. Raises what `change` raises,
        RefusedError when a version cannot be served (then nothing has changed), and PartlyAppliedError when some
        replicas could not follow (the change stands).
        """
        refused: RefusedError | None = None
        async with self._lock:
            for _ in range(ATTEMPTS):
                before = await self._newest()
                if before is None or self.store is None:
                    raise UnavailableError("the policies are still being loaded: try again shortly")
                try:
                    policies = await self._in_thread(change, before)
                    await self._prove(policies, before.policies)
                    plan, refused = before.after(policies, what), None
                except (BundleError, RefusedError, UsageError) as error:  # of the repository, of the proof
                    refused = RefusedError(f"refused, and nothing has changed: {error.message}", error.details)
                    plan = before.refusing(_refusal(what, error))
                if await self._append(plan):
                    break
            else:
                raise UnavailableError("others keep changing what is served: try again")
            await self._apply(plan)
        if refused is not None:
            with contextlib.suppress(PartlyAppliedError):  # who was not told looks for himself
                await self._tell(plan.generation)
            raise refused
        behind = await self._tell(plan.generation)
        if behind:
            sentences = "; ".join(f"{each.replica}: {'; '.join(each.behind)}" for each in behind)
            raise PartlyAppliedError(
                f"the change stands, but {len(behind)} of the replicas could not follow, and serve what they had: "
                f"{sentences}",
                {"generation": plan.generation, "replicas": {each.replica: list(each.behind) for each in behind}},
            )
        return plan

    async def follow(self, generation: int = 0) -> Following:
        """Serve the newest plan; return whether this replica could."""
        async with self._lock:
            reached = self.plan.generation if self.plan is not None else 0
            if self._behind or reached < generation or reached < await self._in_thread(self._ledger.newest):
                plan = await self._newest()
                if plan is not None:
                    await self._apply(plan)
        return self.following()

    def following(self) -> Following:
        """Return where this replica stands."""
        return Following(self.replica, self.plan.generation if self.plan is not None else 0, self._behind)

    async def watch(self) -> None:
        """Follow what nobody told this replica of, until cancelled: it was starting, or cut off, at the time."""
        while True:
            await asyncio.sleep(WATCH_PERIOD_S)
            try:
                newest = await self._in_thread(self._ledger.newest)
                late = self._behind and time.monotonic() - self._tried_at > RETRY_PERIOD_S
                if late or newest > (self.plan.generation if self.plan is not None else 0):
                    await self.follow()
            except Exception as error:  # the ledger may be out of reach for a while; what is served goes on
                logger.warning("the ledger of policies could not be followed: %s", error)

    @property
    def repository(self) -> Repository:
        """Where the bundles are."""
        return self._library.repository

    def arranged(self, name: str) -> PolicyPlan | None:
        """Return the plan by which this replica serves a policy."""
        return self._serving.get(name)

    def states(self) -> dict[str, dict[str, VersionState]]:
        """Return how every version stands that is served, should be, or was refused."""
        states: dict[Key, VersionState] = {}
        if self.plan is not None:
            for failed in self.plan.refused.versions if self.plan.refused is not None else ():
                states[failed.name, failed.version] = VersionState("failed", failed.reason)
        states.update({key: VersionState("failed", reason) for key, reason in self._failed.items()})
        for name, policy in self._serving.items():
            for version, digest in policy.versions.items():
                loaded = self._library.get(name, version, digest)
                if loaded is not None:
                    reason = states[name, version].reason if (name, version) in states else ""
                    states[name, version] = VersionState("ready", reason, loaded.loaded_at)
        states.update({key: VersionState("loading") for key in self._loading if key not in states})
        by_name: dict[str, dict[str, VersionState]] = {}
        for (name, version), state in sorted(states.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            by_name.setdefault(name, {})[version] = state
        return by_name

    def close(self) -> None:
        """End the loading thread."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _proposed(self, document: Any, digest: str, before: Plan | None) -> Plan:
        """Return the plan that a configuration means, or the one that refuses it."""
        try:
            config = ServedConfig.read(document)
            available = await self._in_thread(self._library.repository.available, config)
            policies = plan_of(config, available, before)
            await self._prove(policies, {} if before is None else before.policies)
        except RlservoError as error:
            if before is None:
                raise
            logger.error("the configuration is refused, what ran before goes on: %s", error.message)
            return before.refusing(_refusal("configuration", error), config=digest)
        if before is None:
            return Plan(generation=1, config=digest, policies=policies, changed_at=now(), changed_by="configuration")
        return before.after(policies, "configuration").model_copy(update={"config": digest})

    async def _prove(self, policies: Mapping[str, PolicyPlan], before: Mapping[str, PolicyPlan]) -> None:
        """Load what is new or newly relied on in `policies`. Raises RefusedError with all that cannot be served."""
        failures: list[tuple[Key, RlservoError]] = []
        for name, policy in policies.items():
            was = before.get(name)
            if policy == was:
                continue
            relied_on = {policy.default, *policy.aliases.values()}
            known = {} if was is None else was.versions
            for version, digest in policy.versions.items():
                if known.get(version) != digest or version in relied_on:
                    try:
                        await self._load(name, version, digest)
                    except RlservoError as error:
                        failures.append(((name, version), error))
            if not failures:
                await self._check_companions(name, policy)
        if failures:
            details = {"versions": [{"name": n, "version": v, "reason": e.message} for (n, v), e in failures]}
            try:
                raise_all([BundleError(error.message) for _, error in failures])
            except BundleError as error:
                raise RefusedError(error.message, details) from None

    async def _check_companions(self, name: str, policy: PolicyPlan) -> None:
        """Refuse a canary or shadow that reads or gives something else than the default version."""
        references = {"canary": policy.canary and policy.canary.version, "shadow": policy.shadow}
        for role, reference in references.items():
            version = policy.version_of(reference) if reference else None
            if version is None or policy.default is None:
                continue
            theirs = (await self._load(name, version, policy.versions[version])).policy.contract
            ours = (await self._load(name, policy.default, policy.versions[policy.default])).policy.contract
            if _interface(theirs) != _interface(ours):
                raise RefusedError(
                    f"policy '{name}' version {version} cannot be the {role} of version {policy.default}: its "
                    "observations or actions are of other names, types or shapes"
                )
            if role == "canary" and theirs.state != ours.state:
                raise RefusedError(
                    f"policy '{name}' version {version} cannot be the canary of version {policy.default}: what it "
                    "remembers of an episode is something else"
                )
            if role == "shadow" and theirs.state:
                raise RefusedError(
                    f"policy '{name}' version {version} remembers its episode: a shadow computes on single observations"
                )

    async def _load(self, name: str, version: str, digest: str) -> Loaded:
        loaded = self._library.get(name, version, digest)
        if loaded is not None:
            return loaded
        self._loading.add((name, version))
        try:
            return await self._in_thread(self._library.load, name, version, digest)
        finally:
            self._loading.discard((name, version))

    async def _apply(self, plan: Plan) -> None:
        """Serve a plan: policy by policy as a whole, so that one which cannot be loaded stays as it was.

        Raises BundleError when this replica serves nothing yet and a default version cannot be loaded.
        """
        self._tried_at = time.monotonic()
        serving: dict[str, PolicyPlan] = {}
        kept: dict[tuple[str, str, str], Loaded] = {}
        failed: dict[Key, str] = {}
        behind: list[str] = []
        for name, wanted in plan.policies.items():
            loaded: dict[tuple[str, str, str], Loaded] = {}
            errors: dict[str, RlservoError] = {}
            for version, digest in wanted.versions.items():
                try:
                    loaded[name, version, digest] = await self._load(name, version, digest)
                except RlservoError as error:
                    errors[version] = error
                    failed[name, version] = error.message
            behind += [error.message for error in errors.values()]
            was = self._serving.get(name)
            if errors and was is not None:
                wanted = was
                keys = [(name, version, digest) for version, digest in was.versions.items()]
                loaded = {key: each for key in keys if (each := self._library.get(*key)) is not None}
            elif errors and wanted.default in errors:
                if self.store is not None:
                    continue  # not served here rather than as another version; `behind` says so
                raise BundleError(
                    f"policy '{name}' cannot be served as version {wanted.default}, its default: "
                    f"{errors[wanted.default].message}"
                )
            serving[name] = wanted
            kept.update(loaded)
        self._library.keep(kept)
        # From here on nothing waits: whoever asks sees all of the old or all of the new.
        policies = [loaded.policy for loaded in kept.values()]
        for policy in policies:
            self._served.setdefault(policy.contract.name, set()).add(policy.identity)
        changed = [name for name, identities in self._served.items() if len(identities) > 1]
        self.store = PolicyStore(policies, serving, changed=changed, replaces=self.store)
        self.plan, self._serving, self._failed, self._behind = plan, serving, failed, tuple(behind)
        if behind:
            logger.error("generation %d cannot be served as it should: %s", plan.generation, "; ".join(behind))
        else:
            logger.info("serving generation %d (%s)", plan.generation, plan.changed_by)

    async def _tell(self, generation: int) -> list[Following]:
        """Tell every replica; return those that did not follow."""
        replies = [self.following()] if self._broadcast is None else await self._broadcast(generation)
        return [reply for reply in replies if reply.behind or reply.generation < generation]

    async def _is_late(self, document: Any) -> bool:
        return self._is_current is not None and not await self._is_current(document)

    async def _newest(self) -> Plan | None:
        for _ in range(ATTEMPTS):  # it may be gone by the time it is read, when many follow at once
            generation = await self._in_thread(self._ledger.newest)
            if generation == 0:
                return None
            content = await self._in_thread(self._ledger.read, generation)
            if content is not None:
                return Plan.model_validate_json(content)
        raise UnavailableError("the ledger of policies changes faster than it can be read")

    async def _append(self, plan: Plan) -> bool:
        return await self._in_thread(self._ledger.append, plan.generation, plan.model_dump_json().encode())

    async def _in_thread(self, function: Callable[..., Result], *arguments: Any) -> Result:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)


def _interface(contract: Contract) -> tuple[Any, ...]:
    """Return what a caller must know of a policy: what goes in and what comes out."""
    inputs = tuple(tensor for tensor in contract.inputs if not tensor.name.startswith("state_in."))
    actions = tuple(tensor for tensor in contract.outputs if tensor.name.split(".")[0] == "action")
    return inputs, actions


def _refusal(change: str, error: RlservoError) -> Refusal:
    failed = error.details.get("versions", ()) if isinstance(error, RefusedError) else ()
    versions = tuple(FailedVersion(**version) for version in failed)
    return Refusal(change=change, reason=error.message, at=now(), versions=versions)
