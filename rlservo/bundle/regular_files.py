"""Bounded reading of regular files, and of nothing else.

Anyone who can write to a folder that a server reads can put a FIFO, a device or an endless file there: opening the
first blocks, opening the second may do something, reading the third fills the memory.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

BLOCK = 1 << 20  # [bytes]


class NotReadableError(OSError):
    """A file of a kind that is not read; `str()` is the reason, to follow the file's name."""

    def __str__(self) -> str:
        return str(self.args[0])


class FileTooLargeError(NotReadableError):
    """A file that is larger than its limit."""


@contextmanager
def open_regular(file: Path, max_bytes: int | None = None) -> Iterator[BinaryIO]:
    """Open a regular file, or a symbolic link to one, for reading.

    Raises NotReadableError when it is something else, FileTooLargeError beyond `max_bytes`, and OSError.
    """
    _check(file.stat(), max_bytes)  # before opening: opening a device can do something
    # It may have been swapped for a FIFO since: without O_NONBLOCK, opening one waits for its writer.
    descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb", buffering=0) as stream:
        _check(os.fstat(stream.fileno()), max_bytes)
        yield stream


def blocks(stream: BinaryIO, max_bytes: int | None = None) -> Iterator[bytes]:
    """Yield the rest of a file. Raises FileTooLargeError when it is longer than `max_bytes`, and OSError."""
    length = 0
    for block in iter(lambda: stream.read(BLOCK), b""):
        length += len(block)
        if max_bytes is not None and length > max_bytes:
            raise FileTooLargeError(f"is larger than {max_bytes:,} bytes")
        yield block


def _check(status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise NotReadableError(f"is {_kind(status.st_mode)}, not a regular file")
    if max_bytes is not None and status.st_size > max_bytes:
        raise FileTooLargeError(f"is larger than {max_bytes:,} bytes: it has {status.st_size:,}")


def _kind(mode: int) -> str:
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISFIFO, "a FIFO"),
        (stat.S_ISSOCK, "a socket"),
        (stat.S_ISCHR, "a device"),
        (stat.S_ISBLK, "a device"),
    )
    return next((name for is_kind, name in kinds if is_kind(mode)), "something else")
