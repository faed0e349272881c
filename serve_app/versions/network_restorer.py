"""Networks that were dropped from memory, opened again in threads while the event loop goes on; each once for all."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from rlservo.export.contract.errors import NetworkAwayError, UnavailableError
from rlservo.serve_app.runtime.network_memory import DroppableNetwork
from rlservo.serve_app.versions.blocking_calls import BlockingCalls

MOST = 64
"""Networks that are being opened or wait for it, at once."""


class NetworkRestorer:
    """Opens networks again for the requests of one event loop."""

    def __init__(self) -> None:
        self._calls = BlockingCalls()
        self._tasks: dict[DroppableNetwork, asyncio.Task[Any]] = {}

    async def restore(self, network: DroppableNetwork, patience_s: float) -> None:
        """Return when the network is in memory.

        Raises NetworkAwayError; after `patience_s`, when the opening goes on, too. Raises UnavailableError where too
        many others come first.
        """
        task = self._tasks.get(network)
        if task is None:
            if len(self._tasks) >= MOST:  # nobody's turn comes after hundreds that nobody waits for any more
                raise UnavailableError(f"{network.what} is not in memory (network_bytes), and {MOST} others come first")
            # Where files hang its thread does, however long anybody waits: one for a network is enough.
            opened = self._calls.run(network.restore, timeout_s=None, what=f"opening {network.what} again")
            task = self._tasks[network] = asyncio.create_task(opened)
            task.add_done_callback(partial(self._end, network))
        done, _ = await asyncio.wait([task], timeout=patience_s)
        if not done:
            raise NetworkAwayError(
                f"{network.what} was not in memory (network_bytes), and is being opened again: try again shortly"
            )
        task.result()

    def _end(self, network: DroppableNetwork, task: asyncio.Task[Any]) -> None:
        del self._tasks[network]
        if not task.cancelled():
            task.exception()  # who waited has it; if nobody did any more, asyncio would complain
