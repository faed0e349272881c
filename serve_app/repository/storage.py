"""Storages of bundles and plans, by the place that names them: folders, and object storage."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rlservo.bundle.regular_files import blocks, open_regular
from rlservo.errors import UnavailableError
from rlservo.extras import needs_extra
from rlservo.serve_app.repository.places import TIMEOUT_S, is_uri

if TYPE_CHECKING:
    from rlservo.serve_app.repository.hub_storage import HubStorage
    from rlservo.serve_app.repository.object_storage import ObjectStorage

MAX_DOCUMENT_BYTES = 16 << 20  # of an index or a plan; 1,000 policies take 0.3 MB


def storage_at(place: str, timeout_s: float = TIMEOUT_S) -> ObjectStorage | HubStorage | FolderStorage:
    """Return the storage at a place; a call to object storage may take half of `timeout_s`, to be named in time.

    Raises UsageError.
    """
    if not is_uri(place):
        return FolderStorage(Path(place))
    if place.startswith("hf://"):
        with needs_extra("hub", "huggingface_hub"):
            from rlservo.serve_app.repository.hub_storage import HubStorage
        return HubStorage(place, timeout_s=timeout_s / 2)
    with needs_extra("remote", "httptools"):
        from rlservo.serve_app.repository.object_storage import ObjectStorage
    return ObjectStorage(place, timeout_s=timeout_s / 2)


@contextlib.contextmanager
def locked(folder: Path, how: int = fcntl.LOCK_EX) -> Iterator[int]:
    """Make a folder and lock it until the block ends or the process does; give its descriptor."""
    while True:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, how)
            # Or the process that had it locked has removed it.
            if folder.is_dir() and os.path.samestat(folder.stat(), os.fstat(descriptor)):
                yield descriptor
                return
        finally:
            os.close(descriptor)


class FolderStorage:
    """Files below a folder, by the methods of `ObjectStorage` that plans and indexes need. Works on NFS."""

    is_read_only = False

    def __init__(self, root: Path) -> None:
        self.uri = str(root)
        self._root = root

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return a file of at most `most` bytes, and its tag for `create`.

        Raises FileNotFoundError, and UnavailableError if it cannot be read.
        """
        file = self._root / name
        try:
            # Opening the folder has NFS ask its server what is new in it; a look for the file alone would not.
            os.close(os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY))
            with open_regular(file, most) as stream:
                content = b"".join(blocks(stream, most))
        except FileNotFoundError:
            raise
        except OSError as error:
            raise UnavailableError(f"{file} cannot be read: {error.strerror or error}") from None
        return content, hashlib.sha256(content).hexdigest()

    def create(self, name: str, content: bytes, tag: str = "") -> bool:
        """Write a file unless there is one; return whether it has this content now.

        With a `tag` it replaces the file that was read with it. Raises UnavailableError.
        """
        file = self._root / name
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            beside = file.with_name(f".new-{secrets.token_hex(8)}")
            try:
                with beside.open("xb") as stream:
                    stream.write(content)
                    stream.flush()
                    os.fsync(stream.fileno())
                if tag:
                    with locked(file.parent):
                        if self.read(name, MAX_DOCUMENT_BYTES)[1] == tag:
                            beside.replace(file)
                else:
                    with contextlib.suppress(FileExistsError):
                        os.link(beside, file)  # whole at once, and only if there is none
            finally:
                beside.unlink(missing_ok=True)
            return self.read(name, MAX_DOCUMENT_BYTES)[0] == content
        except OSError as error:
            raise UnavailableError(f"{file} cannot be written: {error.strerror or error}") from None

    def names(self, folder: str) -> list[str]:
        """Return the names below a folder; none if it does not exist. Raises UnavailableError."""
        try:
            return [file.name for file in (self._root / folder).iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise UnavailableError(f"{self._root / folder} cannot be read: {error.strerror or error}") from None
