"""Bundles by name and version, in folders and behind URIs; distinguished by their hashes.

A name or version in a request is only compared with those of the bundles; no path is made of it. Everything here
blocks, indefinitely if a file system hangs: `versions/version_loader.py` calls it through `BlockingCalls`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Sequence
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
from rlservo.serve_app.repository.bundle_cache import BundleCache, default_folder
from rlservo.serve_app.repository.remote_repository import Key, RemoteRepository
from rlservo.serve_app.repository.storage import TIMEOUT_S, is_uri, place_of

CACHE_BYTES = 10 << 30


@dataclass
class Listing:
    """Bundles and faults found by one look through all places."""

    found: dict[Key, tuple[str, str]] = field(default_factory=dict)  # (hash, where it is)
    errors: dict[Key, RlservoError] = field(default_factory=dict)  # of what cannot be served
    unread: list[UnavailableError] = field(default_factory=list)  # of storages that do not answer

    def add(self, key: Key, digest: str, place: str) -> None:
        """Add a bundle. A copy of one counts once; two different ones of the same version make neither usable."""
        there, where = self.found.setdefault(key, (digest, place))
        if there != digest:
            self.errors[key] = UsageError(
                f"policy '{key[0]}' version {key[1]} is in both {where} and {place}: "
                "serve one of them, or export one under another name or version"
            )

    @property
    def digests(self) -> dict[Key, str]:
        """The hash of every bundle that can be served."""
        return {key: digest for key, (digest, _) in self.found.items() if key not in self.errors}

    @property
    def wrong(self) -> list[RlservoError]:
        """Everything that cannot be served or read."""
        return [*self.errors.values(), *self.unread]

    def available(self, *, needs_all: bool) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version, for a first plan.

        With `needs_all` no bundle may be broken. Raises BundleError or UsageError, and UnavailableError if a storage
        does not answer.
        """
        if self.unread:
            raise self.unread[0]
        if needs_all:
            raise_all(list(self.errors.values()))
        hashes: dict[str, dict[str, str]] = {}
        for (name, version), digest in sorted(self.digests.items(), key=lambda each: version_key(each[0][1])):
            hashes.setdefault(name, {})[version] = digest
        return hashes

    def find(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, the bundle's own error if it cannot be served, and
        UnavailableError if a storage that does not answer may have it.
        """
        digests = {v: digest for (n, v), digest in self.digests.items() if n == name}
        versions = sorted(digests, key=version_key)
        if self.unread and (version is None or version not in versions):
            raise self.unread[0]
        wanted = version if version is not None else (versions[-1] if versions else None)
        if wanted is not None and wanted in digests:
            return wanted, digests[wanted]
        # The error of a broken bundle helps more than the statement that there is none.
        for key, error in self.errors.items():
            if key[0] == name and version in (key[1], None):
                raise error
        if not self.found:
            raise_all(list(self.errors.values()))
        if not versions:
            known = ", ".join(sorted({n for n, _ in self.found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version '{str(version)[:32]}' of policy '{name}': it has {', '.join(versions)}"
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
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        """Bundles behind URIs are fetched into the folder `cache`. Raises UsageError."""
        given = [place_of(place) for place in places]
        if not given:
            raise UsageError("no policy to serve: give at least one bundle folder")
        self._paths = [Path(place) for place in given if not is_uri(place)]
        self._limits = limits
        self._seen: dict[tuple[str, str, str], Path] = {}
        """The folders of the last look, by name, version and hash."""
        self._remote: list[RemoteRepository] = []
        if uris := [place for place in given if is_uri(place)]:
            bundles = BundleCache(Path(cache) if cache is not None else default_folder() / "bundles", cache_bytes)
            self._remote = [RemoteRepository(uri, bundles, limits, timeout_s=timeout_s) for uri in uris]

    def look(self) -> Listing:
        """Look through all places."""
        listing = Listing()
        self._look_in_folders(listing)
        for remote in self._remote:
            try:
                for key, digest in remote.versions().items():
                    listing.add(key, digest, f"{remote.uri}/{key[0]}/{key[1]}")
            except UnavailableError as error:
                listing.unread.append(error)
            except BundleError as error:
                listing.errors["", remote.uri] = error
        return listing

    @contextlib.contextmanager
    def fetch(self, name: str, version: str, digest: str) -> Iterator[Path]:
        """Give the folder of an accepted bundle, which stays until the block ends.

        Its files may have changed since: the loader compares every hash. Raises BundleTamperedError if the bundle of
        that name and version has another hash by now, and what is wrong with it if it cannot be served.
        """
        errors: list[RlservoError] = []
        key = (name, version)
        folder = self._seen.get((*key, digest))
        if self._paths and (folder is None or not _holds(folder, digest)):  # a look at all others takes longer
            listing = Listing()
            self._look_in_folders(listing)
            folder = self._seen.get((*key, digest))
            if folder is None and key in listing.found:
                errors.append(
                    BundleTamperedError(
                        f"{listing.found[key][1]} is not the bundle that was accepted as version {version} of "
                        f"'{name}' (its hashes differ): export changes under a new version, or load this one again"
                    )
                )
            errors += [error for each, error in listing.errors.items() if each == key]
        if folder is not None:
            yield folder
            return
        for remote in self._remote:
            with contextlib.ExitStack() as stack:
                try:
                    fetched = stack.enter_context(remote.fetch(name, version, digest))
                except RlservoError as error:
                    errors.append(error)
                    continue
                yield fetched
                return
        if not errors:
            raise UnknownVersionError(f"the repository has no version '{version[:32]}' of policy '{name}' any more")
        raise next((error for error in errors if isinstance(error, UnavailableError)), errors[0])

    def touch(self, digests: Collection[str]) -> None:
        """Mark bundles as used in the cache: they are served."""
        for remote in self._remote[:1]:  # they share it
            remote.cache.touch(digests)

    def _look_in_folders(self, listing: Listing) -> None:
        """Add the bundles of the folders."""
        seen: dict[tuple[str, str, str], Path] = {}
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
            seen.setdefault((*key, digest), folder)
            listing.add(key, digest, str(folder))
        self._seen = seen


def _holds(folder: Path, digest: str) -> bool:
    try:
        return digest_of(folder) == digest
    except BundleError:
        return False


def raise_all(errors: Sequence[RlservoError]) -> None:
    """Raise the error, or one that lists all of them."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        sentences = "; ".join(error.message for error in errors)
        kind = UnavailableError if all(isinstance(error, UnavailableError) for error in errors) else BundleError
        raise kind(f"{len(errors)} bundles cannot be served: {sentences}")
