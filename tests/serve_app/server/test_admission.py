"""Requests that may have waited while the event loop was blocked."""

from __future__ import annotations

import asyncio
import time

import pytest

from rlservo.errors import LateError
from rlservo.serve_app.server.load_shedding import SETTLE_S, LoadShedding
from rlservo.serve_app.server.settings import ServerSettings


def admission_of(max_queue_ms: float) -> LoadShedding:
    return LoadShedding(
        ServerSettings(max_ongoing_requests=8, max_queue_ms=max_queue_ms, max_incoming=8, max_streams=8)
    )


def test_what_is_read_after_a_loop_stood_still_is_refused_and_what_comes_later_is_not() -> None:
    async def run() -> None:
        admission = admission_of(300.0)
        admission.start_clock()
        await asyncio.sleep(0.1)
        admission.enter()
        time.sleep(0.5)
        for _ in range(3):  # before the loop's clock has ticked, and after
            with pytest.raises(LateError, match="was blocked for more than 300 ms"):
                admission.enter()
            await asyncio.sleep(0)
        deadline = time.monotonic() + 20
        await asyncio.sleep(SETTLE_S)
        while True:
            try:
                admission.enter()
                break
            except LateError:
                assert time.monotonic() < deadline
                await asyncio.sleep(0.05)

    asyncio.run(run())


def test_a_loop_that_turns_refuses_nobody() -> None:
    async def run() -> None:
        admission = admission_of(5000.0)
        admission.check_age()  # nor one whose clock does not run
        admission.start_clock()
        for _ in range(10):
            await asyncio.sleep(0.03)
            admission.check_age()

    asyncio.run(run())
