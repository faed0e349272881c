"""Index of the versions published at a place: the hash of each. Without its line there is no such version.

    <place>/index.json             written last, and replaced only if no one else has replaced it
    <place>/<name>/<version>/...   the bundle's files, which never change

Anyone with write access there may have written them: names, sizes and numbers are checked before they are used.
"""

from __future__ import annotations

import json
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import Self

from rlservo.bundle.bundle import SUMS_FILE, Bundle
from rlservo.bundle.contract import NAME_PATTERN, VERSION_PATTERN, first_fault
from rlservo.errors import BundleError
from rlservo.serve_app.repository.storage import MAX_DOCUMENT_BYTES, FolderStorage

if TYPE_CHECKING:
    from rlservo.serve_app.repository.hub_storage import HubStorage
    from rlservo.serve_app.repository.object_storage import ObjectStorage

INDEX = "index.json"
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
    def read(cls, storage: ObjectStorage | HubStorage | FolderStorage) -> tuple[Self, str]:
        """Return a storage's index, empty if it has none, and the tag. Raises BundleError, UnavailableError."""
        try:
            content, tag = storage.read(INDEX, MAX_DOCUMENT_BYTES)
        except FileNotFoundError:
            return cls(), ""
        return cls.parse(content, f"{storage.uri}/{INDEX}"), tag

    @classmethod
    def parse(cls, content: bytes, place: str) -> Self:
        """Return the index that was read at `place`. Raises BundleError."""
        try:
            return cls.model_validate(json.loads(content))
        except (ValueError, RecursionError) as error:
            reason = first_fault(error, shows_input=True) if isinstance(error, ValidationError) else str(error)
            raise BundleError(f"{place} is not an index of versions: {reason[:300]}") from None

    def hash_of(self, bundle: Bundle) -> str | None:
        """Return the hash under which a bundle's version is published."""
        return self.policies.get(bundle.contract.name, {}).get(bundle.contract.version)


def check_file_type(name: str, place: Any) -> None:
    """Raise BundleError for a file that does not belong to a bundle."""
    if PurePosixPath(name).suffix not in DATA_SUFFIXES:
        raise BundleError(f"{place} lists {name}: a published bundle holds {', '.join(DATA_SUFFIXES)} and {SUMS_FILE}")
