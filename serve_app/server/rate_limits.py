"""Rate limits of API keys, which each process enforces by itself."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from rlservo.errors import RateLimitError
from rlservo.serve_app.server.api_keys import Key, RateLimit

ROUNDING_S = 1e-6


class RateLimits:
    """Remaining requests of each key with a limit. Keys without a limit are not tracked."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._rested_at: dict[str, float] = {}  # by label: when a whole burst may come again
        self.refused: Counter[str] = Counter()
        """Requests refused, by label."""

    def spend(self, key: Key, limit: RateLimit) -> None:
        """Count a request of a key. Raises RateLimitError beyond its limit."""
        now = self._clock()
        rested_at = max(now, self._rested_at.get(key.label, now))
        wait_s = rested_at - now - (limit.burst - 1) / limit.rate
        if wait_s > ROUNDING_S:
            self.refused[key.label] += 1
            raise RateLimitError(
                f"the key '{key.label}' allows {limit.rate:g} requests a second in this process, {limit.burst} at "
                f"once: wait {wait_s:.3g} s",
                {"retry_after_s": round(wait_s, 3)},
                key=key.label,
            )
        self._rested_at[key.label] = rested_at + 1.0 / limit.rate
