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

from rlservo.export.contract.errors import UsageError

END = "end"


class PromotionLog:
    """A file that one process at a time appends to."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Read the promotion that has not ended. Raises UsageError for another kind of file."""
        self.path = path
        self._file = file
        *lines, torn = file.read().split(b"\n")
        self._is_torn = bool(torn)  # by a process that was killed while it wrote
        entries = [entry for line in lines if (entry := _entry(line)) is not None]
        if lines and not entries:
            raise UsageError(f"{path} is not a promotion's log: name another --log")
        self.last = entries[-1] if entries and entries[-1]["event"] != END else None
        """The newest entry of a promotion that has not ended."""

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> Iterator[PromotionLog]:
        """Open a log, made if it is not there. Raises UsageError if it is not a log or another process writes it."""
        try:
            file = path.open("a+b", buffering=0)
        except OSError as error:
            raise UsageError(f"the log {path} cannot be written: {error.strerror}") from None
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(
                    f"another 'rlservo policy promote' is writing {path}: wait for it, or stop it"
                ) from None
            file.seek(0)
            try:
                yield cls(path, file)
            finally:
                if not os.fstat(file.fileno()).st_size:  # nothing was begun
                    path.unlink(missing_ok=True)

    def write(self, event: str, fields: dict[str, Any]) -> None:
        """Append an entry and sync it to disk: the next step may not be undone. Raises UsageError."""
        entry = {"time": datetime.now(timezone.utc).isoformat(timespec="milliseconds"), "event": event, **fields}
        content = b"\n" * self._is_torn + json.dumps(entry).encode() + b"\n"
        try:
            while content:
                content = content[self._file.write(content) :]
                self._is_torn = bool(content)
            os.fsync(self._file)
        except OSError as error:  # for example a full disk
            raise UsageError(f"the log {self.path} cannot be written: {error.strerror}") from None


def _entry(line: bytes) -> dict[str, Any] | None:
    with contextlib.suppress(ValueError):
        entry = json.loads(line)
        if isinstance(entry, dict) and {"time", "event", "terms"} <= entry.keys():
            return entry
    return None
