"""API keys in use: each process rereads their file while the server runs, and limits their rate by itself.

The file is read twice a second in a thread of its own: a file system that hangs must not delay actions. Its whole
content is compared, so it does not matter how it was changed: written in place, renamed over, or behind the symbolic
links that Kubernetes swaps. Content with which a server would not start changes nothing, and is logged once.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rlservo.export.contract.errors import RateLimitError, UsageError
from rlservo.serve_app.server.api_keys import Key, Keys, RateLimit, read_key_file
from rlservo.serve_app.server.settings import ServerSettings

logger = logging.getLogger(__name__)

PERIOD_S = 0.5  # [s] between reads; content is used once two in a row agree, as one may catch a half-written file
STALE_S = 10.0  # [s] without an answer from the file system until the keys count as outdated
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


class CurrentKeys:
    """`Keys` that follow their file while this object exists."""

    def __init__(self, settings: ServerSettings) -> None:
        """Read the keys that the settings name, as `Keys.from_settings` does. Raises UsageError."""
        self._settings = settings
        file = settings.api_keys_file
        content = None if file is None else read_key_file(Path(file))
        self.accepted = Keys.from_settings(settings, file_content=content)
        """The keys that are accepted now: another object after every change."""
        self.limits = RateLimits()
        self._seen: bytes | str | None = content  # or the reason why it could not be read
        self._used: bytes | str | None = content
        self._is_refused = False
        self._looked_at = time.monotonic()
        if file is not None:
            watcher = threading.Thread(target=_watch, args=(weakref.ref(self),), name="key-file", daemon=True)
            watcher.start()

    @property
    def current(self) -> bool:
        """Whether these are the file's current keys; False if the file cannot be used or read."""
        if self._settings.api_keys_file is None:
            return True
        return not self._is_refused and time.monotonic() - self._looked_at < STALE_S

    def refresh(self) -> None:
        """Read the file; use its content once two reads in a row have seen the same."""
        assert self._settings.api_keys_file is not None
        seen: bytes | str
        try:
            seen = read_key_file(Path(self._settings.api_keys_file))
        except UsageError as error:
            seen = error.message
        before, self._seen, self._looked_at = self._seen, seen, time.monotonic()
        if seen != before or seen == self._used:
            return
        self._used = seen
        try:
            if isinstance(seen, str):
                raise UsageError(seen)
            keys = Keys.from_settings(self._settings, file_content=seen)
        except UsageError as error:
            self._is_refused = True
            logger.error("the API keys were not changed: %s", error.message)
            return
        if self._is_refused or keys != self.accepted:
            logger.warning("the API keys were reread: %s", _difference(self.accepted, keys))
        self._is_refused = False
        if keys != self.accepted:
            self.accepted = keys


def _watch(reference: weakref.ref[CurrentKeys]) -> None:
    while True:
        time.sleep(PERIOD_S)
        keys = reference()
        if keys is None:
            return
        try:
            keys.refresh()
        except Exception:
            logger.exception("the API key file cannot be read; the keys were not changed")
        del keys


def _difference(before: Keys, after: Keys) -> str:
    added = [f"'{key.label}' added" for key in after.keys if key not in before.keys]
    removed = [f"'{key.label}' removed" for key in before.keys if key not in after.keys]
    return ", ".join(added + removed) or "nothing changed"
