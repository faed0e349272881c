"""Repository of published versions behind a URI: lists them by its index, fetches one into the cache by its hash.

    <uri>/index.json             the hash of every version: without its line there is no such version
    <uri>/<name>/<version>/...   the bundle's files, which never change

Anyone with write access there may have written them: names, sizes and numbers are checked before they are used. What is
in the cache needs no storage: servers continue, and start again, while the storage is unreachable.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rlservo.export.contract.bundle import DEFAULT_LIMITS, MAX_FILES, MAX_SUMS_BYTES, SUMS_FILE, BundleLimits, read_sums
from rlservo.export.contract.contract import NAME_PATTERN, VERSION_PATTERN, first_fault
from rlservo.export.contract.errors import BundleError, BundleTamperedError
from rlservo.serve_app.repository.bundle_cache import BundleCache
from rlservo.serve_app.repository.storage import MAX_DOCUMENT_BYTES, FolderStorage, object_storage

if TYPE_CHECKING:
    from rlservo.serve_app.repository.object_storage import ObjectStorage

Key = tuple[str, str]  # (name, version)
INDEX = "index.json"
MAX_FILE_BYTES = 4 << 30  # where no limit is set
DATA_SUFFIXES = (".onnx", ".ts", ".json", ".npz", ".md", ".txt", ".csv", ".yaml", ".png")
"""Of files that a user has added to a bundle: nothing that something might run or unpickle."""


class Index(BaseModel):
    """Every version that is published, with the hash of its SHA256SUMS."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    format: Literal[1] = 1
    policies: dict[
        Annotated[str, Field(pattern=NAME_PATTERN)],
        dict[Annotated[str, Field(pattern=VERSION_PATTERN)], Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]],
    ] = {}

    @classmethod
    def read(cls, storage: ObjectStorage | FolderStorage) -> tuple[Index | None, str]:
        """Return a storage's index, None if it has none, and the tag. Raises BundleError, UnavailableError."""
        try:
            content, tag = storage.read(INDEX, MAX_DOCUMENT_BYTES)
        except FileNotFoundError:
            return None, ""
        return cls.parse(content, f"{storage.uri}/{INDEX}"), tag

    @classmethod
    def parse(cls, content: bytes, place: str) -> Index:
        """Return the index that was read at `place`. Raises BundleError."""
        try:
            return cls.model_validate(json.loads(content))
        except (ValueError, RecursionError) as error:
            reason = first_fault(error, shows_input=True) if isinstance(error, ValidationError) else str(error)
            raise BundleError(f"{place} is not an index of versions: {reason[:300]}") from None


class RemoteRepository:
    """Published versions below one URI."""

    def __init__(
        self, uri: str, cache: BundleCache, limits: BundleLimits = DEFAULT_LIMITS, *, timeout_s: float
    ) -> None:
        """Take the time-out of a look or a fetch. Raises UsageError."""
        self.uri = uri
        self.cache = cache
        self._storage = object_storage(uri, timeout_s)
        self._limits = limits

    def versions(self) -> dict[Key, str]:
        """Return the hash of every published version. Raises UnavailableError, and BundleError if there is none."""
        index, _ = Index.read(self._storage)
        if index is None:
            raise BundleError(f"{self.uri} has no {INDEX}: nothing was published there (`rlservo publish`)")
        return {(name, version): digest for name, each in index.policies.items() for version, digest in each.items()}

    @contextlib.contextmanager
    def fetch(self, name: str, version: str, digest: str) -> Iterator[Path]:
        """Give the folder of the bundle with that hash until the block ends, fetched unless the cache has it.

        Raises UnavailableError, BundleError, and BundleTamperedError where another bundle is there by now.
        """
        place = f"{self.uri}/{name}/{version}"

        def download(entry: Path) -> None:
            self._copy(f"{name}/{version}/{SUMS_FILE}", MAX_SUMS_BYTES, entry / SUMS_FILE)
            found, sums = read_sums(entry)
            if found != digest:
                raise BundleTamperedError(
                    f"{place} is not the bundle that was accepted as version {version} of '{name}' (its hashes "
                    "differ): published versions do not change; publish changes as a new version"
                )
            if len(sums) > MAX_FILES:
                raise BundleError(f"{place} lists {len(sums)} files: at most {MAX_FILES}")
            for file in sums:
                check_file_type(file, place)
                self._copy(f"{name}/{version}/{file}", self._limits.of(file)[0] or MAX_FILE_BYTES, entry / file)

        with self.cache.bundle(digest, place, download) as folder:
            yield folder

    def _copy(self, name: str, most: int, file: Path) -> None:
        try:
            with file.open("wb") as stream:
                self._storage.copy(name, most, stream)
        except FileNotFoundError:
            raise BundleError(f"{self.uri}/{name} is not there: the version was deleted, all or in part") from None


def check_file_type(name: str, place: Any) -> None:
    """Raise BundleError for a file that does not belong to a bundle."""
    if PurePosixPath(name).suffix not in DATA_SUFFIXES:
        raise BundleError(f"{place} lists {name}: a published bundle holds {', '.join(DATA_SUFFIXES)} and {SUMS_FILE}")
