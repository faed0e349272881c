"""Stamp that HAProxy sets on every request: when it came, and by whose clock; no two requests have the same one.

A request that HAProxy sends again, since a replica died, keeps its own.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

STAMP = "x-rlservo-received"  # the header: [ms since 1970] when HAProxy had the request, by whose clock, a draw
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # the same in two processes that read the same clock


def clock_id() -> str:
    """Return whose clock this process reads: that of the kernel it runs on."""
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return "unknown"
