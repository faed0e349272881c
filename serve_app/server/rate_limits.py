"""Rate limits of API keys: a bucket of tokens per key's label, on this replica alone."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from rlservo.export.contract.errors import RateLimitError
from rlservo.serve_app.server.api_keys import Key, RateLimit


class RateLimits:
    """Remaining requests of each key with a limit. Keys without one are never seen here."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}  # by label: tokens, and when there were so many
        self.refused: Counter[str] = Counter()
        """Requests refused, by label."""

    def spend(self, key: Key, limit: RateLimit) -> None:
        """Count a request of a key. Raises RateLimitError if it has asked too often."""
        now = self._clock()
        tokens, since = self._buckets.get(key.label, (float(limit.burst), now))
        tokens = min(float(limit.burst), tokens + (now - since) * limit.rate)
        if tokens < 1.0:
            self._buckets[key.label] = tokens, now
            self.refused[key.label] += 1
            wait_s = (1.0 - tokens) / limit.rate
            raise RateLimitError(
                f"the key '{key.label}' may ask {limit.rate:g} times a second here, {limit.burst} times at once: wait "
                f"{wait_s:.3g} s",
                {"retry_after_s": round(wait_s, 3)},
                key=key.label,
            )
        self._buckets[key.label] = tokens - 1.0, now
