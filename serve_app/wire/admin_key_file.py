"""File with the admin key of a server on this machine: its place follows from the port, so both sides find it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from rlservo.export.contract.errors import UsageError

LONGEST_KEY_FILE = 4096  # [bytes] far more than a key


def key_file(port: int) -> Path:
    """Return the path of the key file of a server on this port.

    Below XDG_RUNTIME_DIR, else in the user's cache, else (for a user without a home) in the folder for temporary files.
    """
    folder = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        place = Path(folder or Path.home() / ".cache") / "rlservo"
    except RuntimeError:
        place = Path(tempfile.gettempdir()) / f"rlservo-{os.getuid()}"
    return place / f"admin-{port}.key"


def read_key(file: Path) -> str:
    """Return the key in a file. Raises UsageError."""
    try:
        with file.open(encoding="ascii") as stream:
            key = stream.read(LONGEST_KEY_FILE).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the key file {file} cannot be read: {error}") from None
    if not key or len(key.split()) != 1:
        raise UsageError(f"the key file {file} should hold one key and nothing else")
    return key
