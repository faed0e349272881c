"""Coroutines that are started at once: over by then, or carried on by a task."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from rlservo.serve_app.ray_serve.eager_tasks import start_at_once


def run(scenario: Callable[[asyncio.AbstractEventLoop], Coroutine[Any, Any, None]]) -> None:
    async def main() -> None:
        await scenario(asyncio.get_running_loop())

    asyncio.run(main())


def test_one_that_waits_for_nothing_is_over_at_once() -> None:
    async def scenario(loop: asyncio.AbstractEventLoop) -> None:
        seen: list[int] = []

        async def inner() -> int:
            return 1

        async def answer() -> None:
            seen.append(await inner())

        assert start_at_once(answer(), loop) is None and seen == [1]

    run(scenario)


def test_one_that_waits_goes_on_in_a_task_with_what_it_waited_for() -> None:
    async def scenario(loop: asyncio.AbstractEventLoop) -> None:
        seen: list[Any] = []
        future = loop.create_future()

        async def answer() -> None:
            seen.append(await future)
            await asyncio.sleep(0)
            seen.append(await asyncio.wait_for(asyncio.sleep(0.001, "slept"), 10))
            with pytest.raises(KeyError):
                await failing
            seen.append(asyncio.current_task())

        failing = loop.create_future()
        failing.set_exception(KeyError("x"))
        task = start_at_once(answer(), loop)
        assert task is not None and seen == []
        loop.call_soon(future.set_result, "given")
        await task
        assert seen == ["given", "slept", task]

    run(scenario)


def test_one_that_waits_can_be_cancelled_and_fails_as_its_task() -> None:
    async def scenario(loop: asyncio.AbstractEventLoop) -> None:
        seen: list[str] = []

        async def answer() -> None:
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                seen.append("cancelled")
                raise

        async def fail() -> None:
            await asyncio.sleep(0)
            raise ValueError("no")

        task = start_at_once(answer(), loop)
        assert task is not None
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert seen == ["cancelled"]
        failed = start_at_once(fail(), loop)
        assert failed is not None
        with pytest.raises(ValueError, match="no"):
            await failed

    run(scenario)
