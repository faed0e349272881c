"""The bundles on disk and the policies in memory: find by name and version, load, prove, keep.

A name or version that a request brings is only ever compared with what the folders hold; no path is made of it.
Everything here blocks (hashing, onnxruntime, golden vectors): the event loop hands it to a thread.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rlservo.export.bundle import SUMS_FILE, find_bundles, read_contract, version_key
from rlservo.export.errors import BundleError, BundleTamperedError, UnknownPolicyError, UnknownVersionError, UsageError
from rlservo.serve_app.plan import ServedConfig, now, plan_of
from rlservo.serve_app.policy import Policy
from rlservo.serve_app.store import PolicyStore

Key = tuple[str, str]  # (name, version)


@dataclass(frozen=True)
class Loaded:
    """A policy that was proven on this machine."""

    policy: Policy
    digest: str
    loaded_at: str


class Repository:
    """The folders of bundles that a server was given."""

    def __init__(self, paths: Iterable[str | Path]) -> None:
        self._paths = [Path(path) for path in paths]
        if not self._paths:
            raise UsageError("no policy to serve: give at least one bundle folder")

    def scan(self) -> tuple[dict[Key, Path], list[BundleError]]:
        """Return the bundles by name and version, and what cannot be read.

        Raises UsageError when two folders hold the same policy in the same version.
        """
        found: dict[Key, Path] = {}
        errors: list[BundleError] = []
        folders: dict[Path, Path] = {}  # resolved -> as given: the same folder given twice counts once
        for path in self._paths:
            try:
                folders.update({folder.resolve(): folder for folder in find_bundles(path)})
            except BundleError as error:
                errors.append(error)
        for folder in folders.values():
            try:
                contract = read_contract(folder)
            except BundleError as error:
                errors.append(error)
                continue
            key = (contract.name, contract.version)
            if key in found:
                raise UsageError(
                    f"policy '{key[0]}' version {key[1]} is in both {found[key]} and {folder}: "
                    "serve one of them, or export one under another name or version"
                )
            found[key] = folder
        return found, errors

    def available(self) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version.

        Raises BundleError when one of them cannot be read: a repository that is served whole has to be whole.
        """
        found, errors = self.scan()
        raise_all(errors)
        hashes: dict[str, dict[str, str]] = {}
        for (name, version), folder in sorted(found.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            hashes.setdefault(name, {})[version] = digest_of(folder)
        return hashes

    def find(self, name: str, version: str | None) -> tuple[str, Path]:
        """Return (version, folder) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, or the BundleError of the folder of that name and version.
        """
        found, errors = self.scan()
        versions = sorted((v for n, v in found if n == name), key=version_key)
        wanted = version if version is not None else (versions[-1] if versions else None)
        if wanted is not None and (name, wanted) in found:
            return wanted, found[name, wanted]
        # A folder of that name and version that is no bundle says more than that there is none.
        for error in errors:
            if f"/{name}/{version or ''}" in error.message:
                raise error
        if not versions:
            known = ", ".join(sorted({n for n, _ in found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version '{str(version)[:32]}' of policy '{name}': it has {', '.join(versions)}"
        )


def load_served(paths: Iterable[str | Path], config: ServedConfig) -> PolicyStore:
    """Load and prove what a server of these folders would start with. Raises UsageError or BundleError."""
    library = Library(Repository(paths))
    plans = plan_of(config, library.repository.available(), None)
    policies: list[Policy] = []
    errors: list[BundleError] = []
    for name, plan in plans.items():
        for version, digest in plan.versions.items():
            try:
                policies.append(library.load(name, version, digest).policy)
            except BundleError as error:
                errors.append(error)
    raise_all(errors)
    return PolicyStore(policies, plans)


class Library:
    """The policies in memory, by name, version and hash."""

    def __init__(self, repository: Repository, *, threads: int = 1) -> None:
        self.repository = repository
        self._threads = threads
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
            policy = Policy.load(folder, threads=self._threads)
            if digest_of(folder) == digest:  # it was not exchanged meanwhile
                loaded = self._loaded[name, version, digest] = Loaded(policy, digest, now())
                return loaded
        raise BundleTamperedError(
            f"{folder} is not the bundle that was accepted as version {version} of '{name}' (its hashes are others): "
            "export changes under a new version, or load this one again"
        )

    def keep(self, keys: Iterable[tuple[str, str, str]]) -> None:
        """Let all others go; whoever still computes with one of those is not disturbed."""
        wanted = set(keys)
        self._loaded = {key: loaded for key, loaded in self._loaded.items() if key in wanted}


def digest_of(folder: Path) -> str:
    """Return what tells this bundle from every other: the hash of its hashes."""
    try:
        return hashlib.sha256((folder / SUMS_FILE).read_bytes()).hexdigest()
    except OSError as error:
        raise BundleError(f"{folder / SUMS_FILE} cannot be read: {error.strerror}") from None


def raise_all(errors: list[BundleError]) -> None:
    """Raise one error that lists all of them."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        sentences = "; ".join(error.message for error in errors)
        raise BundleError(f"{len(errors)} bundles cannot be served: {sentences}")
