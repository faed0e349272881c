"""Loading of versions in threads with a time-out, each version once for all who wait for it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from typing import Any, TypeVar

from rlservo.export.contract.errors import UnavailableError
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.loaded_policies import Loadable, LoadedPolicies, LoadedPolicy
from rlservo.serve_app.versions.plan import ServedConfig

Result = TypeVar("Result")


class VersionLoader:
    """Loads and proves versions while the event loop goes on, also where a file system hangs."""

    def __init__(self, policies: LoadedPolicies, *, scan_timeout_s: float, load_timeout_s: float) -> None:
        """`scan_timeout_s` is for one look through the repository, `load_timeout_s` for one version."""
        self.policies = policies
        self._scan_timeout_s = scan_timeout_s
        self._load_timeout_s = load_timeout_s
        self._calls = BlockingCalls()
        self._tasks: dict[Loadable, asyncio.Task[LoadedPolicy]] = {}
        self._timed_out: dict[Loadable, UnavailableError] = {}

    @property
    def loading(self) -> set[tuple[str, str]]:
        """Name and version of what is being loaded."""
        return {(name, version) for name, version, _ in self._tasks}

    async def available(self, config: ServedConfig) -> dict[str, dict[str, str]]:
        """Return every bundle's hash by name and version, as `Repository.available`. Raises UnavailableError, too."""
        return await self._look(self.policies.repository.available, config)

    async def find_digest(self, name: str, version: str | None) -> tuple[str, str]:
        """Return (version, hash) of a bundle, as `Repository.find_digest`. Raises UnavailableError, too."""
        return await self._look(self.policies.repository.find_digest, name, version)

    async def load(self, name: str, version: str, digest: str, *, again: bool = True) -> LoadedPolicy:
        """Load a version unless it is in memory; not `again`: one that timed out is not waited for another time.

        Raises what `LoadedPolicies.load` raises, and UnavailableError when it takes too long.
        """
        loaded = self.policies.get(name, version, digest)
        if loaded is not None:
            return loaded
        key = (name, version, digest)
        if key in self._timed_out and not again:
            raise self._timed_out[key]
        task = self._tasks.get(key)
        if task is None:  # whoever else wants it meanwhile waits for the same
            task = self._tasks[key] = asyncio.create_task(self._load(key))
            task.add_done_callback(lambda done: self._end(key, done))
        return await asyncio.shield(task)

    def forget_others(self, keys: Collection[Loadable]) -> None:
        """Forget the time-outs of versions that are no longer wanted."""
        self._timed_out = {key: error for key, error in self._timed_out.items() if key in keys}

    async def _look(self, function: Callable[..., Result], *arguments: Any) -> Result:
        what = "looking through the policies' folders"
        return await self._calls.run(function, *arguments, timeout_s=self._scan_timeout_s, what=what)

    async def _load(self, key: Loadable) -> LoadedPolicy:
        what = f"loading policy '{key[0]}' version {key[1]}"
        try:
            loaded = await self._calls.run(self.policies.load, *key, timeout_s=self._load_timeout_s, what=what)
        except UnavailableError as error:
            self._timed_out[key] = error
            raise
        self._timed_out.pop(key, None)
        return loaded

    def _end(self, key: Loadable, done: asyncio.Task[LoadedPolicy]) -> None:
        del self._tasks[key]
        if not done.cancelled():
            done.exception()  # who waited has it; if nobody did any more, asyncio would complain
