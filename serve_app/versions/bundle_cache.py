"""Bundles fetched from remote repositories, on this machine's disk: by hash, bounded, shared by all its processes.

An entry is an ordinary bundle folder named by the bundle's hash. It is downloaded under another name and takes its own
when every hash was right. A process that uses an entry holds a shared lock on its folder, which the kernel releases
when the process ends, however it does; only what nobody holds is removed, what was used longest ago first.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlservo.export.contract.errors import BundleError, UnavailableError, UsageError
from rlservo.export.contract.regular_files import blocks, open_regular
from rlservo.serve_app.versions.manifest import REQUIRED, Manifest

MANIFEST_FILE = ".manifest.json"  # no bundle's file begins with a dot
PARTIAL = ".fetching-"
LOCK_POLL_S = 0.05

Read = Callable[[str, int], Iterable[bytes]]
"""Yields the content of one file of a version, of this size."""


@dataclass(frozen=True)
class Lease:
    """A bundle folder that stays as it is until it is released."""

    folder: Path
    descriptor: int | None = None  # of a folder in the cache; None: one that was not fetched

    def release(self) -> None:
        """Let others remove the folder."""
        if self.descriptor is not None:
            os.close(self.descriptor)


def default_folder() -> Path:
    """Return where bundles are kept unless a setting says otherwise. Raises UsageError."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(root) if root else Path("~/.cache").expanduser()) / "rlservo" / "bundles"
    except RuntimeError:  # a container's user without a home
        raise UsageError("this user has no home folder for the cache: name a folder in RLSERVO_CACHE") from None


class BundleCache:
    """A folder of bundles by hash, never larger than `max_bytes`."""

    def __init__(self, folder: Path, max_bytes: int, *, lock_timeout_s: float = 15.0) -> None:
        self._folder = folder
        self._max_bytes = max_bytes
        self._lock_timeout_s = lock_timeout_s

    def holds(self, digest: str) -> bool:
        """Whether a bundle is here; its files are looked at when it is used."""
        return (self._folder / digest).is_dir()

    def lease(self, digest: str) -> Lease | None:
        """Return the bundle if it is here and every file is what was published; a damaged one is removed."""
        with self._locked():
            descriptor = self._hold(self._folder / digest)
        if descriptor is None:
            return None
        entry = self._folder / digest
        if _is_whole(entry, digest):
            os.utime(entry)
            return Lease(entry, descriptor)
        os.close(descriptor)
        with self._locked(), contextlib.suppress(OSError):  # what stays is found damaged again
            self._remove_unused(entry)
        return None

    def add(self, manifest: Manifest, place: str, read: Read) -> Lease:
        """Fetch a bundle, unless another process just did, and return it.

        Raises what `read` raises, BundleError where a file is not what the manifest says, and UnavailableError where
        the cache has no room, or another process takes too long to fetch the same.
        """
        if manifest.size > self._max_bytes:
            raise UnavailableError(
                f"{place} has {manifest.size:,} bytes: the cache may hold {self._max_bytes:,} (RLSERVO_CACHE_BYTES)"
            )
        try:
            partial, descriptor = self._begin(manifest.digest, place)
        except OSError as error:
            raise self._unusable(error) from None
        try:
            lease = self.lease(manifest.digest)  # whoever had the lock before may have fetched it
            if lease is not None:
                shutil.rmtree(partial, ignore_errors=True)
                os.close(descriptor)
                return lease
            with self._locked():
                self._make_room(manifest, place)
                (partial / MANIFEST_FILE).write_bytes(manifest.encode())  # from now on its size counts
            for name, file in manifest.files.items():
                _write_verified(partial / name, read(name, file.size), file.sha256, f"{place}: {name}")
            entry = self._folder / manifest.digest
            with self._locked():
                shutil.rmtree(entry, ignore_errors=True)  # a damaged one that was still held
                partial.rename(entry)
                fcntl.flock(descriptor, fcntl.LOCK_SH)
            return Lease(entry, descriptor)
        except BaseException as error:
            shutil.rmtree(partial, ignore_errors=True)
            os.close(descriptor)
            if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
                raise self._unusable(error) from None
            raise

    def remember(self, uri: str, document: Any) -> None:
        """Keep what a repository holds, for when it is away."""
        file = self._index(uri)
        with self._locked(), contextlib.suppress(OSError):  # a full disk, say: then an older list stays
            beside = file.with_suffix(".new")
            beside.write_text(json.dumps(document), encoding="utf-8")
            beside.replace(file)

    def recall(self, uri: str) -> Any:
        """Return what was last remembered of a repository, None where nothing was or it cannot be read."""
        try:
            return json.loads(self._index(uri).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def _index(self, uri: str) -> Path:
        return self._folder / f".index-{hashlib.sha256(uri.encode()).hexdigest()[:32]}"

    def _begin(self, digest: str, place: str) -> tuple[Path, int]:
        """Make the folder to fetch into and lock it; wait for another process that does the same."""
        partial = self._folder / f"{PARTIAL}{digest}"
        deadline = time.monotonic() + self._lock_timeout_s
        while True:
            self._make()
            partial.mkdir(mode=0o700, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):
                descriptor = os.open(partial, os.O_RDONLY | os.O_DIRECTORY)
                if _lock_now(descriptor) and _is_same(partial, descriptor):
                    return partial, descriptor
                os.close(descriptor)
            if time.monotonic() > deadline:
                raise UnavailableError(
                    f"{place} is being fetched by another process, for {self._lock_timeout_s:g} s now"
                )
            time.sleep(LOCK_POLL_S)

    def _make_room(self, manifest: Manifest, place: str) -> None:
        """Remove what nobody holds, oldest first, until the bundle fits."""
        folders = [each for each in self._folder.iterdir() if each.is_dir()]
        sizes = {each: _declared_size(each) for each in folders}
        for entry in sorted(sizes, key=_last_use):
            if sum(sizes.values()) + manifest.size <= self._max_bytes:
                return
            if self._remove_unused(entry):
                del sizes[entry]
        if sum(sizes.values()) + manifest.size > self._max_bytes:
            raise UnavailableError(
                f"{place} needs {manifest.size:,} bytes, and {sum(sizes.values()):,} of the cache's "
                f"{self._max_bytes:,} are in use: raise RLSERVO_CACHE_BYTES, or unload versions"
            )

    def _remove_unused(self, entry: Path) -> bool:
        """Remove an entry unless somebody holds it; called with the cache locked, so nobody begins to."""
        try:
            descriptor = os.open(entry, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            return True
        try:
            if not _lock_now(descriptor):
                return False
            shutil.rmtree(entry)
            return True
        finally:
            os.close(descriptor)

    def _hold(self, entry: Path) -> int | None:
        """Lock an entry against removal; None where there is none."""
        try:
            descriptor = os.open(entry, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            return None
        fcntl.flock(descriptor, fcntl.LOCK_SH)  # nobody has it alone but who removes it, with the cache locked
        return descriptor

    def _make(self) -> None:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def _unusable(self, error: OSError) -> UnavailableError:
        return UnavailableError(
            f"the cache {self._folder} cannot be used ({error.strerror or error}): RLSERVO_CACHE names another folder"
        )

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep every other process and thread from adding and removing; for moments only."""
        try:
            self._make()
            descriptor = os.open(self._folder / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise self._unusable(error) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _lock_now(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_same(folder: Path, descriptor: int) -> bool:
    """Whether an open folder still has its name: who had it locked may have removed or renamed it."""
    try:
        return os.path.samestat(folder.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _is_whole(entry: Path, digest: str) -> bool:
    try:
        manifest = Manifest.model_validate_json((entry / MANIFEST_FILE).read_bytes())
        if not manifest.files.keys() >= set(REQUIRED) or manifest.digest != digest:
            return False
        for name, file in manifest.files.items():
            actual = hashlib.sha256()
            with open_regular(entry / name, file.size) as stream:
                for block in blocks(stream, file.size):
                    actual.update(block)
            if actual.hexdigest() != file.sha256:
                return False
    except (OSError, ValueError):
        return False
    return True


def _write_verified(file: Path, content: Iterable[bytes], sha256: str, what: str) -> None:
    actual = hashlib.sha256()
    with file.open("wb") as stream:
        for block in content:
            actual.update(block)
            stream.write(block)
    if actual.hexdigest() != sha256:
        raise BundleError(
            f"{what} is not the file that was published: its sha256 is {actual.hexdigest()[:12]}..., the manifest "
            f"records {sha256[:12]}..."
        )


def _declared_size(entry: Path) -> int:
    with contextlib.suppress(OSError, ValueError):
        return Manifest.model_validate_json((entry / MANIFEST_FILE).read_bytes()).size
    return 0


def _last_use(entry: Path) -> float:
    with contextlib.suppress(OSError):
        return entry.stat().st_mtime
    return 0.0
