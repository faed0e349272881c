"""Loading and proof of versions in threads with a time-out, each version once for all who wait for it."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import (
    BundleError,
    BundleTamperedError,
    RefusedError,
    RlservoError,
    UnavailableError,
)
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.plan import PolicyPlan, ServedConfig
from rlservo.serve_app.versions.repository import Key, Repository, raise_all

Loadable = tuple[str, str, str]  # (name, version, hash)
Result = TypeVar("Result")


class VersionLoader:
    """Loads and proves versions while the event loop goes on, also where a file system hangs.

    What it has loaded stays in memory by name, version and hash, until `keep` lets it go.
    """

    def __init__(
        self,
        repository: Repository,
        load: Callable[[Path], Policy] = Policy.load,
        *,
        scan_timeout_s: float = 10.0,
        load_timeout_s: float = 30.0,
    ) -> None:
        """`load` loads and proves one bundle; raises BundleError.

        `scan_timeout_s` is for one look through the repository, `load_timeout_s` for one version.
        """
        self._repository = repository
        self._load_bundle = load
        self._scan_timeout_s = scan_timeout_s
        self._load_timeout_s = load_timeout_s
        self._calls = BlockingCalls()
        self._loaded: dict[Loadable, Policy] = {}
        self._tasks: dict[Loadable, asyncio.Task[Policy]] = {}
        self._timed_out: dict[Loadable, UnavailableError] = {}

    @property
    def loading(self) -> set[Key]:
        """Name and version of what is being loaded."""
        return {(name, version) for name, version, _ in self._tasks}

    def get(self, name: str, version: str, digest: str) -> Policy | None:
        """Return the policy if the bundle with that hash is in memory."""
        return self._loaded.get((name, version, digest))

    async def available(self, config: ServedConfig) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version, as `Repository.available`. Raises UnavailableError, too."""
        return await self._look(self._repository.available, config)

    async def look(self) -> tuple[dict[Key, str], list[RlservoError]]:
        """Return what the repository holds now and what is wrong with it, as `Repository.look`."""
        return await self._look(self._repository.look)

    async def find_digest(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle, as `Repository.find_digest`."""
        return await self._look(self._repository.find_digest, name, version)

    async def load(self, name: str, version: str, digest: str, *, again: bool = True) -> Policy:
        """Load and prove a version unless it is in memory; not `again`: one that timed out is not waited for once more.

        Raises what `Repository.fetch` and `Policy.load` raise, and UnavailableError when it takes too long.
        """
        key = (name, version, digest)
        if key in self._loaded:
            return self._loaded[key]
        if key in self._timed_out and not again:
            raise self._timed_out[key]
        task = self._tasks.get(key)
        if task is None:  # whoever else wants it meanwhile waits for the same
            task = self._tasks[key] = asyncio.create_task(self._load(key))
            task.add_done_callback(lambda done: self._end(key, done))
        return await asyncio.shield(task)

    async def prove(self, policies: Mapping[str, PolicyPlan], before: Mapping[str, PolicyPlan]) -> None:
        """Load what is new or newly relied on in `policies`, and check that canary and shadow fit the default version.

        Raises RefusedError with all that cannot be served, and UnavailableError where it only could not be read,
        or not in time.
        """
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
                        await self.load(name, version, digest)
                    except RlservoError as error:
                        failures.append(((name, version), error))
            if not failures:
                await self._check_companions(name, policy)
        if failures:
            details = {"versions": [{"name": n, "version": v, "reason": e.message} for (n, v), e in failures]}
            try:
                raise_all([error for _, error in failures])
            except UnavailableError as error:
                raise UnavailableError(error.message, details) from None
            except RlservoError as error:
                raise RefusedError(error.message, details) from None

    def keep(self, served: Mapping[Loadable, Policy], planned: Collection[Loadable], proposed: set[Loadable]) -> None:
        """Hold what is served, keep what is proposed, and let all others go; who computes with one is not disturbed.

        Time-outs of versions that are not planned are forgotten.
        """
        for key in list(self._loaded):  # in place: a thread may be adding one at this moment
            if key not in served and key not in proposed:
                self._loaded.pop(key, None)
        self._loaded.update(served)
        self._timed_out = {key: error for key, error in self._timed_out.items() if key in planned}

    async def _look(self, function: Callable[..., Result], *arguments: Any) -> Result:
        what = "looking through the policies' folders"
        timeout_s = self._scan_timeout_s + self._repository.patience_s
        return await self._calls.run(function, *arguments, timeout_s=timeout_s, what=what)

    async def _load(self, key: Loadable) -> Policy:
        what = f"loading policy '{key[0]}' version {key[1]}"
        try:
            policy = await self._calls.run(self._load_accepted, *key, timeout_s=self._load_timeout_s, what=what)
        except UnavailableError as error:
            self._timed_out[key] = error
            raise
        self._timed_out.pop(key, None)
        return policy

    def _load_accepted(self, name: str, version: str, digest: str) -> Policy:
        """Load the bundle that was accepted, in a thread; it is in memory also where nobody waits for it any more."""
        lease = self._repository.fetch(name, version, digest)
        try:
            policy = self._load_bundle(lease.folder)
            contract = policy.contract
            # It was not exchanged meanwhile, neither now nor when its name was read and its hash accepted.
            if (contract.name, contract.version, policy.digest) != (name, version, digest):
                raise BundleTamperedError(
                    f"{lease.folder} is not the bundle that was accepted as version {version} of '{name}': export "
                    "changes under a new version, or load this one again"
                )
        except BaseException as error:
            lease.release()
            if isinstance(error, MemoryError):
                raise BundleError(f"{lease.folder} needs more memory than there is") from None
            raise
        weakref.finalize(policy, lease.release)  # it stays in the cache for as long as somebody uses the policy
        self._loaded[name, version, digest] = policy
        return policy

    def _end(self, key: Loadable, done: asyncio.Task[Policy]) -> None:
        del self._tasks[key]
        if not done.cancelled():
            done.exception()  # who waited has it; if nobody did any more, asyncio would complain

    async def _check_companions(self, name: str, policy: PolicyPlan) -> None:
        """Refuse a canary or shadow that reads or gives something else than the default version."""
        references = {"canary": policy.canary and policy.canary.version, "shadow": policy.shadow}
        for role, reference in references.items():
            version = policy.version_of(reference) if reference else None
            if version is None or policy.default is None:
                continue
            theirs = (await self.load(name, version, policy.versions[version])).contract
            ours = (await self.load(name, policy.default, policy.versions[policy.default])).contract
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


def _interface(contract: Contract) -> tuple[Any, ...]:
    """Return what a caller must know of a policy: what goes in and what comes out."""
    inputs = tuple(tensor for tensor in contract.inputs if not tensor.name.startswith("state_in."))
    actions = tuple(tensor for tensor in contract.outputs if tensor.name.split(".")[0] == "action")
    return inputs, actions
