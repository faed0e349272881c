"""Log of a promotion: JSON lines, each check with its figures and counts, from which a killed promotion goes on."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rlservo.export.contract.errors import UsageError

START, STARTED, CHECK, DECISION, END = "start", "started", "check", "decision", "end"
LARGEST = 256 << 20  # [bytes] beyond which a file is no log of ours

Entry = dict[str, Any]


class PromotionLog:
    """A file that one process at a time appends to."""

    def __init__(self, file: Path, descriptor: int, entries: list[Entry], *, is_torn: bool) -> None:
        self.file = file
        self._descriptor = descriptor
        self._entries = entries
        self._is_torn = is_torn

    @classmethod
    @contextlib.contextmanager
    def open(cls, file: Path) -> Iterator[PromotionLog]:
        """Open a log, made if it is not there. Raises UsageError where it is no log or another process writes it."""
        flags, is_new = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, not file.exists()
        try:
            descriptor = os.open(file, flags, 0o644)
        except OSError as error:
            raise UsageError(f"the log {file} cannot be written: {error.strerror}") from None
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"another 'rlservo policy promote' writes {file}: wait for it, or end it") from None
            entries, is_torn = _read(file, descriptor)
            try:
                yield cls(file, descriptor, entries, is_torn=is_torn)
            finally:
                if is_new and not os.fstat(descriptor).st_size:  # nothing was begun
                    file.unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def write(self, event: str, **fields: Any) -> Entry:
        """Append an entry, and have the disk keep it: what follows may not be undone. Raises UsageError."""
        entry = {"time": datetime.now(timezone.utc).isoformat(timespec="milliseconds"), "event": event, **fields}
        line = json.dumps(entry, allow_nan=False, default=str).encode() + b"\n"
        # A process that was killed may have left half a line.
        content = b"\n" + line if self._is_torn else line
        try:
            while content:
                content = content[os.write(self._descriptor, content) :]
                self._is_torn = bool(content)
        except OSError as error:  # the disk is full, say
            raise UsageError(f"the log {self.file} cannot be written: {error.strerror}") from None
        with contextlib.suppress(OSError):  # a pipe, say
            os.fsync(self._descriptor)
        self._entries.append(entry)
        return entry

    def unfinished(self) -> list[Entry]:
        """Return the entries of the promotion that has not ended; none where there is none."""
        since: list[Entry] = []
        for entry in self._entries:
            if entry["event"] == START:
                since = []
            since.append(entry)
            if entry["event"] == END:
                since = []
        return since if since and since[0]["event"] == START else []


def newest(entries: list[Entry], event: str) -> Entry | None:
    """Return the last entry of a kind."""
    return next((entry for entry in reversed(entries) if entry["event"] == event), None)


def seconds_of(entry: Mapping[str, Any]) -> float:
    """Return when an entry was written, in seconds since 1970. Raises UsageError."""
    try:
        return datetime.fromisoformat(str(entry["time"])).timestamp()
    except ValueError:
        raise UsageError(f"the log has an entry of {str(entry['time'])[:40]!r}, which is no time") from None


def _read(file: Path, descriptor: int) -> tuple[list[Entry], bool]:
    size = os.fstat(descriptor).st_size
    if size > LARGEST:
        raise UsageError(f"{file} is larger than {LARGEST >> 20} MiB: name another --log")
    content = b""
    while len(content) < size and (part := os.pread(descriptor, 1 << 20, len(content))):  # a device has no size
        content += part
    entries = []
    *lines, rest = content.split(b"\n")
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line)
            if not isinstance(entry, dict) or not {"event", "time"} <= entry.keys():
                raise ValueError
        except ValueError:
            if number > 1 and line:  # half a line of a process that was killed, which the next one has ended
                continue
            raise UsageError(f"{file}, line {number}, is none of a promotion's log: name another --log") from None
        entries.append(entry)
    return entries, bool(rest)
