"""File with the admin key that `rlservo serve` makes: only its user can read it, and it is removed with the server.

Its place follows from the port, so that `rlservo policy` on the same machine finds it by itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rlservo.errors import UsageError

logger = logging.getLogger(__name__)

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
    except OSError as error:
        raise UsageError(f"the key file {file} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        key = ""
    if len(key.split()) != 1:
        raise UsageError(f"the key file {file} does not hold a key: expected the key alone, on one line")
    return key


@contextlib.contextmanager
def written_key(file: Path, key: str) -> Iterator[bool]:
    """Write a key to `file` and remove it at the end; yield whether it could be written, which is logged if not."""
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file.unlink(missing_ok=True)  # of a server that was killed
        # Must be a new file: a file or link that another user put there is not used.
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            stream.write(key + "\n")
    except OSError as error:
        logger.warning("no admin key for 'rlservo policy': %s cannot be written (%s)", file, error.strerror)
        yield False
        return
    try:
        yield True
    finally:
        remove_key(file, digest_of_key(key))


def remove_key(file: Path, digest: str) -> None:
    """Remove the file if it holds the key with this digest, and not that of a later server."""
    with contextlib.suppress(UsageError, OSError):
        if digest_of_key(read_key(file)) == digest:
            file.unlink()


def digest_of_key(key: str) -> str:
    """Return a key's digest as a server's settings and key files have it."""
    return f"sha256:{hashlib.sha256(key.encode()).hexdigest()}"
