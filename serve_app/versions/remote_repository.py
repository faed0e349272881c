"""Repository of published versions behind a URI: lists them by their manifests, fetches one into a local folder.

    <uri>/<name>/<version>.json     the manifest: without it there is no such version
    <uri>/<name>/<version>/...      the bundle's files, which never change

A version is fetched by its hash into the cache; from there on it is an ordinary bundle folder. What is in the cache
needs no storage, so what runs goes on, and starts again, while the storage is away.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rlservo.export.contract.bundle import DEFAULT_LIMITS, BundleLimits
from rlservo.export.contract.contract import NAME_PATTERN, VERSION_PATTERN
from rlservo.export.contract.errors import BundleError, BundleTamperedError, RlservoError, UnavailableError
from rlservo.serve_app.versions.bundle_cache import BundleCache, Lease
from rlservo.serve_app.versions.manifest import MAX_MANIFEST_BYTES, SUFFIX, Manifest
from rlservo.serve_app.versions.object_storage import ObjectStorage, announced, listed
from rlservo.serve_app.versions.plan import now

logger = logging.getLogger(__name__)

AT_ONCE = 16  # calls to the storage
MAX_MANIFESTS = 100_000

Key = tuple[str, str]  # (name, version)


class RemoteRepository:
    """Published versions below one URI."""

    def __init__(self, storage: ObjectStorage, cache: BundleCache, limits: BundleLimits = DEFAULT_LIMITS) -> None:
        self.uri = storage.uri
        self._storage = storage
        self._cache = cache
        self._limits = limits
        self._known: dict[Key, tuple[Any, Manifest]] = {}  # with what the listing said of it

    def versions(self) -> tuple[dict[Key, str], dict[Key, RlservoError]]:
        """Return the hash of every published version, and what is wrong with those that cannot be served.

        Only manifests are read, and of those that the listing tells apart, only new ones. One that cannot be read is
        that version's UnavailableError, until the next look reads it again; what the cache has of it is returned
        nevertheless. Raises UnavailableError where the storage is away, and BundleError where nothing is published.
        """
        with announced(lambda: f"the list of versions in {self.uri}"):
            stamps = self._stamps()
            changed = [key for key, stamp in stamps.items() if stamp is None or self._stamp_of(key) != stamp]
            results = self._manifests(changed)
        errors = {key: result for key, result in results.items() if isinstance(result, RlservoError)}
        known = {key: each for key, each in self._known.items() if key in stamps and key not in results}
        known |= {key: (stamps[key], each) for key, each in results.items() if isinstance(each, Manifest)}
        unread = {key: error for key, error in errors.items() if isinstance(error, UnavailableError)}
        if unread and not known:
            raise next(iter(unread.values()))
        self._known = known
        digests = {key: manifest.digest for key, (_, manifest) in sorted(known.items())}
        earlier = self._recall()[1] if unread else {}
        unread_before = {key: earlier[key] for key in sorted(unread) if key in earlier}
        index = {**digests, **unread_before}  # a version is not forgotten because it could not be read once
        self._cache.remember(self.uri, {"at": now(), "digests": [[*key, digest] for key, digest in index.items()]})
        return digests | {key: each for key, each in unread_before.items() if self._cache.holds(each)}, errors

    def remembered(self, error: UnavailableError) -> dict[Key, str]:
        """Return what was published when the storage last answered, as far as the cache has it, and say so.

        Raises the error, which says why the storage does not answer, where the cache has nothing.
        """
        at, digests = self._recall()
        held = {key: digest for key, digest in digests.items() if self._cache.holds(digest)}
        if not held:
            raise error
        missing = [f"{name} {version}" for name, version in digests.keys() - held.keys()]
        left_out = f"; not in the cache, and left out: {listed(sorted(missing))}" if missing else ""
        logger.warning("%s: the cache serves what was published on %s%s", error.message, at, left_out)
        return held

    def _recall(self) -> tuple[str, dict[Key, str]]:
        """Return when the storage last answered, and what was published then."""
        document = self._cache.recall(self.uri) or {"at": "", "digests": []}
        return document["at"], {(name, version): digest for name, version, digest in document["digests"]}

    def fetch(self, name: str, version: str, digest: str) -> Lease:
        """Return the folder of the bundle with that hash, fetched unless the cache has it.

        Raises UnavailableError, BundleError, and BundleTamperedError where another bundle is published by now.
        """
        lease = self._cache.lease(digest)
        if lease is not None:
            return lease
        folder = f"{name}/{version}"
        try:
            manifest = self._manifest((name, version))
        except FileNotFoundError:
            raise BundleError(f"{self.uri}/{folder}{SUFFIX} is not there: the version was deleted") from None
        if manifest.digest != digest:
            raise BundleTamperedError(
                f"{self.uri}/{folder}{SUFFIX} is not the manifest that was accepted as version {version} of '{name}': "
                "published versions do not change; publish changes as a new version"
            )
        progress = [folder]

        def read(file: str, size: int) -> Iterator[bytes]:
            done = 0
            for block in self._storage.blocks(f"{folder}/{file}", size):
                done += len(block)
                progress[0] = f"{folder}/{file}, of which {done:,} of {size:,} bytes are here"
                yield block

        place = f"{self.uri}/{folder}"
        with announced(lambda: f"{self.uri}/{progress[0]}"):
            try:
                return self._cache.add(manifest, place, read)
            except FileNotFoundError:
                raise BundleError(f"{place} lacks a file that its manifest lists: it was deleted in part") from None

    def _stamps(self) -> dict[Key, Any]:
        """Return every manifest that is listed, with what changes when it does."""
        entries = self._storage.entries()
        names = [name for name in entries if re.fullmatch(NAME_PATTERN, name) and not name.endswith(SUFFIX)]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            folders = dict(zip(names, pool.map(self._storage.entries, names), strict=True))
        found = {
            (name, entry.removesuffix(SUFFIX)): stamp
            for name, entries in folders.items()
            for entry, stamp in entries.items()
            if entry.endswith(SUFFIX)
            and re.fullmatch(VERSION_PATTERN, entry.removesuffix(SUFFIX))
            and stamp is not False
        }
        if not found:
            raise BundleError(
                f"{self.uri} holds no published version: expected <name>/<version>{SUFFIX}, as `rlservo publish` writes"
            )
        if len(found) > MAX_MANIFESTS:
            raise BundleError(f"{self.uri} lists {len(found):,} versions: at most {MAX_MANIFESTS:,}")
        return found

    def _stamp_of(self, key: Key) -> Any:
        return self._known[key][0] if key in self._known else None

    def _manifests(self, keys: Sequence[Key]) -> dict[Key, Manifest | RlservoError | None]:
        """Read manifests; None is one that was deleted meanwhile. Raises UnavailableError.

        A storage that stopped to answer is not asked for each of a thousand: together they wait for one time-out.
        """
        results: dict[Key, Manifest | RlservoError | None] = {}
        lost_s = 0.0
        with ThreadPoolExecutor(AT_ONCE) as pool:
            for key, (result, took_s) in zip(keys, pool.map(self._try_manifest, keys), strict=True):
                results[key] = result
                if isinstance(result, UnavailableError):
                    lost_s += took_s
                    if lost_s > AT_ONCE * self._storage.timeout_s:
                        pool.shutdown(wait=False, cancel_futures=True)
                        raise result
        return results

    def _try_manifest(self, key: Key) -> tuple[Manifest | RlservoError | None, float]:
        """Return a manifest or what is wrong with it, and how long that took [s]."""
        began = time.monotonic()
        result: Manifest | RlservoError | None
        try:
            result = self._manifest(key)
        except (BundleError, UnavailableError) as error:
            result = error
        except FileNotFoundError:
            result = None
        return result, time.monotonic() - began

    def _manifest(self, key: Key) -> Manifest:
        name = f"{key[0]}/{key[1]}{SUFFIX}"
        content = self._storage.read(name, MAX_MANIFEST_BYTES + 1)
        return Manifest.parse(content, f"{self.uri}/{name}", self._limits)
