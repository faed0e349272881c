"""Log of a launch's first process: bounded, and searched for its last fault when the server ends."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

SERVER_LOG = "server.log"
LOG_BYTES = 4 << 20  # [bytes] of this log, and of each log of Ray's
KEPT_BYTES = 4096  # of a log that is cut
# In Python's and Ray's logs: a level, an exception's last line, a raylet's end.
FAULT = re.compile(
    r"^(?:\[.*\] *)?(?:ERROR|CRITICAL|FATAL)\b|^\w[\w.]*(?:Error|Exception)\b|\bC? *Check failed\b|terminated\b"
)
COLOURS = re.compile(r"\x1b\[[\d;]*m")


def cut_log(file: Path, max_bytes: int = LOG_BYTES) -> None:
    """Empty a log that has grown beyond its bound, but for its last lines; whoever writes it appends."""
    with contextlib.suppress(OSError):
        if file.stat().st_size <= max_bytes:
            return
        with file.open("rb+") as log:
            log.seek(-KEPT_BYTES, os.SEEK_END)
            kept = log.read().partition(b"\n")[2]
            log.truncate(0)
        with file.open("ab") as log:
            log.write(kept)


def last_fault(file: Path) -> str:
    """Return a sentence with the last line that tells of a fault; most lines tell of what went well."""
    with contextlib.suppress(OSError):
        faults = [line.strip() for line in file.read_text(errors="replace").splitlines() if FAULT.search(line)]
        if faults:
            return f"its log says: {COLOURS.sub('', faults[-1])[:500]}"
    return "its log tells of no fault"


def error_line(error: Exception) -> str:
    """Return the line of an error that says what went wrong."""
    return last_line(str(error)) or type(error).__name__


def last_line(text: str) -> str:
    """Return a text's last line: Ray puts the remote traceback before it."""
    return text.strip().rpartition("\n")[2].strip()[:500]
