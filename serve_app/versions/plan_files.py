"""Plans as numbered files in `.plan/` of a repository: created, never overwritten, read by every process.

The files stand in the first of the places that can be written, a repository's folder or object storage. Where none can
(bundle folders, http, a read-only file system), they stand in the user's state folder. Creating a file fails where it
exists, which is all the agreement between processes that is needed.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import secrets
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from rlservo.export.contract.bundle import CONTRACT_FILE
from rlservo.export.contract.contract import first_fault
from rlservo.export.contract.errors import UnavailableError
from rlservo.export.contract.regular_files import blocks, open_regular
from rlservo.serve_app.repository.bundle_cache import default_folder
from rlservo.serve_app.repository.object_storage import ObjectStorage, is_uri, place_of
from rlservo.serve_app.repository.repository import TIMEOUT_S
from rlservo.serve_app.versions.serving_plan import Plan

FOLDER = ".plan"
FOLDER_POLL_S = 0.5
STORAGE_POLL_S = 5.0
MAX_PLAN_BYTES = 16 << 20  # of 1,000 policies it has 0.3 MB


class FolderStorage:
    """Files below a folder, by the methods of `ObjectStorage` that plans need. NFS will do."""

    def __init__(self, root: Path) -> None:
        self.uri = str(root)
        self._root = root

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return a file. Raises FileNotFoundError, and UnavailableError if it cannot be read."""
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
        return self.read(name, MAX_PLAN_BYTES)[0] == content

    def names(self, folder: str) -> list[str]:
        """Return the names below a folder; none if it does not exist. Raises UnavailableError."""
        try:
            return [file.name for file in (self._root / folder).iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise UnavailableError(f"{self._root / folder} cannot be read: {error.strerror or error}") from None


class PlanFiles:
    """The plans of the processes that serve the same places. Everything here blocks."""

    def __init__(
        self,
        places: Sequence[str | Path],
        *,
        root: str | None = None,
        cache: str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        """`root` is a folder or URI for the plans instead of the places. Raises UsageError.

        `cache` keeps a copy of what object storage gave last; reading or writing a plan may take `timeout_s`.
        """
        self._places = [place_of(place) for place in places]
        self._root = None if root is None else place_of(root)
        self._cache = cache
        self.timeout_s = timeout_s

    @property
    def place(self) -> str:
        """Place of the plans."""
        return f"{self._storage.uri}/{FOLDER}"

    @property
    def poll_s(self) -> float:
        """[s] between looks for a new plan."""
        return FOLDER_POLL_S if self._copy is None else STORAGE_POLL_S

    def newest(self) -> Plan | None:
        """Return the newest plan, if there is one. Raises UnavailableError."""
        numbers = [int(name[:-5]) for name in self._storage.names(FOLDER) if re.fullmatch(r"\d{9}\.json", name)]
        return self._read(max(numbers)) if numbers else None

    def after(self, number: int) -> Plan | None:
        """Return the newest plan that has followed one; None where none has. Raises UnavailableError."""
        plan = None
        while (following := self._read(number + 1)) is not None:
            plan, number = following, number + 1
        return plan

    def create(self, plan: Plan) -> bool:
        """Write a plan under its number; return False if that is taken. Raises UnavailableError."""
        content = plan.model_dump_json(indent=1).encode() + b"\n"
        if not self._storage.create(_name(plan.generation), content):
            return False
        self._remember(content)
        return True

    def remembered(self) -> Plan | None:
        """Return the newest plan that object storage gave this machine, for a start without it."""
        with contextlib.suppress(OSError, ValidationError):
            if self._copy is not None:
                return Plan.model_validate_json(self._copy.read_bytes())
        return None

    @functools.cached_property
    def _storage(self) -> ObjectStorage | FolderStorage:
        root = self._root or _first_writable(self._places)
        return ObjectStorage(root, timeout_s=self.timeout_s / 2) if is_uri(root) else FolderStorage(Path(root))

    @functools.cached_property
    def _copy(self) -> Path | None:
        if isinstance(self._storage, FolderStorage):
            return None
        folder = Path(self._cache) if self._cache is not None else default_folder() / "bundles"
        return folder / f".plan-{_hash(self._storage.uri)}"

    def _read(self, number: int) -> Plan | None:
        name = _name(number)
        try:
            content, _ = self._storage.read(name, MAX_PLAN_BYTES)
            plan = Plan.model_validate_json(content)
        except FileNotFoundError:
            return None
        except ValidationError as error:
            place = f"{self._storage.uri}/{name}"
            raise UnavailableError(f"{place} is not a plan that this rlservo can read: {first_fault(error)}") from None
        self._remember(content)
        return plan

    def _remember(self, content: bytes) -> None:
        with contextlib.suppress(OSError):  # a full disk, say: then an older one stays
            if self._copy is not None:
                self._copy.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                beside = self._copy.with_suffix(f".{secrets.token_hex(4)}")
                beside.write_bytes(content)
                beside.replace(self._copy)


def _name(number: int) -> str:
    return f"{FOLDER}/{number:09d}.json"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _first_writable(places: Sequence[str]) -> str:
    for place in places:
        if is_uri(place):
            if place.startswith("s3://"):
                return place
        elif not Path(place, CONTRACT_FILE).exists() and (Path(place, FOLDER).is_dir() or os.access(place, os.W_OK)):
            return place
    return str(default_folder("XDG_STATE_HOME", ".local/state") / "plans" / _hash("\n".join(places)))
