"""Places that hold bundles and plans: folders, and storages named by a URI."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from rlservo.export.contract.errors import UnavailableError, UsageError
from rlservo.export.contract.extras import needs_extra
from rlservo.export.contract.regular_files import blocks, open_regular

if TYPE_CHECKING:
    from rlservo.serve_app.repository.object_storage import ObjectStorage

TIMEOUT_S = 30.0
MAX_DOCUMENT_BYTES = 16 << 20  # of an index or a plan; 1,000 policies take 0.3 MB
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")  # two letters and more: C:// would be a drive


def is_uri(place: str | Path) -> bool:
    """Return whether a place is named by a protocol."""
    return isinstance(place, str) and _SCHEME.match(place) is not None


def place_of(place: str | Path) -> str:
    """Return an absolute folder (or `file://`) or a URI that holds no secret. Raises UsageError."""
    if not is_uri(place):
        return str(Path(place).expanduser().absolute())
    parts = urlsplit(str(place).rstrip("/"))
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return unquote(parts.path) or "/"
    if parts.scheme not in ("s3", "http", "https") or not parts.hostname or "@" in parts.netloc or parts.query:
        shown = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
        raise UsageError(
            f"{shown}: expected s3://bucket/policies, https://host/policies or file:///policies; a password or query "
            "may be a secret, and credentials come from the environment"
        )
    return parts.geturl()


def object_storage(uri: str, timeout_s: float) -> ObjectStorage:
    """Return the storage behind a URI; a call may take half of `timeout_s`, so that a hanging one is named in time.

    Raises UsageError.
    """
    with needs_extra("remote", "httpcore"):
        from rlservo.serve_app.repository.object_storage import ObjectStorage
    return ObjectStorage(uri, timeout_s=timeout_s / 2)


class FolderStorage:
    """Files below a folder, by the methods of `ObjectStorage` that plans need. Works on NFS."""

    def __init__(self, root: Path) -> None:
        self.uri = str(root)
        self._root = root

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return a file of at most `most` bytes. Raises FileNotFoundError, UnavailableError if it cannot be read."""
        file = self._root / name
        try:
            # Opening the folder has NFS ask its server what is new in it; a look for the file alone would not.
            os.close(os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY))
            with open_regular(file, most) as stream:
                return b"".join(blocks(stream, most)), ""
        except FileNotFoundError:
            raise
        except OSError as error:
            raise UnavailableError(f"{file} cannot be read: {error.strerror or error}") from None

    def create(self, name: str, content: bytes) -> bool:
        """Write a file unless there is one; return whether it has this content now. Raises UnavailableError."""
        file = self._root / name
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            beside = file.with_name(f".new-{secrets.token_hex(8)}")
            try:
                with beside.open("xb") as stream:
                    stream.write(content)
                    stream.flush()
                    os.fsync(stream.fileno())
                with contextlib.suppress(FileExistsError):
                    os.link(beside, file)  # whole at once, and only if there is none
            finally:
                beside.unlink(missing_ok=True)
        except OSError as error:
            raise UnavailableError(f"{file} cannot be written: {error.strerror or error}") from None
        return self.read(name, MAX_DOCUMENT_BYTES)[0] == content

    def names(self, folder: str) -> list[str]:
        """Return the names below a folder; none if it does not exist. Raises UnavailableError."""
        try:
            return [file.name for file in (self._root / folder).iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise UnavailableError(f"{self._root / folder} cannot be read: {error.strerror or error}") from None
