"""Age of a request when this process reads it: time in a proxy, in the kernel, in a process that stood still.

Two measures. HAProxy stamps what it passes on with the time it came, which is exact where both read the same clock: on
one machine. And a clock in the event loop tells when the loop stood still (a stopped process, a long computation, a
starved machine): what is read right after that has waited for an unknown time, up to all of it. That is for what
carries no stamp: frames of streams, and clients that ask a replica directly.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Iterable
from pathlib import Path

from rlservo.export.contract.errors import LateError

logger = logging.getLogger(__name__)

STAMP = "x-rlservo-received"  # [ms since 1970] when HAProxy had the request, and on which machine's clock
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # the same in two processes that read the same clock

TICK_S = 0.05
SETTLE_S = 0.1  # of a loop that turns again, in which it reads what had waited
LEAST_S = 0.01  # a wait that counts against a deadline: stamps are milliseconds, and so is the way from the proxy
STAMP_HEADER = STAMP.encode()


def clock() -> str:
    """Return whose clock this process reads: that of the kernel it runs on."""
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return "unknown"


class Age:
    """Knows how old a request may be, and refuses those that have waited longer."""

    def __init__(self, limit_s: float) -> None:
        """Refuse what has waited for longer than `limit_s`."""
        self.limit_s = limit_s
        self._clock = clock().encode()
        self._due = float("inf")  # when the loop's clock ticks next; it does not run yet
        self._unknown_until = 0.0
        self._loop: asyncio.AbstractEventLoop | None = None

    def watch(self) -> None:
        """Watch the running event loop from now on."""
        self._loop = asyncio.get_running_loop()
        self._due = time.perf_counter()
        self._tick()

    def waited(self, headers: Iterable[tuple[bytes, bytes]]) -> float | None:
        """Return how long [s] ago HAProxy had a request with these headers, if it says so, and by our clock."""
        for name, value in headers:
            if name == STAMP_HEADER:
                since, _, whose = value.partition(b"-")
                if whose != self._clock or not since.isdigit() or len(since) > 15:
                    return None
                return max(0.0, time.time() - int(since) / 1e3)
        return None

    def check(self, waited: float | None = None) -> None:
        """Raise LateError for a request that had `waited` too long; or, where that is unknown, may have."""
        if waited is not None:
            if waited > self.limit_s:
                raise LateError(
                    f"the observation waited {waited:.1f} s on its way here, longer than {self.limit_s * 1e3:g} ms: "
                    "send a newer one"
                )
            return
        now = time.perf_counter()
        if now < self._unknown_until or now - self._due > self.limit_s:
            raise LateError(
                f"this replica stood still for longer than {self.limit_s * 1e3:g} ms, and the observation may be as "
                "old: send a newer one"
            )

    def _tick(self) -> None:
        now = time.perf_counter()
        behind = now - self._due
        if behind > self.limit_s:
            logger.warning("the event loop stood still for %.1f s: what waited for it meanwhile is refused", behind)
            self._unknown_until = now + SETTLE_S
        elif now < self._unknown_until and behind > TICK_S:  # still reading
            self._unknown_until = now + SETTLE_S
        self._due = now + TICK_S
        assert self._loop is not None
        self._loop.call_later(TICK_S, self._tick)
