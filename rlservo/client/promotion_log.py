"""Log of a promotion in JSON lines: each has its whole state, so that a killed promotion continues from the last."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, BinaryIO

from rlservo.errors import UsageError


class PromotionLog:
    """A file that one process at a time appends to."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Read the last line, but not one that a killed process left unfinished. Raises UsageError for another file."""
        self.path, self._file = path, file
        content = file.read()
        *lines, torn = content.split(b"\n")
        if content and not content.startswith(b'{"time": '):
            raise UsageError(f"{path} is not a promotion's log: name another --log")
        file.truncate(len(content) - len(torn))
        self.last = lines[-1] if lines else b""

    @property
    def has_begun(self) -> bool:
        """Whether the log ends with a promotion that has not ended."""
        return bool(self.last) and json.loads(self.last).get("event") != "end"

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> Iterator[PromotionLog]:
        """Open a log, made if it is not there. Raises UsageError if it is not a log or another process writes it."""
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(path.open("a+b", buffering=0))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UsageError(
                    f"another 'rlservo policy promote' is writing {path}: wait for it, or stop it"
                ) from None
            except OSError as error:
                raise UsageError(f"the log {path} cannot be written: {error.strerror}") from None
            file.seek(0)
            try:
                yield cls(path, file)
            finally:
                if not os.fstat(file.fileno()).st_size:  # nothing was begun
                    path.unlink(missing_ok=True)

    def write(self, event: str, fields: dict[str, Any]) -> None:
        """Append a line and sync it to disk: the next step may not be undone. Raises UsageError."""
        entry = {"time": datetime.now(timezone.utc).isoformat(timespec="milliseconds"), "event": event} | fields
        line = json.dumps(entry).encode()
        content, size = line + b"\n", os.fstat(self._file.fileno()).st_size
        try:
            while content:
                content = content[self._file.write(content) :]
            os.fsync(self._file)
        except OSError as error:  # for example a full disk, which may have taken half of it
            self._file.truncate(size)
            raise UsageError(f"the log {self.path} cannot be written: {error.strerror}") from None
        self.last = line
