"""Loading and proof of versions in threads with a time-out, each version once for all callers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import Future

from rlservo.bundle.compatibility import harmless_differences, interface_differences
from rlservo.bundle.contract import Contract
from rlservo.errors import BundleError, RlservoError
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.repository.places import TIMEOUT_S
from rlservo.serve_app.repository.repository import Key, Listing, Repository, exchanged, raise_all
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.computing import Computing
from rlservo.serve_app.versions.deployment_plan import Loadable, PolicyPlan

logger = logging.getLogger(__name__)


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
        self._calls = BlockingCalls(timeout_s)
        self._loads: dict[Loadable, Future[Policy]] = {}
        """Loaded versions, and those that are being loaded or could not be."""

    @property
    def loading(self) -> set[Key]:
        """Name and version of what is being loaded."""
        return {key[:2] for key, load in self._loads.items() if not load.done()}

    def get(self, key: Loadable) -> Policy | None:
        """Return the policy if the bundle with that hash is in memory."""
        load = self._loads.get(key)
        return None if load is None or not load.done() or load.exception() else load.result()

    def keep(self, served: Collection[Loadable]) -> None:
        """Forget the versions in memory that are not served, such as those that were proven for a refused command."""
        self._loads = {key: load for key, load in self._loads.items() if key in served or not load.done()}
        self._calls.start(self._repository.touch, [digest for _, _, digest in served])

    async def look(self) -> Listing:
        """Return what the repository holds now. Raises UnavailableError when that takes too long."""
        return await self._calls.run("listing the policies", self._repository.look)

    async def load(self, key: Loadable) -> Policy:
        """Load and prove a version unless it is in memory.

        Raises what `Repository.fetch` and `Policy.load` raise, and UnavailableError when it takes too long; loading
        continues then, and the next call may find it done.
        """
        load = self._loads.get(key)  # other callers meanwhile wait for the same one
        if load is None or (load.done() and load.exception()):
            load = self._loads[key] = self._calls.start(self._load_accepted, *key)
        return await self._calls.wait(f"loading policy '{key[0]}' version {key[1]}", load)

    async def load_all(self, keys: Iterable[Loadable]) -> dict[Loadable, Policy | RlservoError]:
        """Load versions as `load` does; return each, or why it could not be loaded."""
        found: dict[Loadable, Policy | RlservoError] = {}
        for key in keys:
            try:
                found[key] = await self.load(key)
            except RlservoError as error:
                found[key] = error
        return found

    async def prove(self, policies: Mapping[str, PolicyPlan], before: Mapping[str, PolicyPlan]) -> list[str]:
        """Load new versions of `policies` and those with an alias; check that clients can use those they will get.

        A moved alias leads to a version that fits the one before, canary and shadow fit the default one. Returns what
        differs without harm, a sentence for each.

        Raises BundleError or UsageError with every version that cannot be served, and UnavailableError if they only
        could not be read, or not in time.
        """
        changed = {name: policy for name, policy in policies.items() if policy != before.get(name)}
        wanted = []
        for name, policy in changed.items():
            known, relied_on = before[name].versions if name in before else {}, policy.aliases.values()
            wanted += [(n, v, d) for n, v, d in policy.loadables(name) if known.get(v) != d or v in relied_on]
        found = await self.load_all(wanted)
        raise_all({key[:2]: each for key, each in found.items() if isinstance(each, RlservoError)})
        notes: list[str] = []
        for name, policy in changed.items():
            notes += await self._check_successors(name, policy, before.get(name, PolicyPlan()))
            notes += await self._check_companions(name, policy)
        return notes

    def _load_accepted(self, name: str, version: str, digest: str) -> Policy:
        """Load the bundle that was accepted, in a thread."""
        options = self._options.get(name, self._options.get("*"))
        given = {} if options is None else {"options": options}
        with self._repository.fetch(name, version, digest) as folder:
            try:
                with Computing(name, version):
                    policy = self._load_bundle(folder, **given)
            except MemoryError:
                raise BundleError(f"{folder} needs more memory than there is") from None
            contract = policy.contract
            # It may have been exchanged since its name was read and its hash accepted.
            if (contract.name, contract.version, policy.digest) != (name, version, digest):
                raise exchanged(name, version, folder)
        return policy

    async def _check_successors(self, name: str, policy: PolicyPlan, before: PolicyPlan) -> list[str]:
        """Refuse an alias that moves to a version which clients of the one before cannot use."""
        notes = []
        for alias, version in policy.aliases.items():
            was = before.aliases.get(alias, version)
            if was == version or was not in before.versions:
                continue
            successor = await self.load((name, version, policy.versions[version]))
            try:
                predecessor = await self.load((name, was, before.versions[was]))
            except RlservoError as error:  # it must not keep its alias
                logger.warning("the successor of policy '%s' version %s is not checked: %s", name, was, error.message)
                continue
            if wrong := interface_differences(successor.contract, predecessor.contract):
                raise BundleError(
                    f"policy '{name}' version {version} cannot take the alias '{alias}' from version {was}, whose "
                    f"clients could not use it: {wrong}. Serve it under another name, or stop them, unload the policy "
                    "and load this version"
                )
            notes += _note(successor.contract, predecessor.contract)
        return notes

    async def _check_companions(self, name: str, policy: PolicyPlan) -> list[str]:
        """Refuse a canary or shadow that clients of the default version could not use."""
        notes = []
        for role in ("canary", "shadow"):
            version = policy.version_of(policy.uses.get(f"the {role}", ""))
            if version is None or policy.default is None:
                continue
            both = [await self.load((name, each, policy.versions[each])) for each in (version, policy.default)]
            theirs, ours = (each.contract for each in both)
            if different := interface_differences(theirs, ours):
                wrong = different
            elif role == "canary" and theirs.state != ours.state:
                wrong = "its recurrent state has other names, types or shapes"
            elif role == "shadow" and theirs.state:
                wrong = "it remembers its episode, and a shadow computes on single observations"
            else:
                notes += _note(theirs, ours)
                continue
            raise BundleError(
                f"policy '{name}' version {version} cannot be the {role} of version {policy.default}: {wrong}"
            )
        return notes


def _note(contract: Contract, known: Contract) -> list[str]:
    different = harmless_differences(contract, known)
    return [f"version {contract.version} differs from {known.version}: {different}"] if different else []
