"""API keys in use: each process rereads their file while the server runs.

The file's whole content is compared, so it does not matter how it was changed: written in place, renamed over, or
behind the symbolic links that Kubernetes swaps. Content with which a server would not start changes nothing, and is
logged once.
"""

from __future__ import annotations

import logging
from pathlib import Path

from rlservo.errors import UnavailableError, UsageError
from rlservo.serve_app.server.api_keys import Keys, read_key_file
from rlservo.serve_app.server.rate_limits import RateLimits
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.blocking_calls import BlockingCalls

logger = logging.getLogger(__name__)

PERIOD_S = 0.5  # [s] between reads; content is used once two in a row agree, as one may catch a half-written file
READ_S = 5.0  # [s] for one read; after two without an answer from the file system the keys count as outdated


class CurrentKeys:
    """`Keys` that follow their file as long as `refresh` is called."""

    def __init__(self, settings: ServerSettings) -> None:
        """Read the keys that the settings name, as `Keys.from_settings` does. Raises UsageError."""
        self._settings = settings
        self.accepted = Keys.from_settings(settings)
        """The keys that are accepted now: another object after every change."""
        self.current = True
        """Whether these are the file's current keys; False if the file cannot be used or read."""
        self.limits = RateLimits()
        self._calls = BlockingCalls(READ_S)
        self._seen: bytes | str | None = None  # the file's content, or the reason why it could not be read
        self._used: bytes | str | None = None

    async def refresh(self) -> None:
        """Read the file; use its content once two reads in a row agree."""
        assert self._settings.api_keys_file is not None
        file, before = Path(self._settings.api_keys_file), self._seen
        try:
            self._seen = await self._calls.run("reading the API keys", read_key_file, file)
        except UsageError as error:
            self._seen = error.message
        except UnavailableError:
            self._seen = f"{file} could not be read within {READ_S:g} s: does the file system hang?"
        if self._seen != before or self._seen == self._used:
            return
        self._used = self._seen
        try:
            if isinstance(self._seen, str):
                raise UsageError(self._seen)
            keys = Keys.from_settings(self._settings, file_content=self._seen)
        except UsageError as error:
            self.current = False
            logger.error("the API keys were not changed: %s", error.message)
            return
        if not self.current or keys != self.accepted:
            logger.warning("the API keys were reread: %s", _difference(self.accepted, keys))
        self.current, self.accepted = True, keys


def _difference(before: Keys, after: Keys) -> str:
    added = [f"'{key.label}' added" for key in after.keys if key not in before.keys]
    removed = [f"'{key.label}' removed" for key in before.keys if key not in after.keys]
    return ", ".join(added + removed) or "nothing changed"
