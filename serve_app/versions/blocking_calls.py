"""Calls into a file system that may never return, in threads that can be given up.

A network file system that is gone blocks every caller that opens, reads or even looks at a file, and nothing can
interrupt that. So each such call runs in a thread of its own, with a time-out. A thread that was given up ends when the
file system returns, or with the process. Their number is limited.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeVar

from rlservo.errors import UnavailableError

logger = logging.getLogger(__name__)

SILENCE_S = 10.0  # [s] after which a waiting call is logged
LIMIT = 4  # threads at once, including those that were given up

Result = TypeVar("Result")


class BlockingCalls:
    """Runs functions in threads that can be given up after `timeout_s`."""

    def __init__(self, timeout_s: float, limit: int = LIMIT) -> None:
        self._timeout_s = timeout_s
        self._free = threading.Semaphore(limit)

    async def run(self, what: str, function: Callable[..., Result], *arguments: Any) -> Result:
        """Return what the function returns, as `wait` does."""
        return await self.wait(what, self.start(function, *arguments))

    def start(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Call a function if a thread is free in time; it runs to its end even if no caller waits."""
        outcome: Future[Result] = Future()
        outcome.set_running_or_notify_cancel()  # it cannot be cancelled

        def call() -> None:
            if not self._free.acquire(timeout=self._timeout_s):
                outcome.set_exception(UnavailableError("could not start: other calls wait for the file system"))
                return
            try:
                settle: Callable[[], None] = partial(outcome.set_result, function(*arguments))
            except BaseException as error:
                settle = partial(outcome.set_exception, error)
            self._free.release()
            settle()

        # A daemon thread, so that the process can end while it is stuck.
        threading.Thread(target=call, name="policies", daemon=True).start()
        return outcome

    async def wait(self, what: str, outcome: Future[Result]) -> Result:
        """Return a call's result; raise what it raises, and UnavailableError when it takes too long.

        `what` names the activity in the error.
        """
        left_s = self._timeout_s
        returned = asyncio.wrap_future(outcome)
        try:
            while left_s > 0:
                done, _ = await asyncio.wait([returned], timeout=min(SILENCE_S, left_s))
                if done:
                    return returned.result()
                left_s -= SILENCE_S
                if left_s > 0:
                    logger.warning("%s has taken %.0f s so far", what, self._timeout_s - left_s)
        finally:
            returned.cancel()  # if it has not returned, its result is no longer wanted
        took = f"{what} took longer than {self._timeout_s:g} s"
        raise UnavailableError(f"{took} and was given up: check the disk, or the network to the storage")
