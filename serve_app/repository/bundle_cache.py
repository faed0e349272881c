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

from rlservo.bundle.bundle import load_bundle
from rlservo.errors import BundleError, UnavailableError
from rlservo.serve_app.repository.storage import locked


class BundleCache:
    """A folder of bundles by hash: beyond `max_bytes`, those used longest ago are removed."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self._max_bytes = max_bytes

    @contextlib.contextmanager
    def bundle(self, digest: str, fetch: Callable[[Path], None]) -> Iterator[Path]:
        """Give the folder of a bundle, which stays until the block ends; `fetch` fills it unless it is here.

        Raises what `fetch` raises, and UnavailableError if the cache cannot be used.
        """
        entry = self.folder / digest
        try:
            with locked(entry) as descriptor:
                if not _is_whole(entry, digest):
                    try:
                        fetch(entry)
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
            with contextlib.suppress(BlockingIOError), locked(entry, fcntl.LOCK_EX | fcntl.LOCK_NB):
                shutil.rmtree(entry)
                del sizes[entry]


def _is_whole(entry: Path, digest: str) -> bool:
    try:
        return load_bundle(entry).digest == digest
    except BundleError:
        return False
