"""Calls into a file system that may never return, in threads that can be given up.

A network file system that is gone blocks whoever opens, reads or even looks at a file, and nothing can interrupt that.
So such a call runs in a thread of its own, for which nobody waits longer than a time-out; a thread that was given up
ends when the file system comes back, or with the process. There are never more than a few of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, TimeoutError
from typing import Any, TypeVar

from rlservo.export.contract.errors import UnavailableError

LIMIT = 4  # threads at once, those that were given up included
POLL_S = 0.05  # [s] between looks for a thread that has become free

Result = TypeVar("Result")


class BlockingCalls:
    """Runs functions in threads that can be given up."""

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._threads: set[threading.Thread] = set()

    async def run(self, function: Callable[..., Result], *arguments: Any, timeout_s: float, what: str) -> Result:
        """Return what the function returns; raise what it raises, and UnavailableError when it takes too long.

        `what` says in the error what was being done.
        """
        deadline = time.monotonic() + timeout_s
        while self._running() >= self._limit:
            if time.monotonic() > deadline:
                raise UnavailableError(
                    f"{what} could not begin within {timeout_s:g} s: {self._limit} earlier calls have not come back "
                    "from the file system"
                )
            await asyncio.sleep(POLL_S)
        loop = asyncio.get_running_loop()
        returned: asyncio.Future[None] = loop.create_future()

        def wake() -> None:
            if not returned.done():
                returned.set_result(None)

        def wake_loop(_future: Future[Result]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended: nobody waits
                loop.call_soon_threadsafe(wake)

        future = self._start(function, arguments)
        future.add_done_callback(wake_loop)
        try:
            await asyncio.wait_for(returned, deadline - time.monotonic())
        except asyncio.TimeoutError:
            raise _timeout_error(what, timeout_s) from None
        return future.result()

    def wait(self, function: Callable[..., Result], *arguments: Any, timeout_s: float, what: str) -> Result:
        """Do as `run` where there is no event loop."""
        future = self._start(function, arguments)
        try:
            return future.result(timeout_s)
        except TimeoutError:
            if future.done():  # the function's own
                raise
            raise _timeout_error(what, timeout_s) from None

    def _running(self) -> int:
        self._threads = {thread for thread in self._threads if thread.is_alive()}
        return len(self._threads)

    def _start(self, function: Callable[..., Result], arguments: tuple[Any, ...]) -> Future[Result]:
        future: Future[Result] = Future()

        def call() -> None:
            try:
                result = function(*arguments)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        # A daemon: the process can end while the thread is stuck.
        thread = threading.Thread(target=call, name="policies", daemon=True)
        thread.start()
        self._threads.add(thread)
        return future


def _timeout_error(what: str, timeout_s: float) -> UnavailableError:
    return UnavailableError(f"{what} took longer than {timeout_s:g} s and was given up: does the file system hang?")
