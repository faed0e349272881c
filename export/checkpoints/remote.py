"""Download of a checkpoint from any URI that Ray itself reads, into a temporary folder that is removed afterwards.

Like Ray's own storage it asks pyarrow first (`file://`, `s3://`, `gs://`, `hdfs://`) and then fsspec (`memory://`,
`abfs://`, `http://`, ... if the package of that protocol is installed).
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.errors import CheckpointError, RlservoError, UsageError, first_line

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")  # two letters and more: C:// would be a drive


def is_uri(path: str | Path) -> bool:
    """Return whether `path` is a URI with a protocol."""
    return isinstance(path, str) and _SCHEME.match(path) is not None


@contextlib.contextmanager
def fetch(path: str | Path, progress: Callable[[str], None]) -> Iterator[Path]:
    """Give the local folder of `path`: itself, or a copy of its URI's files, removed at the end.

    Raises CheckpointError when nothing is there, UsageError when no file system here reads such URIs. Errors from
    inside name the URI, not the copy.
    """
    if not is_uri(path):
        yield Path(path)
        return
    uri = str(path)
    with tempfile.TemporaryDirectory(prefix="rlservo-checkpoint-") as folder:
        local = Path(folder).resolve() / (re.sub(r"[^A-Za-z0-9._-]", "-", uri.rstrip("/").rpartition("/")[2]) or "it")
        progress(f"fetching {uri}")
        _download(uri, local)
        try:
            yield local
        except RlservoError as error:
            error.message = error.message.replace(str(local), uri.rstrip("/"))
            error.args = (error.message,)
            raise


def _download(uri: str, local: Path) -> None:
    import pyarrow.fs

    filesystem, inside = _filesystem(uri)
    try:
        info: Any = filesystem.get_file_info(inside)
        if info.type == pyarrow.fs.FileType.NotFound:
            raise CheckpointError(f"{uri} does not exist: expected the folder of an RLlib checkpoint")
        if info.type == pyarrow.fs.FileType.File:
            raise CheckpointError(f"{uri} is a file: expected the folder of an RLlib checkpoint")
        local.mkdir()
        here = pyarrow.fs.LocalFileSystem()
        pyarrow.fs.copy_files(inside, str(local), source_filesystem=filesystem, destination_filesystem=here)
    except CheckpointError:
        raise
    except Exception as error:  # credentials, names, networks: each file system has errors of its own
        raise CheckpointError(f"{uri} cannot be fetched: {first_line(error)}") from error


def _filesystem(uri: str) -> tuple[FileSystem, str]:
    """Return the file system that reads `uri`, and the path on it."""
    from pyarrow.fs import FileSystem, FSSpecHandler, PyFileSystem

    with contextlib.suppress(Exception):  # pyarrow fails in several ways; fsspec is tried next
        native, inside = FileSystem.from_uri(uri)
        return native, inside
    try:
        import fsspec

        opened, inside = fsspec.core.url_to_fs(uri)
    except Exception as error:
        raise UsageError(
            f"{uri} cannot be read here: neither pyarrow nor fsspec opens '{uri.partition('://')[0]}' "
            f"({first_line(error)}); copy the checkpoint to a local folder"
        ) from error
    return PyFileSystem(FSSpecHandler(opened)), inside
