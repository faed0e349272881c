"""Log of a promotion: JSON lines, each check with its figures and counts, from which a killed promotion continues."""

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

START, CHECK, DECISION, END = "start", "check", "decision", "end"


class PromotionLog:
    """A file that one process at a time appends to."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Read the promotion that has not ended. Raises UsageError for another kind of file."""
        self.path = path
        self.entries: dict[str, dict[str, Any]] = {}  # the newest of each event, of the promotion that has not ended
        self._file = file
        *lines, torn = file.read().split(b"\n")
        self._is_torn = bool(torn)  # by a process that was killed while it wrote
        for number, line in enumerate(lines):
            try:
                entry = json.loads(line)
                self._add({**entry, "seconds": datetime.fromisoformat(entry["time"]).timestamp()})
            except (ValueError, KeyError, TypeError):
                if not number:
                    raise UsageError(f"{path} is not a promotion's log: name another --log") from None

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

    def write(self, event: str, **fields: Any) -> None:
        """Append an entry and sync it to disk: the next step may not be undone. Raises UsageError."""
        now = datetime.now(timezone.utc)
        entry = {"time": now.isoformat(timespec="milliseconds"), "event": event, **fields}
        content = b"\n" * self._is_torn + json.dumps(entry).encode() + b"\n"
        try:
            while content:
                content = content[self._file.write(content) :]
                self._is_torn = bool(content)
            os.fsync(self._file)
        except OSError as error:  # for example a full disk
            raise UsageError(f"the log {self.path} cannot be written: {error.strerror}") from None
        self._add({**entry, "seconds": now.timestamp()})

    def _add(self, entry: dict[str, Any]) -> None:
        if entry["event"] in (START, END):
            self.entries.clear()
        if entry["event"] == START or self.entries:
            self.entries[entry["event"]] = entry
