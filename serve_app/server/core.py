"""Core of the server, which all protocols share: the request path, the API keys, and what is served.

What describes the server (`listing.py`, `sampled_metrics.py`) reads it.
"""

from __future__ import annotations

from collections.abc import Iterator

from rlservo.export.contract.errors import UnknownPolicyError
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_key_file import CurrentKeys
from rlservo.serve_app.server.request_path import RequestPath, StoreProvider
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.replica_versions import ReplicaVersions


class Core(RequestPath):
    """The request path with what protocols ask of the server beside it; `store_provider` as there."""

    def __init__(
        self,
        store_provider: StoreProvider,
        settings: ServerSettings,
        *,
        replica: str = "",
        control: ReplicaVersions | None = None,
        is_alone: bool = True,
    ) -> None:
        """Read the keys that `settings` name; `replica` names this process in the metrics. Raises UsageError.

        With a `control` what is served can change while the server runs.
        """
        super().__init__(store_provider, settings, replica, is_alone=is_alone)
        self.control = control
        self.replica = replica
        self.keys = CurrentKeys(settings)
        if settings.record is not None:
            from rlservo.serve_app.server.request_recorder import RequestRecorder  # which needs an extra

            self.recorder = RequestRecorder(settings)
            self.episodes.marks_states = True

    async def close(self) -> None:
        """Close connections to other services."""
        if self.episodes.store is not None:
            await self.episodes.store.close()

    @property
    def ready(self) -> bool:
        """Whether the policies are loaded."""
        return self._store_provider() is not None

    def has(self, name: str, version: str | None = None) -> bool:
        """Whether a policy, in this version or under this alias, is loaded."""
        store = self._store_provider()
        try:
            return store is not None and bool(store.get(name, version))
        except UnknownPolicyError:
            return False

    def policies(self) -> Iterator[tuple[str, str, Policy]]:
        """Yield (name, version, policy) of all that are loaded."""
        store = self._store_provider()
        if store is not None:
            for name in store.names:
                for version in store.versions(name):
                    yield name, version, store.get(name, version)
