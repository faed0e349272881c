"""Bundles by name and version, in folders and behind URIs; distinguished by their hashes.

A name or version in a request is only compared with those of the bundles; no path is made of it. What is in the cache
needs no storage: servers continue, and start again, while the storage is unreachable. Everything here blocks,
indefinitely if a file system hangs: `versions/version_loader.py` calls it through `BlockingCalls`.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rlservo.bundle.bundle import (
    DEFAULT_LIMITS,
    MAX_FILES,
    MAX_SUMS_BYTES,
    SUMS_FILE,
    Bundle,
    BundleLimits,
    digest_of,
    find_bundles,
    load_bundle,
    read_contract,
    read_sums,
)
from rlservo.bundle.contract import version_key
from rlservo.bundle.user_folders import default_folder
from rlservo.errors import (
    BundleError,
    BundleTamperedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.serve_app.repository.bundle_cache import BundleCache
from rlservo.serve_app.repository.index import INDEX, Index, check_file_type
from rlservo.serve_app.repository.places import TIMEOUT_S, place_of
from rlservo.serve_app.repository.signature import MAX_SIGNATURE_BYTES, SIGNATURE_FILE, check_signature, trusted
from rlservo.serve_app.repository.storage import FolderStorage, storage_at

if TYPE_CHECKING:
    from rlservo.serve_app.repository.hub_storage import HubStorage
    from rlservo.serve_app.repository.object_storage import ObjectStorage

Key = tuple[str, str]  # (name, version)
CACHE_BYTES = 10 << 30
logger = logging.getLogger(__name__)
MAX_FILE_BYTES = 4 << 30  # where no limit is set


@dataclass
class Listing:
    """Bundles and faults found by one look through all places."""

    found: dict[Key, tuple[str, str]] = field(default_factory=dict)  # (hash, where it is)
    errors: dict[Key, RlservoError] = field(default_factory=dict)  # of what cannot be served, and of places

    def add(self, key: Key, digest: str, place: str) -> None:
        """Add a bundle. A copy of one counts once; two different ones of the same version make neither usable."""
        there, where = self.found.setdefault(key, (digest, place))
        if there != digest:
            self.errors[key] = UsageError(
                f"policy '{key[0]}' version {key[1]} is in both {where} and {place}: "
                "serve one of them, or export one under another name or version"
            )

    @property
    def digests(self) -> dict[str, dict[str, str]]:
        """The hash of every bundle that can be served, by name and version, oldest first."""
        digests: dict[str, dict[str, str]] = {}
        for key in sorted(self.found.keys() - self.errors.keys(), key=lambda key: version_key(key[1])):
            digests.setdefault(key[0], {})[key[1]] = self.found[key][0]
        return digests

    def check_read(self) -> None:
        """Raise UnavailableError if a storage did not answer."""
        for error in self.errors.values():
            if isinstance(error, UnavailableError):
                raise error

    def available(self, *, needs_all: bool) -> dict[str, dict[str, str]]:
        """Return `digests` for a first plan; with `needs_all` no bundle may be broken.

        Raises BundleError or UsageError, and UnavailableError if a storage does not answer.
        """
        self.check_read()
        if needs_all:
            raise_all(self.errors)
        return self.digests

    def find(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle; None is the newest one.

        Raises UnknownPolicyError or UnknownVersionError, the bundle's own error if it cannot be served, and
        UnavailableError if a storage that does not answer may have it.
        """
        versions = self.digests.get(name, {})
        if version is None or version not in versions:
            self.check_read()
        wanted = version or next(reversed(versions), "")
        if wanted in versions:
            return wanted, versions[wanted]
        # The error of a broken bundle helps more than the statement that there is none.
        for key, error in self.errors.items():
            if key[0] == name and version in (key[1], None):
                raise error
        if not self.found:
            raise_all(self.errors)
        if not versions:
            known = ", ".join(sorted({n for n, _ in self.found})) or "none"
            raise UnknownPolicyError(f"the repository has no policy '{name[:64]}': it has {known}")
        raise UnknownVersionError(
            f"the repository has no version {str(version)[:32]} of policy '{name}': it has {', '.join(versions)}"
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
        keys: str | Path | None = None,
    ) -> None:
        """Bundles behind URIs are fetched into the folder `cache`; with `keys`, each must be signed by one of them.

        Raises UsageError.
        """
        given = [storage_at(place_of(place), timeout_s) for place in places]
        if not given:
            raise UsageError("no policy to serve: give at least one bundle folder")
        self._paths = [Path(storage.uri) for storage in given if isinstance(storage, FolderStorage)]
        self._storages = [storage for storage in given if not isinstance(storage, FolderStorage)]
        self._limits = limits
        self._keys = Path(keys) if keys is not None else None
        if self._keys is not None:
            trusted(self._keys)
        self._seen: dict[tuple[str, str, str], Path] = {}
        """The folders of the last look, by name, version and hash."""
        if self._storages:
            self._cache = BundleCache(Path(cache) if cache is not None else default_folder() / "bundles", cache_bytes)

    def look(self) -> Listing:
        """Look through all places."""
        listing = Listing()
        self._look_in_folders(listing)
        for storage in self._storages:
            try:
                index, tag = Index.read(storage)
                if not (index.policies or tag):
                    raise BundleError(f"{storage.uri} has no {INDEX}: nothing was published there (`rlservo publish`)")
                for name, versions in index.policies.items():
                    for version, digest in versions.items():
                        listing.add((name, version), digest, f"{storage.uri}/{name}/{version}")
            except RlservoError as error:
                listing.errors["", storage.uri] = error
        return listing

    @contextlib.contextmanager
    def fetch(self, name: str, version: str, digest: str) -> Iterator[Path]:
        """Give the folder of an accepted bundle, which stays until the block ends.

        Its files may have changed since: the loader compares every hash. Raises BundleTamperedError if the bundle of
        that name and version has another hash by now, what `Listing.find` raises if it cannot be served, and
        BundleError if it is not signed as it must be.
        """
        listing, folder = Listing(), self._seen.get((name, version, digest))
        if folder is None or not _holds(folder, digest):  # a look at all others takes longer
            self._look_in_folders(listing)
            folder = self._seen.get((name, version, digest))
        if folder is not None:
            self._check_signature(folder, name, version, digest)
            yield folder
        elif self._storages:
            with self._cache.bundle(digest, partial(self._download, name, version, digest)) as fetched:
                self._check_signature(fetched, name, version, digest, is_cached=True)
                yield fetched
        else:
            listing.find(name, version)
            raise exchanged(name, version, listing.found[name, version][1])

    def touch(self, digests: Collection[str]) -> None:
        """Mark bundles as used in the cache: they are served."""
        if self._storages:
            self._cache.touch(digests)

    def _check_signature(self, folder: Path, name: str, version: str, digest: str, *, is_cached: bool = False) -> None:
        """Check who signed the bundle with this hash, the one that the loader accepts afterwards."""
        if self._keys is None:
            return
        bundle = load_bundle(folder, self._limits)
        if bundle.digest != digest:  # a signed one was put there for the moment of this check
            raise exchanged(name, version, folder)
        try:
            signer = check_signature(bundle, self._keys)
        except BundleError as error:  # it may have been signed, or signed with another key, since
            if not is_cached:
                raise
            signer = self._published_signer(bundle, self._keys, error)
        logger.info("policy '%s' version %s: signed by %s", name, version, signer)

    def _published_signer(self, bundle: Bundle, keys: Path, fault: BundleError) -> str:
        """Return the signer of a bundle in the cache by the first published signature that holds, and keep that one.

        Raises UnavailableError if a storage that may have one could not be read, else `fault`.
        """
        unread: UnavailableError | None = None
        for storage in self._storages:
            with (
                tempfile.TemporaryDirectory(dir=bundle.path) as beside,
                contextlib.suppress(FileNotFoundError, BundleError),
            ):
                file = Path(beside, SIGNATURE_FILE)
                try:
                    with file.open("wb") as stream:
                        name = f"{bundle.contract.name}/{bundle.contract.version}/{SIGNATURE_FILE}"
                        storage.copy(name, MAX_SIGNATURE_BYTES, stream)
                except UnavailableError as error:
                    unread = unread or error
                    continue
                file.replace(bundle.path / SIGNATURE_FILE)
                return check_signature(bundle, keys)
        raise unread or fault

    def _download(self, name: str, version: str, digest: str, entry: Path) -> None:
        """Fetch a bundle from the first storage that has it.

        Raises UnavailableError if any storage could not be read, else the first error.
        """
        errors: list[RlservoError] = []
        for storage in self._storages:
            try:
                self._copy(storage, name, version, digest, entry)
            except RlservoError as error:
                errors.append(error)
            else:
                return
        raise next((error for error in errors if isinstance(error, UnavailableError)), errors[0])

    def _copy(self, storage: ObjectStorage | HubStorage, name: str, version: str, digest: str, entry: Path) -> None:
        """Copy and check the files of a bundle. Raises UnavailableError, BundleError."""
        place = f"{storage.uri}/{name}/{version}"

        def copy(file: str, most: int) -> None:
            try:
                with (entry / file).open("wb") as stream:
                    storage.copy(f"{name}/{version}/{file}", most, stream)
            except FileNotFoundError:
                raise BundleError(f"{place}/{file} is missing: the version was deleted, all or in part") from None

        copy(SUMS_FILE, MAX_SUMS_BYTES)
        found, sums = read_sums(entry)
        if found != digest:
            raise exchanged(name, version, place)
        if len(sums) > MAX_FILES:
            raise BundleError(f"{place} lists {len(sums)} files: at most {MAX_FILES}")
        for file in sums:
            check_file_type(file, place)
            copy(file, self._limits.of(file)[0] or MAX_FILE_BYTES)
        try:
            load_bundle(entry)
        except BundleError as error:
            raise BundleError(f"{place}: {error.message.replace(f'{entry}/', '')}") from None

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


def exchanged(name: str, version: str, place: object) -> BundleTamperedError:
    """Return the error for a bundle that is no longer the one whose hash was accepted."""
    return BundleTamperedError(
        f"{place} is not the bundle that was accepted as version {version} of '{name}' (its hashes differ): export or "
        "publish changes as a new version, or load this one again (`rlservo policy load`, after `unload` if it is in "
        "use)"
    )


def raise_all(errors: Mapping[Key, RlservoError]) -> None:
    """Raise the error of a version, or one that lists all of them; its details have each version's reason."""
    if not errors:
        return
    error = next(iter(errors.values()))
    if len(errors) > 1:
        kind = UnavailableError if all(isinstance(each, UnavailableError) for each in errors.values()) else BundleError
        sentences = "; ".join(each.message for each in errors.values())
        error = kind(f"{len(errors)} bundles cannot be served: {sentences}")
    error.details["versions"] = [{"name": n, "version": v, "reason": e.message} for (n, v), e in errors.items()]
    raise error
