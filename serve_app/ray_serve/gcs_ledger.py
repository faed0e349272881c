"""Ledger of plans in Ray's own key-value store (the GCS), shared by all replicas.

It lives as long as the cluster does: a replica, the controller or the proxy may die and come back. Writing under a
number fails when it is in use, which is all the agreement between replicas that is needed.
"""

from __future__ import annotations

from rlservo.serve_app.ray_serve.ray_parts import KEY_VALUE_STORE, find

NAMESPACE = "rlservo"
KEPT = 50  # plans; the newest alone is read

# Ray has no public interface to the store.
_internal_kv_get, _internal_kv_put, _internal_kv_list, _internal_kv_del = (
    find(f"{KEY_VALUE_STORE}:_internal_kv_{verb}") for verb in ("get", "put", "list", "del")
)


class GcsLedger:
    """Numbered documents under the name of one deployment of one Serve instance."""

    def __init__(self, serve_instance: str, application: str, deployment: str) -> None:
        """A Serve instance that is shut down takes its ledger's name along: the next one starts from its file."""
        self._prefix = f"{serve_instance}/{application}/{deployment}/plan/"  # beside `session/` (replica_peers.py)

    def newest(self) -> int:
        """Return the highest number, 0 when there is none."""
        return max(self._numbers(), default=0)

    def fetch(self, generation: int) -> bytes | None:
        """Return a document; None when it is not there (any more)."""
        content: bytes | None = _internal_kv_get(self._key(generation), namespace=NAMESPACE)
        return content

    def append(self, generation: int, content: bytes) -> bool:
        """Write a document under a number that is free; return False when it is not."""
        existed = _internal_kv_put(self._key(generation), content, overwrite=False, namespace=NAMESPACE)
        if existed:
            return False
        for number in self._numbers():
            if number <= generation - KEPT:
                _internal_kv_del(self._key(number), namespace=NAMESPACE)
        return True

    def _key(self, generation: int) -> str:
        return f"{self._prefix}{generation:012d}"

    def _numbers(self) -> list[int]:
        keys = _internal_kv_list(self._prefix, namespace=NAMESPACE)
        return [int(key.decode().rpartition("/")[2]) for key in keys]
