"""Background tasks of a server end with it."""

from __future__ import annotations

import asyncio
import contextlib

from rlservo.serve_app.engines.serving import cancel_all


def test_a_task_that_loses_a_cancellation_is_cancelled_again() -> None:
    async def run() -> int:
        lost = 0

        async def poll() -> None:
            nonlocal lost
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.sleep(60)
            lost += 1
            await asyncio.sleep(60)

        task = asyncio.create_task(poll())
        await asyncio.sleep(0)
        await asyncio.wait_for(cancel_all([task]), 30)
        assert task.cancelled()
        return lost

    assert asyncio.run(run()) == 1
