"""Bundles fetched from remote repositories, on this machine's disk: by hash, bounded, shared by all its processes.

An entry is an ordinary bundle folder named by the bundle's hash, and whole when its files have that hash. A process
that fetches or loads it has the folder locked, which the kernel releases when the process ends, however it does.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from rlservo.export.contract.bundle import load_bundle
from rlservo.export.contract.errors import BundleError, RlservoError, UnavailableError, UsageError


def default_folder(variable: str = "XDG_CACHE_HOME", below_home: str = ".cache") -> Path:
    """Return the user's folder for what rlservo keeps. Raises UsageError."""
    root = os.environ.get(variable)
    try:
        return (Path(root) if root else Path.home() / below_home) / "rlservo"
    except RuntimeError:  # a container's user without a home
        raise UsageError(f"this user has no home folder: name a folder in {variable}") from None


class BundleCache:
    """A folder of bundles by hash: beyond `max_bytes`, those used longest ago are removed."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self._max_bytes = max_bytes

    @contextlib.contextmanager
    def bundle(self, digest: str, place: str, fetch: Callable[[Path], None]) -> Iterator[Path]:
        """Give the folder of a bundle, which stays until the block ends; `fetch` fills it unless it is here.

        Raises what `fetch` raises, BundleError if it brings something else, and UnavailableError if the cache
        cannot be used.
        """
        entry = self.folder / digest
        try:
            with _locked(entry) as descriptor:
                if _what_is_wrong(entry, digest):
                    try:
                        fetch(entry)
                        if wrong := _what_is_wrong(entry, digest):
                            raise BundleError(f"{place}: {wrong.replace(f'{entry}/', '')}")
                    except BaseException:
                        shutil.rmtree(entry, ignore_errors=True)
                        raise
                    self._remove_unused()
                os.utime(entry)
                fcntl.flock(descriptor, fcntl.LOCK_SH)  # others also load it
                yield entry
        except OSError as error:
            reason = f"{error.strerror or error}: RLSERVO_CACHE names another folder"
            raise UnavailableError(f"the cache {self.folder} cannot be used ({reason})") from None

    def touch(self, digests: Collection[str]) -> None:
        """Count bundles as used now: they are served."""
        for digest in digests:
            with contextlib.suppress(OSError):
                os.utime(self.folder / digest)

    def _remove_unused(self) -> None:
        entries = [entry for entry in self.folder.iterdir() if entry.is_dir()]
        sizes = {entry: sum(file.stat().st_size for file in entry.iterdir()) for entry in entries}
        for entry in sorted(entries, key=lambda each: each.stat().st_mtime):
            if sum(sizes.values()) <= self._max_bytes:
                return
            with contextlib.suppress(BlockingIOError), _locked(entry, fcntl.LOCK_EX | fcntl.LOCK_NB):
                shutil.rmtree(entry)
                del sizes[entry]


@contextlib.contextmanager
def _locked(entry: Path, how: int = fcntl.LOCK_EX) -> Iterator[int]:
    """Make an entry's folder and lock it; wait for another process that fetches the same."""
    while True:
        entry.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(entry, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, how)
            if entry.is_dir() and os.path.samestat(entry.stat(), os.fstat(descriptor)):  # or who had it removed it
                yield descriptor
                return
        finally:
            os.close(descriptor)


def _what_is_wrong(entry: Path, digest: str) -> str:
    try:
        found = load_bundle(entry)
    except RlservoError as error:
        return error.message
    return "" if found.digest == digest else f"its SHA256SUMS is another one than that of the hash {digest[:12]}..."
