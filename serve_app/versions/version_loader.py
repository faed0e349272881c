"""Loading and proof of versions in threads with a time-out, each version once for all callers."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from typing import Any, TypeVar

from rlservo.export.contract.contract import Contract
from rlservo.export.contract.errors import (
    BundleError,
    BundleTamperedError,
    RefusedError,
    RlservoError,
    UnavailableError,
)
from rlservo.serve_app.repository.remote_repository import Key
from rlservo.serve_app.repository.repository import Listing, Repository, raise_all
from rlservo.serve_app.repository.storage import TIMEOUT_S
from rlservo.serve_app.runtime.options import PolicyOptions
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.serving_plan import PolicyPlan

Loadable = tuple[str, str, str]  # (name, version, hash)
Result = TypeVar("Result")


class VersionLoader:
    """Loads and proves versions without blocking the event loop, also if a file system hangs.

    A version that is in memory is not loaded a second time.
    """

    def __init__(
        self,
        repository: Repository,
        load: Callable[..., Policy] = Policy.load,
        *,
        options: Mapping[str, PolicyOptions] | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        """`load` loads and proves one bundle; raises BundleError. `timeout_s` is for one look and for one version.

        `options` are by policy name, '*' is for those not named.
        """
        self._repository = repository
        self._load_bundle = load
        self._options = options or {}
        self._timeout_s = timeout_s
        self._calls = BlockingCalls()
        self._loads: dict[Loadable, Future[Policy]] = {}
        """Loaded versions, and those that are being loaded or could not be."""

    @property
    def loading(self) -> set[Key]:
        """Name and version of what is being loaded."""
        return {(name, version) for (name, version, _), load in self._loads.items() if not load.done()}

    def get(self, name: str, version: str, digest: str) -> Policy | None:
        """Return the policy if the bundle with that hash is in memory."""
        load = self._loads.get((name, version, digest))
        return None if load is None or not load.done() or load.exception() else load.result()

    def keep(self, served: Collection[Loadable]) -> None:
        """Forget the versions in memory that are not served, such as those that were proven for a refused command."""
        self._loads = {key: load for key, load in self._loads.items() if key in served or not load.done()}

    async def look(self) -> Listing:
        """Return what the repository holds now. Raises UnavailableError when that takes too long."""
        return await self._look(self._repository.look)

    async def touch(self, digests: Collection[str]) -> None:
        """Mark bundles as used in the cache, as `Repository.touch`."""
        with contextlib.suppress(UnavailableError):
            await self._look(self._repository.touch, digests)

    async def load(self, name: str, version: str, digest: str) -> Policy:
        """Load and prove a version unless it is in memory.

        Raises what `Repository.fetch` and `Policy.load` raise, and UnavailableError when it takes too long; loading
        continues then, and the next call may find it done.
        """
        key = (name, version, digest)
        load = self._loads.get(key)  # other callers meanwhile wait for the same one
        if load is None or (load.done() and load.exception()):
            load = self._loads[key] = self._calls.start(self._load_accepted, *key)
        what = f"loading policy '{name}' version {version}"
        return await self._calls.wait(load, timeout_s=self._timeout_s, what=what)

    async def prove(self, policies: Mapping[str, PolicyPlan], before: Mapping[str, PolicyPlan]) -> None:
        """Load new versions of `policies` and those with an alias; check that canary and shadow fit the default one.

        Raises RefusedError with every version that cannot be served, and UnavailableError if it only could not be read,
        or not in time.
        """
        failures: list[tuple[Key, RlservoError]] = []
        for name, policy in policies.items():
            was = before.get(name)
            if policy == was:
                continue
            relied_on = set(policy.aliases.values())
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

    async def _look(self, function: Callable[..., Result], *arguments: Any) -> Result:
        what = "looking through the policies' folders"
        return await self._calls.run(function, *arguments, timeout_s=self._timeout_s, what=what)

    def _load_accepted(self, name: str, version: str, digest: str) -> Policy:
        """Load the bundle that was accepted, in a thread."""
        options = self._options.get(name, self._options.get("*"))
        given = {} if options is None else {"options": options}
        with self._repository.fetch(name, version, digest) as folder:
            try:
                policy = self._load_bundle(folder, **given)
            except MemoryError:
                raise BundleError(f"{folder} needs more memory than there is") from None
            contract = policy.contract
            # It may have been exchanged since its name was read and its hash accepted.
            if (contract.name, contract.version, policy.digest) != (name, version, digest):
                raise BundleTamperedError(
                    f"{folder} is not the bundle that was accepted as version {version} of '{name}': export changes "
                    "under a new version, or load this one again"
                )
        return policy

    async def _check_companions(self, name: str, policy: PolicyPlan) -> None:
        """Refuse a canary or shadow whose observations or actions differ from the default version's."""
        for role in ("canary", "shadow"):
            version = policy.version_of(policy.uses.get(f"the {role}", ""))
            if version is None or policy.default is None:
                continue
            both = [await self.load(name, each, policy.versions[each]) for each in (version, policy.default)]
            theirs, ours = (each.contract for each in both)
            if _interface(theirs) != _interface(ours):
                raise RefusedError(
                    f"policy '{name}' version {version} cannot be the {role} of version {policy.default}: its "
                    "observations or actions have other names, types or shapes"
                )
            if role == "canary" and theirs.state != ours.state:
                raise RefusedError(
                    f"policy '{name}' version {version} cannot be the canary of version {policy.default}: its "
                    "recurrent state has other names, types or shapes"
                )
            if role == "shadow" and theirs.state:
                raise RefusedError(
                    f"policy '{name}' version {version} remembers its episode: a shadow computes on single observations"
                )


def _interface(contract: Contract) -> tuple[Any, ...]:
    """Return the tensors of a policy that its callers must know."""
    inputs = tuple(tensor for tensor in contract.inputs if not tensor.name.startswith("state_in."))
    actions = tuple(tensor for tensor in contract.outputs if tensor.name.split(".")[0] == "action")
    return inputs, actions
