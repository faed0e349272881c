"""The bundles on disk and the policies in memory: find by name and version, load, prove, keep.

A name or version that a request brings is only ever compared with what the folders hold; no path is made of it.
Everything here blocks (hashing, onnxruntime, golden vectors), and may do so for ever where a file system hangs:
`replica_versions.py` calls it through `BlockingCalls`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rlservo.export.contract.bundle import (
    DEFAULT_LIMITS,
    BundleLimits,
    digest_of,
    find_bundles,
    read_contract,
    version_key,
)
from rlservo.export.contract.errors import (
    BundleError,
    BundleTamperedError,
    RlservoError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.plan import ServedConfig, now, plan_of
from rlservo.serve_app.versions.policy_store import PolicyStore

Key = tuple[str, str]  # (name, version)


@dataclass(frozen=True)
class Loaded:
    """A policy that was proven on this machine."""

    policy: Policy
    digest: str
    loaded_at: str


class Repository:
    """The folders of bundles that a server was given."""

    def __init__(self, paths: Iterable[str | Path], limits: BundleLimits = DEFAULT_LIMITS) -> None:
        self._paths = [Path(path) for path in paths]
        self._limits = limits
        if not self._paths:
            raise UsageError("no policy to serve: give at least one bundle folder")

    def scan(self) -> tuple[dict[Key, Path], dict[Path, RlservoError]]:
        """Return the bundles by name and version, and what cannot be served, by folder.

        Two bundles of the same policy in the same version are among the latter: nobody could say which one is meant.
        A copy of a bundle is the bundle.
        """
        found: dict[Key, Path] = {}
        errors: dict[Path, RlservoError] = {}
        folders: dict[Path, Path] = {}  # resolved -> as given: the same folder given twice counts once
        for path in self._paths:
            try:
                folders.update({folder.resolve(): folder for folder in find_bundles(path)})
            except BundleError as error:
                errors[path] = error
        twice: set[Key] = set()
        for folder in folders.values():
            try:
                contract = read_contract(folder, self._limits)
                key = (contract.name, contract.version)
                copied = key in found and digest_of(folder) == digest_of(found[key])
            except BundleError as error:
                errors[folder] = error
                continue
            if key in found and not copied:
                twice.add(key)
                errors[folder] = UsageError(
                    f"policy '{key[0]}' version {key[1]} is in both {found[key]} and {folder}: "
                    "serve one of them, or export one under another name or version"
                )
            elif not copied:
                found[key] = folder
        return {key: folder for key, folder in found.items() if key not in twice}, errors

    def available(self, config: ServedConfig) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version.

        Where the configuration means all that is there, all of it has to be good: raises BundleError or UsageError.
        """
        found, errors = self.scan()
        if config.wants_all:
            raise_all(list(errors.values()))
        hashes: dict[str, dict[str, str]] = {}
        for (name, version), folder in sorted(found.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            hashes.setdefault(name, {})[version] = digest_of(folder)
        return hashes

    def find(self, name: str, version: str | None) -> tuple[str, Path]:
        """Return (version, folder) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, or what is wrong with the folder of that name and version.
        """
        found, errors = self.scan()
        versions = sorted((v for n, v in found if n == name), key=version_key)
        wanted = version if version is not None else (versions[-1] if versions else None)
        if wanted is not None and (name, wanted) in found:
            return wanted, found[name, wanted]
        # A folder of that name and version that cannot be served says more than that there is none.
        for folder, error in errors.items():
            if folder.parent.name == name and version in (folder.name, None):
                raise error
        if not versions:
            known = ", ".join(sorted({n for n, _ in found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version '{str(version)[:32]}' of policy '{name}': it has {', '.join(versions)}"
        )

    def find_digest(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle, as `find`."""
        found, folder = self.find(name, version)
        return found, digest_of(folder)


def load_served(
    paths: Iterable[str | Path], config: ServedConfig, settings: ServerSettings | None = None
) -> PolicyStore:
    """Load and prove what a server of these folders would start with.

    Raises UsageError or BundleError, and UnavailableError where the file system hangs.
    """
    settings = settings or ServerSettings.from_environment(environment={})
    calls, limits = BlockingCalls(), settings.bundle_limits
    library = Library(Repository(paths, limits), partial(Policy.load, limits=limits))
    available = calls.wait(
        library.repository.available, config, timeout_s=settings.scan_timeout_s, what="looking through the folders"
    )
    plans = plan_of(config, available, None)
    policies: list[Policy] = []
    errors: list[RlservoError] = []
    for name, plan in plans.items():
        for version, digest in plan.versions.items():
            what = f"loading policy '{name}' version {version}"
            try:
                loaded = calls.wait(library.load, name, version, digest, timeout_s=settings.load_timeout_s, what=what)
                policies.append(loaded.policy)
            except BundleError as error:
                errors.append(error)
    raise_all(errors)
    return PolicyStore(policies, plans)


class Library:
    """The policies in memory, by name, version and hash."""

    def __init__(self, repository: Repository, load: Callable[[Path], Policy] = Policy.load) -> None:
        """`load` loads and proves one bundle; raises BundleError."""
        self.repository = repository
        self._load = load
        self._loaded: dict[tuple[str, str, str], Loaded] = {}

    def get(self, name: str, version: str, digest: str) -> Loaded | None:
        """Return the policy if the bundle with that hash is in memory."""
        return self._loaded.get((name, version, digest))

    def load(self, name: str, version: str, digest: str) -> Loaded:
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
                loaded = self._loaded[name, version, digest] = Loaded(policy, digest, now())
                return loaded
        raise BundleTamperedError(
            f"{folder} is not the bundle that was accepted as version {version} of '{name}' (its hashes are others): "
            "export changes under a new version, or load this one again"
        )

    def keep(self, served: Mapping[tuple[str, str, str], Loaded], proposed: Collection[tuple[str, str, str]]) -> None:
        """Hold what is served, keep what is proposed, and let all others go; who computes with one is not disturbed.

        In place: a thread may be adding one at this moment.
        """
        for key in list(self._loaded):
            if key not in served and key not in proposed:
                self._loaded.pop(key, None)
        self._loaded.update(served)


def raise_all(errors: Sequence[RlservoError]) -> None:
    """Raise the error, or one that lists all of them."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        sentences = "; ".join(error.message for error in errors)
        raise BundleError(f"{len(errors)} bundles cannot be served: {sentences}")
