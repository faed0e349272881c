"""Processes of a launch: find and end every marked one, say how one ended, remove the folder they used.

Every process of a launch inherits one environment variable with the launch's own mark, and the session of the launch's
first process, so that whatever is left of it can be found and ended whatever became of its parents. It takes both:
Ray's workers write their title over the memory that held their environment, and whoever wants to may leave a session.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import time
from pathlib import Path

import psutil

MARK = "RLSERVO_LAUNCH"
QUIET_S = 0.3  # without any marked process, before the last of them counts as gone


def find_marked(mark: str, session: int | None = None) -> list[int]:
    """Return the living processes, other than this one, that carry the launch's mark or belong to its session."""
    found = []
    for process in psutil.process_iter():
        # What is not ours is not shown; a zombie is gone but for its parent's notice.
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if process.pid == os.getpid() or process.status() == psutil.STATUS_ZOMBIE:
                continue
            if process.environ().get(MARK) == mark or os.getsid(process.pid) == session:
                found.append(process.pid)
    return found


def end_marked(mark: str, session: int | None = None, *, timeout_s: float = 10.0) -> list[int]:
    """Kill what `find_marked` finds, and what that starts meanwhile; return what would not go."""
    deadline = time.monotonic() + timeout_s
    quiet_since: float | None = None
    while time.monotonic() < deadline:
        left = find_marked(mark, session)
        for pid in left:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        # One empty result proves nothing: in the middle of an exec a process shows no environment at all.
        if left:
            quiet_since = None
        elif quiet_since is None:
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since >= QUIET_S:
            return []
        time.sleep(0.05)
    return find_marked(mark, session)


def describe_end(returncode: int | None) -> str:
    """Return how a process ended, as the end of a sentence about it; negative is a signal, as `subprocess` has it."""
    if returncode is None:
        return "ended"
    if returncode >= 0:
        return f"ended with exit status {returncode}"
    with contextlib.suppress(ValueError):
        return f"was ended by {signal.Signals(-returncode).name}"
    return f"was ended by signal {-returncode}"


def remove_folder(folder: Path, *, timeout_s: float = 5.0) -> None:
    """Remove a folder that processes just ended, or another cleaner, may be touching a last time."""
    deadline = time.monotonic() + timeout_s
    while folder.exists() and time.monotonic() < deadline:
        shutil.rmtree(folder, ignore_errors=True)
        if folder.exists():
            time.sleep(0.05)
