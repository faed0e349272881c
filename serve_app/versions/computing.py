"""Versions whose actions a process is computing, in a file that outlives the process.

A graph can end its process (a trap of the processor, too little memory), which then logs nothing itself. So a worker
writes down what it computes; its supervisor, or the replica that takes its place, logs what a dead one left there.
"""

from __future__ import annotations

import mmap
from pathlib import Path

import psutil

SUFFIX = ".computing"
ROWS, ROW_BYTES = 8, 256  # computations at once: the event loop, the shadow's thread, and those that load

_rows: mmap.mmap | None = None  # of this process; without them nothing is written
_free = list(range(ROWS))


def write_to(folder: Path) -> None:
    """Write what this process computes to a file in `folder` from now on; its path names the process."""
    global _rows
    process = psutil.Process()
    with Path(folder, f"{process.pid}-{process.create_time()}{SUFFIX}").open("w+b") as file:
        file.truncate(ROWS * ROW_BYTES)
        _rows = mmap.mmap(file.fileno(), 0)


class Computing:
    """A context in which this thread computes a version of a policy."""

    __slots__ = ("_name", "_row", "_version")

    def __init__(self, name: str, version: str) -> None:
        self._name, self._version, self._row = name, version, -1

    def __enter__(self) -> None:
        if _rows is not None:
            try:
                self._row = row = _free.pop()
            except IndexError:  # further computations are not written
                return
            text = f"version {self._version} of policy '{self._name}'".encode().ljust(ROW_BYTES, b"\0")[:ROW_BYTES]
            _rows[row * ROW_BYTES : (row + 1) * ROW_BYTES] = text

    def __exit__(self, *_error: object) -> None:
        if _rows is not None and self._row >= 0:
            _rows[self._row * ROW_BYTES] = 0  # an empty text
            _free.append(self._row)


def left_by_dead(folder: Path) -> dict[int, list[str]]:
    """Return what each dead process was computing, by its id, and remove its file: each is returned to one caller."""
    left = {}
    for file in folder.glob(f"*{SUFFIX}"):
        pid, began = file.name.removesuffix(SUFFIX).split("-")
        try:
            if psutil.Process(int(pid)).create_time() == float(began):
                continue
        except psutil.NoSuchProcess:
            pass
        try:
            rows = file.read_bytes()
            file.unlink()
        except OSError:  # another process was faster
            continue
        texts = [rows[start : start + ROW_BYTES].partition(b"\0")[0] for start in range(0, len(rows), ROW_BYTES)]
        left[int(pid)] = sorted({text.decode(errors="replace") for text in texts if text})
    return left
