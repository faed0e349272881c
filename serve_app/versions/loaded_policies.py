"""Policies in memory by name, version and hash of their bundle."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from rlservo.export.contract.bundle import digest_of
from rlservo.export.contract.errors import BundleError, BundleTamperedError
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.versions.plan import now
from rlservo.serve_app.versions.repository import Repository

Loadable = tuple[str, str, str]  # (name, version, hash)


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy that was proven on this machine."""

    policy: Policy
    digest: str
    loaded_at: str


class LoadedPolicies:
    """The policies in memory, by name, version and hash."""

    def __init__(self, repository: Repository, load: Callable[[Path], Policy] = Policy.load) -> None:
        """`load` loads and proves one bundle; raises BundleError."""
        self.repository = repository
        self._load = load
        self._loaded: dict[Loadable, LoadedPolicy] = {}

    def get(self, name: str, version: str, digest: str) -> LoadedPolicy | None:
        """Return the policy if the bundle with that hash is in memory."""
        return self._loaded.get((name, version, digest))

    def load(self, name: str, version: str, digest: str) -> LoadedPolicy:
        """Load and prove a bundle, unless it is in memory.

        Raises what `Repository.find` and `Policy.load` raise, and BundleTamperedError when the folder holds another
        bundle than the one that was accepted.
        """
        loaded = self.get(name, version, digest)
        if loaded is not None:
            return loaded
        _, folder = self.repository.find(name, version)
        if digest_of(folder) == digest:
            try:
                policy = self._load(folder)
            except MemoryError:
                raise BundleError(f"{folder} needs more memory than there is") from None
            contract = policy.contract
            # It was not exchanged meanwhile, neither now nor when its name was read and its hash accepted.
            if (contract.name, contract.version, policy.digest) == (name, version, digest):
                loaded = self._loaded[name, version, digest] = LoadedPolicy(policy, digest, now())
                return loaded
        raise BundleTamperedError(
            f"{folder} is not the bundle that was accepted as version {version} of '{name}' (its hashes are others): "
            "export changes under a new version, or load this one again"
        )

    def keep(self, served: Mapping[Loadable, LoadedPolicy], proposed: Collection[Loadable]) -> None:
        """Hold what is served, keep what is proposed, and let all others go; who computes with one is not disturbed.

        In place: a thread may be adding one at this moment.
        """
        for key in list(self._loaded):
            if key not in served and key not in proposed:
                self._loaded.pop(key, None)
        self._loaded.update(served)
