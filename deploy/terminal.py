"""The terminal: standard output and standard error as rich consoles, made when a command first prints.

Importing rich takes as long as everything else that `rlservo --help` needs.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import typer

NO_TERMINAL_COLUMNS = 200
SAID_AFTER_S = 10.0
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document for programs.")]

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console


ESCAPES = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
"""Visible forms of control characters, which a bundle's or a policy's names may hold."""


def _console(*, stderr: bool, width: int | None = None) -> Console:
    """Return a console that shows the control characters of what it prints instead of sending them."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class EscapingConsole(Console):
        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else Segment(segment.text.translate(ESCAPES), segment.style)

    return EscapingConsole(stderr=stderr, width=width)


@cache
def output() -> Console:
    """Return the console for results."""
    # Without a terminal rich takes 80 columns, and cuts tables for a reader who has no such limit.
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else NO_TERMINAL_COLUMNS
    return _console(stderr=False, width=width)


@cache
def errors() -> Console:
    """Return the console for errors, progress and notes, which a program that reads our output should not see."""
    return _console(stderr=True)


def show_log() -> None:
    """Print rlservo's own log with the time of each line; of other packages only warnings."""
    logging.basicConfig(format="%(asctime)s %(message)s")
    logging.getLogger("rlservo").setLevel(logging.INFO)


@contextmanager
def status(text: str) -> Iterator[Callable[[str], None]]:
    """Show the current activity until it ends; gives the function that replaces the text.

    On a terminal a line that moves; elsewhere a line when nothing else was said for 10 s, 20 s, 40 s ...
    """
    if errors().is_terminal:
        from rich.live import Live
        from rich.spinner import Spinner
        from rich.text import Text

        spinner = Spinner("dots", Text(text))
        # Text printed meanwhile appears above the line, unless it goes to another stream.
        with Live(spinner, console=errors(), transient=True, redirect_stdout=sys.stdout.isatty()):
            yield lambda text: spinner.update(text=Text(text))
        return
    said, done = [text], threading.Event()

    def repeat() -> None:
        before, wait_s = said[0], SAID_AFTER_S
        while not done.wait(wait_s):
            note(f"{said[0]} ...")
            before, wait_s = said[0], 2 * wait_s if said[0] == before else SAID_AFTER_S

    thread = threading.Thread(target=repeat, name="status", daemon=True)
    thread.start()
    try:
        yield lambda text: said.__setitem__(0, text)
    finally:
        done.set()
        thread.join()


@contextmanager
def ends_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and a closed terminal interrupt the code inside, as Ctrl-C does."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    with _ends_handled_by(interrupt):
        yield


@contextmanager
def ctrl_c_sets(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and a closed terminal set `stop`; a second one interrupts. Only in the main thread.

    An interrupt comes wherever the program happens to be: in a library it may be swallowed, or leave a lock held.
    Code inside must not wait for `stop` in this thread: setting it needs a lock that waiting briefly holds.
    """
    was_asked = False  # not `stop.is_set`: two signals may come together, and this be interrupted by itself

    def set_or_interrupt(_number: int, _frame: object) -> None:
        nonlocal was_asked
        if was_asked:
            raise KeyboardInterrupt
        was_asked = True
        stop.set()

    with _ends_handled_by(set_or_interrupt):
        yield


@contextmanager
def _ends_handled_by(handler: Callable[[int, object], None]) -> Iterator[None]:
    # SIGINT as well: a shell's background job starts with it ignored.
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def writing(place: str | Path) -> Iterator[None]:
    """Name the place in the error of a full or read-only disk, which names no file, or a temporary one."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(place)) from error


def show(line: str) -> None:
    """Print a line of a result as it is, without rich: a server would keep that in memory, 3 MB."""
    print(line.translate(ESCAPES), flush=True)


def note(line: str) -> None:
    """Print a line that a program reading our output should not see, unless the terminal is gone."""
    with suppress(OSError):
        print(line.translate(ESCAPES), file=sys.stderr, flush=True)


def show_command(words: Sequence[str]) -> None:
    """Print a command as a user would type it."""
    line = f"$ rlservo {shlex.join(words)}"
    output().print(line, style="bold", markup=False, highlight=False, soft_wrap=True)


def print_json(document: Any) -> None:
    print(json.dumps(document, indent=2))
