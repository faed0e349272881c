"""Records and replicas of a cluster, for sessions by id: Ray's key-value store (the GCS), and calls between replicas.

The GCS is one process that answers one request after the other, so a read sees what was written before. With Redis
behind it, it reads and writes there: keep Redis from forgetting (`appendonly yes`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import ray
from ray.exceptions import ActorDiedError

from rlservo.serve_app.ray_serve.gcs_ledger import NAMESPACE
from rlservo.serve_app.ray_serve.ray_parts import GCS_CLIENT, PICKLE, REPLICA_ID, REQUEST_METADATA, find

TIMEOUT_S = 2.0  # [s] for the store: a client waits


class GcsRecords:
    """Records under the name of one deployment of one Serve instance."""

    def __init__(self, serve_instance: str, application: str, deployment: str) -> None:
        self._prefix = f"{serve_instance}/{application}/{deployment}/session/"
        self._client: Any = find(GCS_CLIENT)()
        self._namespace = NAMESPACE.encode()

    async def get(self, key: str) -> bytes | None:
        """Return a record; None where there is none."""
        found: bytes | None = await self._within(self._client.async_internal_kv_get(self._key(key), self._namespace))
        return found

    async def put(self, key: str, value: bytes) -> None:
        """Write a record over any other."""
        await self._within(self._client.async_internal_kv_put(self._key(key), value, True, self._namespace))

    async def create(self, key: str, value: bytes) -> bool:
        """Write a record where there is none; return False where there is one."""
        put = self._client.async_internal_kv_put(self._key(key), value, False, self._namespace)
        return bool(await self._within(put))

    async def delete(self, key: str) -> None:
        """Delete a record; nothing happens where there is none."""
        await self._within(self._client.async_internal_kv_del(self._key(key), False, self._namespace))

    async def keys(self) -> list[str]:
        """Return the keys of all records."""
        found = await self._within(self._client.async_internal_kv_keys(self._prefix.encode(), self._namespace))
        return [key.decode().removeprefix(self._prefix) for key in found]

    def _key(self, key: str) -> bytes:
        return f"{self._prefix}{key}".encode()

    async def _within(self, future: Awaitable[Any]) -> Any:
        try:
            return await asyncio.wait_for(asyncio.ensure_future(future), TIMEOUT_S)
        except asyncio.TimeoutError:
            raise TimeoutError(f"Ray's key-value store did not answer within {TIMEOUT_S:g} s") from None


class ReplicaPeers:
    """The other replicas of a deployment, called as actors: past Serve's router, which chooses one by itself."""

    def __init__(self, deployment: Any, method: str, running: Callable[[], Awaitable[Sequence[str]]]) -> None:
        """`method` of a replica answers; `running` returns which replicas there are."""
        self._deployment = deployment
        self._running = running
        self._actors: dict[str, Any] = {}
        metadata = find(REQUEST_METADATA)
        self._metadata = find(PICKLE)(
            metadata(request_id="", internal_request_id="", call_method=method, app_name=deployment.app_name)
        )

    async def call(self, replica: str, method: str, *arguments: Any) -> Any:
        """Call a method of another replica. Raises ProcessLookupError where it has ended."""
        try:
            actor: Any = self._actors.get(replica)
            if actor is None:
                name = find(REPLICA_ID)(replica, self._deployment).to_full_id_str()
                actor = await asyncio.to_thread(ray.get_actor, name, "serve")
                self._actors[replica] = actor
            return await actor.handle_request.remote(self._metadata, method, *arguments)
        except (ValueError, ActorDiedError):
            self._actors.pop(replica, None)
            raise ProcessLookupError(f"the replica {replica} has ended") from None

    async def running(self) -> Sequence[str]:
        """Return the replicas that take requests, as Serve's controller last told."""
        return await self._running()
