"""Event loops that stay awake for a moment after a reply."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import pytest

from rlservo.serve_app.ray_serve import busy_polling
from rlservo.serve_app.ray_serve.busy_polling import MOST_SKIPPED, BusyPolling
from rlservo.serve_app.ray_serve.joined_writes import turn


class Loop:
    """Calls back when it is told to, as an event loop does in its next turn."""

    def __init__(self) -> None:
        self.next: list[Any] = []

    def call_soon(self, callback: Any) -> None:
        self.next.append(callback)

    def take_turn(self) -> bool:
        """Return whether something was to be called: otherwise the loop sleeps."""
        now, self.next = self.next, []
        for callback in now:
            callback()
        return bool(now)


@pytest.fixture
def loop() -> Loop:
    return Loop()


@pytest.fixture
def polling(loop: Loop) -> BusyPolling:
    return BusyPolling(loop)  # type: ignore[arg-type]


def begins(loop: Loop, polling: BusyPolling) -> bool:
    """Whether the loop is awake after this reply, to which no request comes."""
    polling.begin()
    was_awake = False
    while loop.take_turn():
        was_awake = True
    return was_awake


def test_the_loop_is_awake_until_a_request_comes(
    loop: Loop, polling: BusyPolling, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(busy_polling, "AWAKE_S", 3600.0)
    polling.begin()
    assert all(loop.take_turn() for _ in range(100))
    polling.note_answer()
    assert loop.take_turn() and not loop.take_turn()


def test_the_loop_sleeps_when_nothing_has_come_in_time(loop: Loop, polling: BusyPolling) -> None:
    assert begins(loop, polling)
    assert not loop.take_turn()


def test_a_moment_for_nothing_is_tried_ever_more_rarely(
    loop: Loop, polling: BusyPolling, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(busy_polling, "AWAKE_S", 0.0)
    tried = [number for number in range(400) if begins(loop, polling)]
    assert [after - before - 1 for before, after in itertools.pairwise(tried)] == [
        *(1, 3, 7, 15, 31, 63),
        *[MOST_SKIPPED] * 4,
    ]


def test_one_that_paid_is_followed_by_the_next(
    loop: Loop, polling: BusyPolling, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(busy_polling, "AWAKE_S", 0.0)
    assert [begins(loop, polling) for _ in range(3)] == [True, False, True]  # and three would be skipped now
    monkeypatch.setattr(busy_polling, "AWAKE_S", 3600.0)
    for _ in range(3):
        polling.begin()
    for _ in range(5):
        polling.begin()
        assert loop.take_turn()
        polling.note_answer()
        assert loop.take_turn() and not loop.take_turn()


def test_only_a_client_that_asked_before_keeps_the_loop_awake(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    monkeypatch.setattr(BusyPolling, "begin", lambda _: begun.append("begun"))

    async def after(*connections: str) -> int:
        """How often it was begun by the end of a turn with replies on these connections."""
        begun.clear()
        for connection in connections:
            turn.count(connection)
        await asyncio.sleep(0)
        return len(begun)

    async def turns() -> list[int]:
        return [await after(*each) for each in ("a", "a", "a", "b", "a", "a", "ab", "aa", "a")]

    assert asyncio.run(turns()) == [0, 1, 1, 0, 0, 1, 0, 0, 1]
