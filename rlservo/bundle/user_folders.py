"""Folders of this user for what rlservo keeps."""

from __future__ import annotations

import os
from pathlib import Path

from rlservo.errors import UsageError


def default_folder(variable: str = "XDG_CACHE_HOME", below_home: str = ".cache") -> Path:
    """Return the user's folder for what rlservo keeps. Raises UsageError."""
    root = os.environ.get(variable)
    try:
        return (Path(root) if root else Path.home() / below_home) / "rlservo"
    except RuntimeError:  # a container's user without a home
        raise UsageError(f"this user has no home folder: name a folder in {variable}") from None


def plans_folder() -> Path:
    """Return the folder for plans of places that cannot be written, and for notes on where plans are.

    Raises UsageError.
    """
    return default_folder("XDG_STATE_HOME", ".local/state") / "plans"
