"""One decision within its limits, for every protocol: policies loaded, deadline, batch size, episode.

The protocols (`json_act.py`, `oip_infer.py`, `websocket_stream.py`) read bytes and write bytes; what lies between is
here, once: whether the policies are loaded, the deadline, the batch limit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from rlservo.export.contract.errors import (
    DeadlineError,
    LateError,
    RlservoError,
    TooLargeError,
    UnavailableError,
    UnknownPolicyError,
)
from rlservo.export.contract.spaces import DictSpec, SpaceSpec, TupleSpec
from rlservo.serve_app.episodes.episodes import Episode, Episodes
from rlservo.serve_app.episodes.sessions import Session, SessionId
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.admission import Admission
from rlservo.serve_app.server.api_key_file import CurrentKeys
from rlservo.serve_app.server.api_keys import Guard
from rlservo.serve_app.server.request_log import RequestLog
from rlservo.serve_app.server.request_metrics import Metrics
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore
from rlservo.serve_app.versions.replica_versions import ReplicaVersions
from rlservo.serve_app.versions.shadow import Shadows

StoreProvider = Callable[[], PolicyStore | None]


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
        self.guard = Guard(self.keys)
        self.metrics = Metrics(replica)
        self.metrics.sources.append(partial(self.shadows.families, replica))
        self.log = RequestLog(settings)
        self.admission = Admission(
            max_queued=settings.max_ongoing_requests,
            max_queue_ms=settings.max_queue_ms,
            max_incoming=settings.max_incoming,
            max_streams=settings.max_streams,
        )
        self.episodes = Episodes(max_sessions=settings.max_sessions, idle_s=settings.session_idle_s, alone=alone)

    def store(self) -> PolicyStore:
        """Return the policies. Raises UnavailableError while they are being loaded."""
        store = self._store_provider()
        if store is None:
            raise UnavailableError("the policies are still being loaded: try again shortly")
        return store

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

    async def act(
        self,
        name: str,
        version: str | None,
        obs: Any,
        *,
        received: float,
        explore: bool = False,
        seed: int | None = None,
        seq: int | None = None,
        deadline_ms: float | None = None,
        episode: Episode | None = None,
        stream: Session | None = None,
        session: str | None = None,
    ) -> Decision:
        """Decide for `obs`, unless `deadline_ms` have passed since `received` (`time.perf_counter`).

        `episode` is what the request says of its episode, `stream` the session of the stream it came on. All requests
        of a `session` get the same version where a canary runs.

        Raises DeadlineError, LateError, TooLargeError, UnavailableError and what `PolicyStore.act` raises.
        """
        store = self.store()
        in_time = None if deadline_ms is None else partial(_check_deadline, deadline_ms, received, seq)
        if in_time is not None:
            in_time()
        if _rows(obs) > self.settings.max_batch:
            space = store.get(name, version).contract.observation_space
            rows = _batch(space, obs)
            if rows > self.settings.max_batch:
                raise TooLargeError(f"a batch of {rows} observations is too large: at most {self.settings.max_batch}")
        if episode is None and stream is None:
            if store.batches and not explore:
                check = partial(_check_wait, time.perf_counter(), self.admission.age.limit_s, in_time)
                decision = await store.act_together(name, version, obs, session=session, check=check)
            else:
                decision = store.act(name, version, obs, explore=explore, seed=seed, session=session)
        else:
            decision = self.episodes.act(
                store,
                name,
                version,
                obs,
                episode or NO_EPISODE,
                stream=stream,
                explore=explore,
                seed=seed,
                seq=seq,
                session=session,
            )
        shadow = store.shadow(name)
        if shadow is not None and decision.version == shadow.of and not explore:
            self.shadows.offer(shadow, obs, decision)
        return decision

    def failed(self, protocol: str, name: str, version: str | None, code: str) -> None:
        """Count a request that got no action; names that are not loaded are not told apart."""
        store = self._store_provider()
        if store is None or name not in store.names:
            name = version = ""
        else:  # an alias is counted as the version it leads to, no version as the default
            version = store.default(name) if version is None else store.version_of(name, version)
        self.metrics.failed(protocol, name, version, code)

    def kept_out(self, protocol: str, error: RlservoError, request_id: str | None, *, peer: str | None) -> None:
        """Count and log a request that was refused before anybody looked at it, and the address it came from."""
        self.metrics.failed(protocol, "", "", error.code)
        self.log.failed(protocol, "", None, error.code, error.message, request_id=request_id, peer=peer)

    def policies(self) -> Iterator[tuple[str, str, Policy]]:
        """Yield (name, version, policy) of all that are loaded."""
        store = self._store_provider()
        if store is not None:
            for name in store.names:
                for version in store.versions(name):
                    yield name, version, store.get(name, version)

    def exposition(self) -> bytes:
        """Return the metrics as Prometheus reads them."""
        store = self._store_provider()
        versions: dict[str, tuple[str, ...]] = {}
        for name in store.names if store is not None else ():
            assert store is not None
            default = store.default(name)
            versions[name] = (*(version for version in store.versions(name) if version != default), default)
        return self.metrics.exposition(versions)


NO_EPISODE = Episode()


def _check_wait(since: float, limit_s: float, in_time: Callable[[], None] | None) -> None:
    """Look again at an observation that was gathered for a batch, and waited for those before it."""
    if time.perf_counter() - since > limit_s:
        raise LateError(f"the observation waited longer than {limit_s * 1e3:g} ms for its batch: send a newer one")
    if in_time is not None:
        in_time()


def _check_deadline(deadline_ms: float, received: float, seq: int | None) -> None:
    late_ms = (time.perf_counter() - received) * 1e3
    if late_ms >= deadline_ms:
        raise DeadlineError(
            f"the deadline of {deadline_ms:g} ms passed before the policy was asked: nothing computed",
            {"deadline_ms": deadline_ms, "elapsed_ms": round(late_ms, 3), "seq": seq},
        )


def _batch(space: SpaceSpec, obs: Any) -> int:
    """Return how many observations a large `obs` holds; an array as long as the space's own is one."""
    if isinstance(space, DictSpec | TupleSpec):
        if isinstance(space, DictSpec) and type(obs) is list:
            return len(obs)  # of single observations
        inside = space.spaces.items() if isinstance(space, DictSpec) else enumerate(space.spaces)
        parts = obs if type(obs) in (dict, list, tuple) else {}
        found: dict[Any, Any] = dict(parts) if type(parts) is dict else dict(enumerate(parts))
        return max((_batch(child, found[key]) for key, child in inside if key in found), default=0)
    if type(obs) is dict:  # element names and values
        return max((_length(value) for value in obs.values()), default=0)
    rows = _length(obs)
    return rows if rows != (space.shape or (0,))[0] else 1


def _length(value: Any) -> int:
    if type(value) is np.ndarray:
        return len(value) if value.ndim else 0
    return len(value) if type(value) in (list, tuple) else 0


def _rows(obs: Any) -> int:
    """Return how many observations there are at most, whatever the space is: `_batch` looks closer at large ones."""
    most, parts = 0, [obs]
    while parts:
        part = parts.pop()
        if type(part) is dict:
            parts += part.values()
        else:
            most = max(most, _length(part))
            if type(part) in (list, tuple) and part and type(part[0]) in (dict, list, tuple, np.ndarray):
                parts.append(part[0])  # the parts of a Tuple are of one batch
    return most
