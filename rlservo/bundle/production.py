"""Production version of a policy by the plan of its folder, for what runs bundles in process.

A server's plan is a numbered file in `.plan/` of the place that it serves: the policy's folder or the repository around
it, or the folder that RLSERVO_PLAN names. Where a place cannot be written, or is not the first of several, its plan is
elsewhere, and a note in the user's state folder says where. `serve_app/versions` writes plans and notes; here only
aliases are read. Which file is the newest plan is decided here for both.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from rlservo.bundle.regular_files import blocks, open_regular
from rlservo.bundle.user_folders import plans_folder
from rlservo.errors import BundleError, UsageError

PRODUCTION = "production"
"""Alias of the version that clients get by default."""
PLAN_FOLDER = ".plan"
PLAN_VARIABLE = "RLSERVO_PLAN"
MAX_PLAN_BYTES = 64 << 20
MAX_NOTE_BYTES = 1 << 16
LAST = 999_999_999  # number of a file that no plan can follow


class Production(NamedTuple):
    """A version that is in production, and the plan that says so."""

    version: str
    plan: Path


class NotAPlanError(Exception):
    """A file among the plans that none of ours can be."""


def production_of(policy: Path, name: str) -> Production | None:
    """Return the production version of a policy in its folder; None if no plan serves it.

    Raises BundleError if a plan cannot be read, is in object storage, or if the policy's and the repository's plan
    contradict each other.
    """
    named = os.environ.get(PLAN_VARIABLE)
    paths = [policy.absolute(), policy.resolve()]  # a link, and what it leads to: either may lie in a repository
    around = dict.fromkeys(place for path in paths for place in (path, path.parent))
    places = [named] if named else [_plan_place(place) for place in around]
    if remote := [place for place in places if "://" in place]:
        raise BundleError(
            f"the plan of '{name}' is in {remote[0]}, which is not read in process: name a version, or version newest"
        )
    found = [each for place in places if (each := _production_at(Path(place, PLAN_FOLDER), name)) is not None]
    if len({each.version for each in found}) > 1:
        both = " and ".join(f"{each.version} by {each.plan}" for each in found)
        raise BundleError(f"the production version of '{name}' is {both}: name a version, or version newest")
    return found[0] if found else None


def newest_plan(names: Iterable[str], exists: Callable[[int], bool]) -> int | None:
    """Return the number of the newest plan, given the files of a plan's folder; None if there is no plan.

    `exists` tells whether a plan that a listing may lack is there. Raises NotAPlanError with the file's name and its
    fault.
    """
    numbers: set[int] = set()
    for name in names:
        if re.fullmatch(r"[0-9]{9}\.json", name):
            numbers.add(int(name[:9]))
        elif name.endswith(".json"):
            raise NotAPlanError(name, "is not the file of a plan")
    if not numbers:
        return None
    number = max(numbers)
    older = numbers - {number, number - 1}
    # Those who serve the plan before would never see it. A listing may lack what was created meanwhile.
    if number == LAST or (older and number - 1 not in numbers and not exists(number - 1)):
        raise NotAPlanError(plan_name(number), f"does not follow plan {max(older, default=0)}")
    return number


def plan_name(number: int) -> str:
    """Return the name of a plan's file."""
    return f"{number:09d}.json"


def check_number(number: int, generation: object) -> None:
    """Raise NotAPlanError if the plan in a file is not the one of its name."""
    if generation != number:
        raise NotAPlanError(plan_name(number), f"holds plan {generation}, so it is a copy")


def not_ours(place: str, fault: NotAPlanError) -> str:
    """Return the sentence about a file below a place that is not a plan."""
    name, what = fault.args
    return f"{place}/{PLAN_FOLDER}/{name} {what}: move it away, no server serves it"


def note_of(place: str) -> Path:
    """Return the file that says where the plan of a place is, if not in the place. Raises UsageError."""
    return plans_folder() / f"{hash_of(place)}.place"


def hash_of(text: str) -> str:
    """Return a name for a text of any length."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _plan_place(place: Path) -> str:
    """Return the folder or URI whose plan serves a place."""
    if not (place / PLAN_FOLDER).is_dir():
        with contextlib.suppress(OSError, UsageError), open_regular(note_of(str(place)), MAX_NOTE_BYTES) as stream:
            return b"".join(blocks(stream, MAX_NOTE_BYTES)).decode()
    return str(place)


def _production_at(folder: Path, name: str) -> Production | None:
    if not folder.is_dir():
        return None
    number = None
    try:
        number = newest_plan(
            (file.name for file in folder.iterdir()), lambda number: (folder / plan_name(number)).exists()
        )
        if number is None:
            return None
        with open_regular(folder / plan_name(number), MAX_PLAN_BYTES) as stream:
            document: Any = json.loads(b"".join(blocks(stream, MAX_PLAN_BYTES)))
        check_number(number, document["generation"])
        policy = document["policies"].get(name) or {}
        version = policy["aliases"][PRODUCTION] if policy.get("versions") else None
    except NotAPlanError as fault:
        raise BundleError(not_ours(str(folder.parent), fault)) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        file = folder if number is None else folder / plan_name(number)
        raise BundleError(
            f"{file} is not a plan that can be read ({type(error).__name__}: {str(error)[:80]}): it does not say "
            f"which version of '{name}' is in production: name one, or version newest"
        ) from None
    return None if version is None else Production(str(version), folder / plan_name(number))
