"""Manifest of a published version: every file's size and hash, written last, so that a version is whole or not there.

A manifest stands beside its version's folder, `<name>/<version>.json` beside `<name>/<version>/`. Whoever may write
there wrote it: names, sizes and numbers of files are checked before anything is made of them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import Self

from rlservo.export.contract.bundle import (
    CONTRACT_FILE,
    DEFAULT_LIMITS,
    GOLDEN_FILE,
    MAX_FILES,
    MAX_SUMS_BYTES,
    ONNX_FILE,
    SUMS_FILE,
    TORCHSCRIPT_FILE,
    BundleLimits,
)
from rlservo.export.contract.contract import NAME_PATTERN, VERSION_PATTERN
from rlservo.export.contract.errors import BundleError

FORMAT = 1
MAX_MANIFEST_BYTES = 1 << 16
SUFFIX = ".json"
REQUIRED = (ONNX_FILE, TORCHSCRIPT_FILE, CONTRACT_FILE, GOLDEN_FILE, SUMS_FILE)
DATA_SUFFIXES = (".onnx", ".ts", ".json", ".npz", ".md", ".txt", ".csv", ".yaml", ".png")
"""Of files that a user has added to a bundle: nothing that something might run or unpickle."""

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*$", max_length=128)]
"""Of one file in the version's folder: no separator, no leading dot, no `..`."""


class PublishedFile(BaseModel):
    """One file as it was published."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    size: int = Field(ge=0, le=1 << 40)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class Manifest(BaseModel):
    """One published version."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal[1]
    name: str = Field(pattern=NAME_PATTERN)
    version: str = Field(pattern=VERSION_PATTERN)
    published_at: str = Field(max_length=64)
    files: dict[FileName, PublishedFile]

    @property
    def digest(self) -> str:
        """What tells the bundle from every other, as `bundle.digest_of`."""
        return self.files[SUMS_FILE].sha256

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files.values())

    def encode(self) -> bytes:
        """Return the manifest's content."""
        return self.model_dump_json(indent=1).encode() + b"\n"

    @classmethod
    def parse(cls, content: bytes, place: str, limits: BundleLimits = DEFAULT_LIMITS) -> Self:
        """Return the manifest that was read at `place`, a URI or path that ends in `<name>/<version>.json`.

        Raises BundleError with what is wrong with it, in a sentence that names `place`.
        """
        if len(content) > MAX_MANIFEST_BYTES:
            raise BundleError(f"{place} is larger than {MAX_MANIFEST_BYTES:,} bytes: no manifest is")
        try:
            document = json.loads(content, object_pairs_hook=_without_duplicates)
        except (ValueError, RecursionError) as error:
            raise BundleError(f"{place} is no manifest: {str(error)[:200]}") from None
        found = document.get("format") if isinstance(document, dict) else None
        if found != FORMAT or isinstance(found, bool):
            raise BundleError(f"{place} is of format {found!r:.20}: this rlservo reads manifests of format {FORMAT}")
        try:
            manifest = cls.model_validate(document)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(str(part)[:80] for part in first["loc"])
            raise BundleError(f"{place}: {where}: {first['msg']} (given: {first['input']!r:.80})") from None
        manifest._check(place, limits)
        return manifest

    def _check(self, place: str, limits: BundleLimits) -> None:
        path = PurePosixPath(place)
        if (path.parent.name, path.name) != (self.name, self.version + SUFFIX):
            raise BundleError(
                f"{place} is the manifest of policy '{self.name}' version {self.version}: "
                f"expected at {self.name}/{self.version}{SUFFIX}"
            )
        if missing := [name for name in REQUIRED if name not in self.files]:
            raise BundleError(f"{place} does not list {missing[0]}: the bundle is incomplete")
        if len(self.files) > MAX_FILES + 1:
            raise BundleError(f"{place} lists {len(self.files)} files: at most {MAX_FILES + 1}")
        for name, file in self.files.items():
            check_file_type(name, place)
            most, limit = (MAX_SUMS_BYTES, "") if name == SUMS_FILE else limits.of(name)
            if most is not None and file.size > most:
                reason = f"at most {most:,}{f' ({limit})' if limit else ''}"
                raise BundleError(f"{place}: {name} has {file.size:,} bytes: {reason}")


def check_file_type(name: str, place: str) -> None:
    """Raise BundleError for a file that is no data of a bundle."""
    if name != SUMS_FILE and PurePosixPath(name).suffix not in DATA_SUFFIXES:
        raise BundleError(f"{place} lists {name}: a published bundle holds {', '.join(DATA_SUFFIXES)} and {SUMS_FILE}")


def _without_duplicates(pairs: Sequence[tuple[str, Any]]) -> Mapping[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has {max(names, key=names.count)!r:.80} twice")
    return document
