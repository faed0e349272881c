"""The terminal: progress of long operations, and the signals that end a program."""

from __future__ import annotations

import io
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

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


WAITING = """
import time
from rlservo.deploy import terminal
terminal.SAID_AFTER_S = 0.1
with terminal.status("counting") as show:
    time.sleep(0.5)
    print("a result")
    show("1 of [2] episodes")
    time.sleep(0.5)
print("the end")
"""


def test_waiting_is_a_few_lines_on_standard_error_where_there_is_no_terminal() -> None:
    done = subprocess.run([sys.executable, "-c", WAITING], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "a result\nthe end\n")
    assert done.stderr.splitlines()[0] == "counting ..."
    assert "1 of [2] episodes ..." in done.stderr and len(done.stderr.splitlines()) <= 5


def test_waiting_is_a_line_that_goes_away_on_a_terminal_and_leaves_results_where_they_go(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with (tmp_path / "out").open("w") as out:
        done = subprocess.run(
            [sys.executable, "-c", WAITING], stdout=out, stderr=theirs, timeout=60, env={**os.environ, "TERM": "xterm"}
        )
    os.close(theirs)
    shown = os.read(ours, 65536).decode()
    os.close(ours)
    assert done.returncode == 0
    assert (tmp_path / "out").read_text() == "a result\nthe end\n"
    assert "counting" in shown and "1 of [2] episodes" in shown and "a result" not in shown


def test_list_of_policies_is_whole_at_80_columns() -> None:
    from rich.console import Console

    from rlservo.deploy.commands.policy import table_of

    version = {
        "version": "12", "state": "serving", "aliases": ["production", "candidate"],
        "loaded_at": "2026-11-26T09:58:15Z", "requests": 1234567, "reason": "the golden vectors differ by 0.003",
    }  # fmt: skip
    name = "mir100_obstacle_avoidance_waiting"
    replica = {
        "replica": "abcdef", "generation": 3, "changed_by": "test",
        "policies": [{"name": name, "version_states": [version]}],
    }  # fmt: skip
    out = io.StringIO()
    Console(width=80, file=out).print(table_of(replica))
    columns = zip(
        *(line.split("\u2502")[1:-1] for line in out.getvalue().splitlines() if "\u2502" in line), strict=True
    )
    cells = ["".join(part.strip() for part in column) for column in columns]
    assert cells[:3] == [name, "12", "serving"]
    assert cells[3:6] == ["production,candidate", "2026-11-2609:58:15", "1234567"]
