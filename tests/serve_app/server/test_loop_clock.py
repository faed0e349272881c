"""Age of a request: HAProxy's stamp, and an event loop that stood still."""

from __future__ import annotations

import asyncio
import time

import pytest

from rlservo.export.contract.errors import LateError
from rlservo.serve_app.server.loop_clock import SETTLE_S
from rlservo.serve_app.server.request_path import Admission
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.request_stamp import clock_id


def stamp(ago_s: float, whose: str | None = None) -> bytes:
    return f"{(time.time() - ago_s) * 1e3:.0f}-{whose or clock_id()}".encode()


def admission_of(max_queue_ms: float) -> Admission:
    return Admission(ServerSettings(max_ongoing_requests=8, max_queue_ms=max_queue_ms, max_incoming=8, max_streams=8))


def test_a_stamp_of_this_machines_clock_tells_how_long_a_request_waited() -> None:
    admission = admission_of(1000.0)
    assert admission.waited(stamp(2.0)) == pytest.approx(2.0, abs=0.2)
    assert admission.waited(stamp(-5.0)) == 0.0
    with pytest.raises(LateError, match=r"waited 2\.\d s on its way here, longer than 1000 ms"):
        admission.check_age(admission.waited(stamp(2.0)))
    admission.check_age(admission.waited(stamp(0.5)))


@pytest.mark.parametrize(
    "value", [b"", b"-", b"x-y", b"1e3-" + clock_id().encode(), b"9" * 400 + b"-" + clock_id().encode()]
)
def test_a_stamp_of_another_clock_or_of_nobodys_says_nothing(value: bytes) -> None:
    admission = admission_of(1000.0)
    assert admission.waited(value) is None
    assert admission.waited(stamp(9.0, "another-machine")) is None
    assert admission.waited(None) is None


def test_what_is_read_after_a_loop_stood_still_is_refused_and_what_comes_later_is_not() -> None:
    async def run() -> None:
        admission = admission_of(300.0)
        admission.loop_clock.start()
        await asyncio.sleep(0.1)
        admission.enter()
        time.sleep(0.5)
        for _ in range(3):  # before the loop's clock has ticked, and after
            with pytest.raises(LateError, match="stood still for longer than 300 ms"):
                admission.enter()
            await asyncio.sleep(0)
        admission.enter(0.0)  # its stamp says that it came just now
        with pytest.raises(LateError):
            admission.enter(0.4)
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
        admission.check_age(None)  # nor one whose clock does not run
        admission.loop_clock.start()
        for _ in range(10):
            await asyncio.sleep(0.03)
            admission.check_age(None)

    asyncio.run(run())
