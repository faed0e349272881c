"""Folders that are expensive to make, kept in the user's cache between runs and shared by the processes of one run.

Each is named after a hash of what it is made of, so a change there makes it again.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KEPT_S = 14 * 86400.0  # since a folder was last used
PYTHON = f"python{sys.version_info[0]}.{sys.version_info[1]}"


def cached(name: str, made_of: Iterable[Path | str], make: Callable[[Path], None]) -> Path:
    """Return a folder that `make` has filled, in this run or an earlier one. Callers that change files copy first.

    `made_of` identifies the content: files and folders (by what is in them) and words such as versions.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rlservo-tests"
    root.mkdir(parents=True, exist_ok=True)
    folder = root / f"{name}-{digest(made_of)}"
    complete = folder.with_name(f"{folder.name}.complete")  # beside it: the folder holds what `make` wrote, only
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another process of this run, or another run, may be making the same
        if not complete.exists():
            _remove_unused(root, name)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
        complete.touch()
    return folder


def versions(*packages: str) -> str:
    """Return a word for `made_of`: this Python and the installed versions of these packages."""
    return " ".join([PYTHON, *(f"{package}=={_version(package)}" for package in packages)])


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # then nothing is made with it here
        return "none"


def digest(made_of: Iterable[Path | str]) -> str:
    """Return a word that identifies the content of files, folders and words."""
    found = hashlib.sha256()
    for part in made_of:
        if isinstance(part, str):
            found.update(f"{part}\0".encode())
            continue
        files = [part] if part.is_file() else sorted(file for file in part.rglob("*") if file.is_file())
        for file in files:
            if "__pycache__" not in file.parts:
                found.update(f"{file.relative_to(part.parent)}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:16]


def _remove_unused(root: Path, name: str) -> None:
    for complete in root.glob(f"{name}-*.complete"):
        if time.time() - complete.stat().st_mtime > KEPT_S:
            complete.unlink(missing_ok=True)
            complete.with_suffix(".lock").unlink(missing_ok=True)
            shutil.rmtree(complete.with_suffix(""), ignore_errors=True)
