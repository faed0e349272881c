"""Plans as numbered files in `.plan/` of a repository: created, never overwritten, read by every process.

They are kept in the first of the places that can be written, a repository's folder or object storage. If none can
(bundle folders, http, a read-only file system), they are kept in the user's state folder. Creating a file fails if it
exists: processes need no other agreement.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError

from rlservo.bundle.bundle import CONTRACT_FILE
from rlservo.bundle.contract import first_fault
from rlservo.bundle.production import PLAN_FOLDER as FOLDER
from rlservo.bundle.production import (
    NotAPlanError,
    check_number,
    hash_of,
    newest_plan,
    not_ours,
    note_of,
    plan_name,
)
from rlservo.bundle.user_folders import default_folder, plans_folder
from rlservo.errors import UnavailableError, UsageError
from rlservo.serve_app.repository.places import TIMEOUT_S, is_uri, place_of
from rlservo.serve_app.repository.storage import MAX_DOCUMENT_BYTES, FolderStorage, storage_at
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.deployment_plan import Plan

if TYPE_CHECKING:
    from rlservo.serve_app.repository.hub_storage import HubStorage
    from rlservo.serve_app.repository.object_storage import ObjectStorage

FOLDER_POLL_S = 0.5
STORAGE_POLL_S = 5.0
MOST_RECENT = 20

Result = TypeVar("Result")


class PlanFiles:
    """The plans of the processes that serve the same places. All but `call` blocks."""

    def __init__(
        self,
        places: Sequence[str | Path],
        *,
        root: str | None = None,
        cache: str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        """`root` is a folder or URI for the plans instead of the places. Raises UsageError.

        `cache` keeps a copy of the last plan from object storage; reading or writing a plan may take `timeout_s`.
        """
        self._places = [place_of(place) for place in places]
        self._root = None if root is None else place_of(root)
        self._cache = cache
        self._timeout_s = timeout_s
        self._calls = BlockingCalls(timeout_s)

    @property
    def place(self) -> str:
        """Place of the plans."""
        return f"{self._storage.uri}/{FOLDER}"

    @property
    def poll_s(self) -> float:
        """[s] between looks for a new plan."""
        return FOLDER_POLL_S if self._copy is None else STORAGE_POLL_S

    async def call(self, method: Callable[..., Result], *arguments: Any) -> Result:
        """Call a method below. Raises what it raises, and UnavailableError when it takes too long."""
        return await self._calls.run("reading or writing the plan of what is served", method, *arguments)

    def newest(self) -> Plan | None:
        """Return the newest plan, if there is one. Raises UnavailableError."""
        try:
            number = newest_plan(self._storage.names(FOLDER), lambda number: self._read(number) is not None)
        except NotAPlanError as fault:
            raise UnavailableError(not_ours(self._storage.uri, fault)) from None
        return None if number is None else self._read(number)

    def after(self, number: int) -> Plan | None:
        """Return the newest plan that has followed one; None if none has. Raises UnavailableError."""
        plan = None
        while (following := self._read(number + 1)) is not None:
            plan, number = following, number + 1
        return plan

    def recent(self, plan: Plan, most: int = MOST_RECENT) -> tuple[Plan, ...]:
        """Return a plan and those before it, the newest first; from object storage the plan alone: each is a request.

        Raises UnavailableError.
        """
        first = plan.generation if self._copy is not None else max(1, plan.generation - most + 1)
        earlier = (self._read(number) for number in range(plan.generation - 1, first - 1, -1))
        return (plan, *(each for each in earlier if each is not None))

    def create(self, plan: Plan) -> bool:
        """Write a plan under its number; return False if that is taken. Raises UnavailableError."""
        content = plan.model_dump_json(indent=1).encode() + b"\n"
        if not self._storage.create(_name(plan.generation), content):
            return False
        self._remember(content)
        return True

    def remembered(self) -> Plan | None:
        """Return the newest plan that this machine has read from object storage, for a start without it."""
        with contextlib.suppress(OSError, ValidationError):
            if self._copy is not None:
                return Plan.model_validate_json(self._copy.read_bytes())
        return None

    def note_places(self) -> None:
        """Note for this user's other processes where the plan of each local place is, if not in the place itself."""
        for place in self._places:
            if self._root is None and not is_uri(place):
                with contextlib.suppress(OSError, UsageError):  # no home, or one that cannot be written
                    note = note_of(place)
                    if self._storage.uri == place:
                        note.unlink(missing_ok=True)
                    else:
                        note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                        note.write_text(self._storage.uri)

    @functools.cached_property
    def _storage(self) -> ObjectStorage | HubStorage | FolderStorage:
        return storage_at(self._root or _first_writable(self._places), self._timeout_s)

    @functools.cached_property
    def _copy(self) -> Path | None:
        if isinstance(self._storage, FolderStorage):
            return None
        folder = Path(self._cache) if self._cache is not None else default_folder() / "bundles"
        return folder / f".plan-{hash_of(self._storage.uri)}"

    def _read(self, number: int) -> Plan | None:
        name = _name(number)
        try:
            content, _ = self._storage.read(name, MAX_DOCUMENT_BYTES)
            plan = Plan.model_validate_json(content)
        except FileNotFoundError:
            return None
        except ValidationError as error:
            place = f"{self._storage.uri}/{name}"
            raise UnavailableError(f"{place} is not a plan that this rlservo can read: {first_fault(error)}") from None
        try:
            check_number(number, plan.generation)
        except NotAPlanError as fault:
            raise UnavailableError(not_ours(self._storage.uri, fault)) from None
        self._remember(content)
        return plan

    def _remember(self, content: bytes) -> None:
        with contextlib.suppress(OSError):  # a full disk, for example: then an older copy stays
            if self._copy is not None:
                self._copy.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                beside = self._copy.with_suffix(f".{secrets.token_hex(4)}")
                beside.write_bytes(content)
                beside.replace(self._copy)


def _name(number: int) -> str:
    return f"{FOLDER}/{plan_name(number)}"


def _first_writable(places: Sequence[str]) -> str:
    for place in places:
        if is_uri(place):
            if place.startswith("s3://"):
                return place
        # With a slash, which only a folder may have.
        elif not Path(place, CONTRACT_FILE).exists() and (
            Path(place, FOLDER).is_dir() or os.access(f"{place}/", os.W_OK)
        ):
            return place
    return str(plans_folder() / hash_of("\n".join(places)))
