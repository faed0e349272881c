"""Event loops that stay awake for a moment after a reply."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
import uvloop

from rlservo.serve_app.ray_serve import busy_polling
from rlservo.serve_app.ray_serve.busy_polling import MOST_SKIPPED, BusyPolling

FOR_EVER = 3600.0
TURNS = 4  # of the event loop, in which a moment of no length is over


@pytest.fixture(params=["asyncio", "uvloop"])
def run(request: pytest.FixtureRequest) -> Callable[[Coroutine[Any, Any, Any]], Any]:
    """Run a coroutine in an event loop of its own."""
    return asyncio.run if request.param == "asyncio" else uvloop.run


class Client:
    """A connection that is one client's."""

    def client_id(self) -> object:
        return id(self)


CLIENT = Client()


class Counted(BusyPolling):
    """Counts how often the loop was kept awake."""

    def __init__(self) -> None:
        super().__init__(asyncio.get_running_loop())
        self.polls = 0

    def _poll(self) -> None:
        self.polls += 1
        super()._poll()

    async def has_begun(self, *connections: Client) -> bool:
        """Whether the loop was kept awake after a turn with replies on these connections, in moments of no length."""
        before = self.polls
        for connection in connections:
            self.note_reply(connection)
        for _ in range(TURNS):
            await asyncio.sleep(0)
        return self.polls > before


@pytest.fixture
def awake_s(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    return lambda seconds: monkeypatch.setattr(busy_polling, "AWAKE_S", seconds)


def test_the_loop_stays_awake_until_a_request_is_answered(run: Any, awake_s: Callable[[float], None]) -> None:
    async def turns() -> None:
        polling = Counted()
        for _ in range(2):
            polling.note_reply(CLIENT)
            await asyncio.sleep(0.02)
        assert polling.polls > 20
        awake_s(0.0)
        polling.note_reply(CLIENT)  # the request has come; after this reply it is looked for once more, in vain
        await asyncio.sleep(0.02)
        over = polling.polls
        await asyncio.sleep(0.02)
        assert polling.polls == over

    awake_s(FOR_EVER)
    run(turns())


def test_the_loop_sleeps_when_nothing_has_come_in_time(run: Any, awake_s: Callable[[float], None]) -> None:
    async def turns() -> None:
        polling = Counted()
        for _ in range(2):
            polling.note_reply(CLIENT)
            await asyncio.sleep(0)
        await asyncio.sleep(0.05)
        over = polling.polls
        assert over > 0
        await asyncio.sleep(0.02)
        assert polling.polls == over

    awake_s(0.01)
    run(turns())


def test_a_moment_for_nothing_is_tried_ever_more_rarely(run: Any, awake_s: Callable[[float], None]) -> None:
    async def turns() -> list[bool]:
        polling = Counted()
        await polling.has_begun(CLIENT)
        return [await polling.has_begun(CLIENT) for _ in range(400)]

    awake_s(0.0)
    tried = [number for number, has_begun in enumerate(run(turns())) if has_begun]
    skipped = [after - before - 1 for before, after in itertools.pairwise(tried)]
    assert skipped == [1, 3, 7, 15, 31, 63, *[MOST_SKIPPED] * 4]


def test_each_that_paid_halves_what_is_skipped_after_the_next_failure(
    run: Any, awake_s: Callable[[float], None]
) -> None:
    async def turns() -> list[bool]:
        polling = Counted()
        await polling.has_begun(CLIENT)
        for _ in range(1 + 1 + 1 + 3 + 1):  # three failures with what is skipped between them
            await polling.has_begun(CLIENT)
        awake_s(FOR_EVER)
        for _ in range(7):  # which the third has skipped
            assert not await polling.has_begun(CLIENT)
        for _ in range(3):  # 7, 3, 1 and 0
            assert await polling.has_begun(CLIENT)
        awake_s(0.0)
        await polling.has_begun(CLIENT)
        return [await polling.has_begun(CLIENT) for _ in range(3)]

    awake_s(0.0)
    assert run(turns()) == [False, True, False]


def test_only_a_client_that_had_the_reply_before_keeps_the_loop_awake(
    run: Any, awake_s: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = Client(), Client()

    async def turns() -> list[bool]:
        polling = Counted()
        each = ((a,), (a,), (a,), (b,), (a,), (a,), (a, b), (a, a), (a,))
        return [await polling.has_begun(*connections) for connections in each]

    awake_s(0.0)
    monkeypatch.setattr(busy_polling, "MOST_SKIPPED", 0)
    assert run(turns()) == [False, True, True, False, False, True, False, False, True]


def test_a_request_of_another_client_is_none_that_it_was_awake_for(run: Any, awake_s: Callable[[float], None]) -> None:
    a, b = Client(), Client()

    async def turns() -> list[bool]:
        polling = Counted()
        await polling.has_begun(a)
        begun = [await polling.has_begun(a)]
        awake_s(0.0)
        begun += [await polling.has_begun(*connections) for connections in ((b,), (b,), (b,))]
        return begun

    awake_s(FOR_EVER)
    assert run(turns()) == [True, True, False, True]  # awake still as b is answered; then one is skipped
