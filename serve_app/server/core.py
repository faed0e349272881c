"""Parts of the server that all protocols share: policies, keys, admission, episodes, metrics, log.

`RequestPath` answers requests with them; what describes the server (`listing.py`, `gauges.py`) reads them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rlservo.export.contract.errors import UnknownPolicyError
from rlservo.serve_app.episodes.episodes import Episodes
from rlservo.serve_app.episodes.sessions import SessionId
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_key_file import CurrentKeys
from rlservo.serve_app.server.request_checks import Authorizer
from rlservo.serve_app.server.request_log import RequestLog
from rlservo.serve_app.server.request_metrics import Metrics
from rlservo.serve_app.server.request_path import Admission, RequestPath, StoreProvider
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from rlservo.serve_app.versions.replica_versions import ReplicaVersions
from rlservo.serve_app.versions.shadow import Shadows


class Core:
    """The policies as the protocols see them; `store_provider` gives None for as long as they are being loaded."""

    def __init__(
        self,
        store_provider: StoreProvider,
        settings: ServerSettings,
        *,
        replica: str = "",
        control: ReplicaVersions | None = None,
        alone: Callable[[], bool] = lambda: True,
    ) -> None:
        """Read the keys that `settings` name; `replica` names this process in the metrics. Raises UsageError.

        With a `control` what is served can change while the server runs. `alone` says whether every request comes to
        this process, as sessions by id need.
        """
        self._store_provider = store_provider
        self.control = control
        self.replica = replica
        self.is_alone = alone
        self.shadows = Shadows()
        self.settings = settings
        self.keys = CurrentKeys(settings)
        self.authorizer = Authorizer(self.keys)
        self.metrics = Metrics()
        self.log = RequestLog(settings)
        self.admission = Admission(
            max_queued=settings.max_ongoing_requests,
            max_queue_ms=settings.max_queue_ms,
            max_incoming=settings.max_incoming,
            max_streams=settings.max_streams,
        )
        self.episodes = Episodes(max_sessions=settings.max_sessions, idle_s=settings.session_idle_s, alone=alone)
        self.request_path = RequestPath(
            store_provider,
            settings,
            admission=self.admission,
            episodes=self.episodes,
            metrics=self.metrics,
            log=self.log,
            shadows=self.shadows,
        )

    def store(self) -> PolicyStore:
        """Return the policies. Raises UnavailableError while they are being loaded."""
        return self.request_path.store()

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

    def policy(
        self, name: str, version: str | None, session_id: SessionId | None = None, identity: Any = None
    ) -> Policy:
        """Return the policy that a request's tensors are for: of the session, or of the state of that identity.

        Whatever the default is meanwhile. Raises UnavailableError, UnknownPolicyError.
        """
        return self.episodes.policy_of(self.store(), name, version, session_id, identity)

    def policies(self) -> Iterator[tuple[str, str, Policy]]:
        """Yield (name, version, policy) of all that are loaded."""
        store = self._store_provider()
        if store is not None:
            for name in store.names:
                for version in store.versions(name):
                    yield name, version, store.get(name, version)
