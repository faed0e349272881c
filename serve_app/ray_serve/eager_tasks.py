"""Coroutines that begin to run at once, in the turn of the event loop that makes them."""

from __future__ import annotations

import asyncio
import functools
import sys
import types
from collections.abc import Callable, Coroutine, Generator
from typing import Any


def start_at_once(coroutine: Coroutine[Any, Any, None], loop: asyncio.AbstractEventLoop) -> asyncio.Task[None] | None:
    """Run a coroutine until it waits for the first time; return the task that goes on with it, None where it is over.

    Most answers never wait, and then cost no task, no turn of the loop and no callback. Python 3.12 has tasks that
    begin so; before, up to there it is in no task (`asyncio.current_task`).
    """
    if sys.version_info >= (3, 12):
        task = asyncio.Task(coroutine, loop=loop, eager_start=True)
        return None if task.done() else task
    try:
        waits_for = coroutine.send(None)
    except StopIteration:
        return None
    rest: Any = _go_on(coroutine, waits_for)  # a coroutine for asyncio, and a generator by its type
    return loop.create_task(rest)


@types.coroutine
def _go_on(coroutine: Coroutine[Any, Any, None], waits_for: Any) -> Generator[Any, Any, None]:
    """Wait for what a coroutine waits for, and pass on to it what comes of that."""
    resume: Callable[[], Any]
    while True:
        try:
            resume = functools.partial(coroutine.send, (yield waits_for))
        except BaseException as error:
            resume = functools.partial(coroutine.throw, error)
        try:
            waits_for = resume()
        except StopIteration:
            return
