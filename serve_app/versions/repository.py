"""Bundles by name and version, in folders and behind URIs; their hashes tell them apart.

A name or version that a request brings is only ever compared with what the places hold; no path is made of it.
Everything here blocks (hashing, onnxruntime, golden vectors, networks), and may do so for ever where a file system
hangs: `version_loader.py` calls it through `BlockingCalls`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rlservo.export.contract.bundle import DEFAULT_LIMITS, BundleLimits, digest_of, find_bundles, read_contract
from rlservo.export.contract.contract import version_key
from rlservo.export.contract.errors import (
    BundleError,
    BundleTamperedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.serve_app.versions.bundle_cache import BundleCache, Lease, default_folder
from rlservo.serve_app.versions.object_storage import ObjectStorage, is_uri, place_of
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.remote_repository import RemoteRepository

logger = logging.getLogger(__name__)

Key = tuple[str, str]  # (name, version)
CACHE_BYTES = 10 << 30
STORAGE_TIMEOUT_S = 15.0


@dataclass(frozen=True)
class _Found:
    """One bundle: its hash, and for a message where it is."""

    digest: str
    place: str


@dataclass
class _Listing:
    """What one look through all places saw."""

    found: dict[Key, _Found] = field(default_factory=dict)
    errors: dict[Key, RlservoError] = field(default_factory=dict)  # of what cannot be served
    away: dict[RemoteRepository, UnavailableError] = field(default_factory=dict)
    twice: set[Key] = field(default_factory=set)

    @property
    def unread(self) -> set[Key]:
        """Versions that are listed, whose manifest could not be read; some of them the cache has, and are found."""
        return {key for key, error in self.errors.items() if isinstance(error, UnavailableError)}

    def add(self, key: Key, digest: str, place: str) -> None:
        """Add a bundle. A copy of one that is there is the same; another one makes neither of them usable."""
        there = self.found.setdefault(key, _Found(digest, place))
        if there.digest != digest:
            self.twice.add(key)
            self.errors[key] = UsageError(
                f"policy '{key[0]}' version {key[1]} is in both {there.place} and {place}: "
                "serve one of them, or export one under another name or version"
            )


class Repository:
    """The folders and URIs of bundles that a server was given."""

    def __init__(
        self,
        places: Iterable[str | Path],
        limits: BundleLimits = DEFAULT_LIMITS,
        *,
        cache: str | Path | None = None,
        cache_bytes: int = CACHE_BYTES,
        storage_timeout_s: float = STORAGE_TIMEOUT_S,
    ) -> None:
        """`cache` is the folder that bundles behind URIs are fetched into. Raises UsageError."""
        given = [place_of(place) for place in places]
        if not given:
            raise UsageError("no policy to serve: give at least one bundle folder")
        self._paths = [Path(place) for place in given if not is_uri(place)]
        self._limits = limits
        self._seen: dict[tuple[str, str, str], Path] = {}
        """The folders of the last look, by name, version and hash."""
        storages = [ObjectStorage(place, timeout_s=storage_timeout_s) for place in given if is_uri(place)]
        self._remote: list[RemoteRepository] = []
        if storages:
            bundles = BundleCache(Path(cache) if cache is not None else default_folder(), cache_bytes)
            self._remote = [RemoteRepository(storage, bundles, limits) for storage in storages]
        self.patience_s = 3 * storage_timeout_s * len(storages)
        """[s] by which a look through storages, each call with its time-out, may take longer than one on disk."""

    def available(self, config: ServedConfig) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version; of a storage that is away what the cache has of it.

        Where the configuration means all that is there, all of it has to be good: raises BundleError or UsageError, and
        UnavailableError where a storage, or a manifest of it, cannot be read and the cache does not have what the
        configuration means.
        """
        listing = self._look()
        for remote, error in listing.away.items():
            for key, digest in remote.remembered(error).items():
                listing.add(key, digest, f"{remote.uri}/{key[0]}/{key[1]}")
        hashes: dict[str, dict[str, str]] = {}
        found = {key: each for key, each in listing.found.items() if key not in listing.twice}
        for key in listing.unread & found.keys():
            logger.warning("%s: the copy in the cache or a folder is served", listing.errors.pop(key).message)
        if config.wants_all:
            raise_all(list(listing.errors.values()))
        for (name, version), each in sorted(found.items(), key=lambda item: (item[0][0], version_key(item[0][1]))):
            hashes.setdefault(name, {})[version] = each.digest
        for name, policy in config.policies.items():
            for version in policy.versions or ():
                if version not in hashes.get(name, {}):
                    if (name, version) in listing.unread:
                        raise listing.errors[name, version]
                    for error in listing.away.values():
                        raise error
        return hashes

    def look(self) -> tuple[dict[Key, str], list[RlservoError]]:
        """Return the hash of every bundle that can be served now, and a sentence for each thing that is wrong."""
        listing = self._look()
        digests = {key: each.digest for key, each in listing.found.items() if key not in listing.twice}
        return digests, [*listing.errors.values(), *listing.away.values()]

    def find_digest(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, what is wrong with the bundle of that name and version, and
        UnavailableError where a storage that does not answer may have it.
        """
        listing = self._look()
        versions = sorted((v for n, v in listing.found if n == name and (n, v) not in listing.twice), key=version_key)
        if listing.away and (version is None or version not in versions):
            raise next(iter(listing.away.values()))
        for key in listing.unread - listing.found.keys():  # which may be the newest
            if version is None and key[0] == name and version_key(key[1]) > max(map(version_key, versions), default=()):
                raise listing.errors[key]
        wanted = version if version is not None else (versions[-1] if versions else None)
        if wanted is not None and wanted in versions:
            return wanted, listing.found[name, wanted].digest
        # A bundle of that name and version that cannot be served says more than that there is none.
        for key, error in listing.errors.items():
            if key[0] == name and version in (key[1], None):
                raise error
        if not listing.found:
            raise_all(list(listing.errors.values()))
        if not versions:
            known = ", ".join(sorted({n for n, _ in listing.found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version '{str(version)[:32]}' of policy '{name}': it has {', '.join(versions)}"
        )

    def fetch(self, name: str, version: str, digest: str) -> Lease:
        """Return the folder of an accepted bundle, which stays until the lease is released.

        Raises BundleTamperedError where the bundle of that name and version has another hash by now, and what is wrong
        with it where it cannot be served.
        """
        errors: list[RlservoError] = []
        seen = self._seen.get((name, version, digest))
        if seen is not None and self._holds(seen, name, version, digest):
            return Lease(seen)  # without a look at all others, which for a thousand of them would be a million
        if self._paths:
            listing = _Listing()
            folders = self._look_in_folders(listing)
            folder = folders.get((name, version, digest))
            if folder is not None:
                return Lease(folder)
            there = listing.found.get((name, version))
            if there is not None:
                errors.append(
                    BundleTamperedError(
                        f"{there.place} is not the bundle that was accepted as version {version} of '{name}' (its "
                        "hashes are others): export changes under a new version, or load this one again"
                    )
                )
            errors += [error for key, error in listing.errors.items() if key == (name, version)]
        for remote in self._remote:
            try:
                return remote.fetch(name, version, digest)
            except RlservoError as error:
                errors.append(error)
        raise (
            errors[0]
            if errors
            else UnknownVersionError(f"the repository has no version '{version[:32]}' of policy '{name}' any more")
        )

    def _holds(self, folder: Path, name: str, version: str, digest: str) -> bool:
        try:
            contract = read_contract(folder, self._limits)
            return (contract.name, contract.version, digest_of(folder)) == (name, version, digest)
        except BundleError:
            return False

    def _look(self) -> _Listing:
        """Look through all places."""
        listing = _Listing()
        self._look_in_folders(listing)
        for remote in self._remote:
            try:
                digests, errors = remote.versions()
            except UnavailableError as error:
                listing.away[remote] = error
            except BundleError as error:
                listing.errors["", remote.uri] = error
            else:
                listing.errors.update(errors)
                for key, digest in digests.items():
                    listing.add(key, digest, f"{remote.uri}/{key[0]}/{key[1]}")
        return listing

    def _look_in_folders(self, listing: _Listing) -> dict[tuple[str, str, str], Path]:
        """Add what the folders hold; return them by name, version and hash."""
        by_digest: dict[tuple[str, str, str], Path] = {}
        folders: dict[Path, Path] = {}  # resolved -> as given: the same folder given twice counts once
        for path in self._paths:
            try:
                folders.update({folder.resolve(): folder for folder in find_bundles(path)})
            except BundleError as error:
                listing.errors["", str(path)] = error
        for folder in folders.values():
            try:
                contract = read_contract(folder, self._limits)
                key, digest = (contract.name, contract.version), digest_of(folder)
            except BundleError as error:
                listing.errors[folder.parent.name, folder.name] = error
                continue
            by_digest.setdefault((*key, digest), folder)
            listing.add(key, digest, str(folder))
        self._seen = by_digest
        return by_digest


def raise_all(errors: Sequence[RlservoError]) -> None:
    """Raise the error, or one that lists all of them."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        sentences = "; ".join(error.message for error in errors)
        kind = UnavailableError if all(isinstance(error, UnavailableError) for error in errors) else BundleError
        raise kind(f"{len(errors)} bundles cannot be served: {sentences}")
