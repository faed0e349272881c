"""Stamp that HAProxy sets on every request: when it came, by whose clock, and from whom; no two have the same one.

A request that HAProxy sends again, since a replica died, keeps its own.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

STAMP = "x-rlservo-received"
"""The header: [ms since 1970] when HAProxy had the request, by whose clock, the port that its client has, a draw."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # the same in two processes that read the same clock


def clock_id() -> str:
    """Return whose clock this process reads: that of the kernel it runs on."""
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return "unknown"


def stamp_format(when: str) -> str:
    """Return the stamp as HAProxy's configuration has it; `when` is a number or HAProxy's expression for one."""
    return f"{when}-{clock_id()}-%[src_port]-%[rand]"


def client_of(stamp: bytes) -> bytes:
    """Return what is the same in the stamps of all requests of one connection to HAProxy, and not in another's."""
    return stamp.rsplit(b"-", 2)[-2:][0]
