"""A record that one process writes and another reads, without waiting for each other."""

from __future__ import annotations

import mmap
import os
from typing import Any

import numpy as np

TRIES = 1000


def make_file(layout: np.dtype[Any]) -> int:
    """Return a descriptor of memory for a record; it is freed with its last process."""
    descriptor = os.memfd_create("rlservo-arm", 0)
    os.ftruncate(descriptor, 8 + layout.itemsize)
    return descriptor


class SharedBlock:
    """A record with one writer. A reader always sees one complete write.

    A counter precedes it, odd while the record is being written. x86 preserves the order of stores.
    """

    def __init__(self, descriptor: int, layout: np.dtype[Any]) -> None:
        memory = mmap.mmap(descriptor, 8 + layout.itemsize)
        self._counter = np.frombuffer(memory, np.float64, 1)
        self._record = np.frombuffer(memory, layout, 1, offset=8)

    def write(self, values: dict[str, Any]) -> None:
        """Replace fields of the record. Only one process may write."""
        self._counter[0] += 1.0
        for name, value in values.items():
            self._record[name][0] = value
        self._counter[0] += 1.0

    def read(self) -> Any:
        """Return a copy of the newest record (its fields by name); if the writer died, its partial write."""
        record = self._record.copy()
        for _ in range(TRIES):
            before = self._counter[0]
            record = self._record.copy()
            if before == self._counter[0] and not before % 2:
                break
        return record[0]
