"""Signals that end a program, and the handlers that are there afterwards."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator

import pytest

from rlservo.deploy.terminal import ctrl_c_sets, ends_like_ctrl_c

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def _same_handlers_afterwards() -> Iterator[None]:
    before = [signal.getsignal(number) for number in ENDS]
    yield
    assert [signal.getsignal(number) for number in ENDS] == before


@pytest.mark.parametrize("number", ENDS)
def test_each_interrupts(number: signal.Signals) -> None:
    with pytest.raises(KeyboardInterrupt), ends_like_ctrl_c():
        signal.raise_signal(number)


@pytest.mark.parametrize("number", ENDS)
def test_each_sets_and_the_second_interrupts(number: signal.Signals) -> None:
    stop = threading.Event()
    with ctrl_c_sets(stop):
        signal.raise_signal(number)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_one_that_comes_while_another_is_handled_interrupts() -> None:
    class Interrupted(threading.Event):
        def set(self) -> None:
            signal.raise_signal(signal.SIGTERM)  # before it is set, and while its lock would be held
            super().set()

    stop = Interrupted()
    with ctrl_c_sets(stop), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert not stop.is_set()
