"""Admin key that `rlservo serve` makes for its user: a file that only this user can read, removed with the server.

The file's place follows from the port, so that `rlservo policy` on the same machine finds it by itself.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.wire.admin_key_file import read_key

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def operator_key(file: Path) -> Iterator[str]:
    """Write a new key to `file`, readable only by this user, and remove it at the end.

    Yields its `sha256:<hash>`, or '' if the file cannot be written, which is logged.
    """
    key, line = new_key("operator", admin=True)
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file.unlink(missing_ok=True)  # of a server that was killed
        # Must be a new file: a file or link that another user put there is not used.
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            stream.write(key + "\n")
    except OSError as error:
        logger.warning("no admin key for 'rlservo policy': %s cannot be written (%s)", file, error.strerror)
        yield ""
        return
    try:
        yield line.split()[-1]
    finally:
        with contextlib.suppress(UsageError, OSError):
            if read_key(file) == key:  # not that of a later server
                file.unlink()
