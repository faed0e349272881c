"""The terminal: standard output and standard error as rich consoles, made when a command first prints.

Importing rich takes as long as everything else that `rlservo --help` needs.
"""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document for programs.")]

if TYPE_CHECKING:
    from rich.console import Console


ESCAPES = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
"""Control characters, which a bundle's or a policy's names may hold, as they are shown."""


def _console(*, stderr: bool) -> Console:
    """Return a console that shows the control characters of what it prints instead of sending them."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class EscapingConsole(Console):
        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else Segment(segment.text.translate(ESCAPES), segment.style)

    return EscapingConsole(stderr=stderr)


@cache
def output() -> Console:
    """Return the console for results."""
    return _console(stderr=False)


@cache
def errors() -> Console:
    """Return the console for errors, progress and notes, which a program that reads our output should not see."""
    return _console(stderr=True)


@contextmanager
def ends_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and a closed terminal interrupt what runs inside too, as Ctrl-C does."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    with _ends_handled_by(interrupt):
        yield


@contextmanager
def ctrl_c_sets(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and a closed terminal set `stop`; a second one interrupts. Only in the main thread.

    An interrupt comes wherever the program happens to be: in a library it may be swallowed, or leave a lock held.
    Nobody inside may wait for `stop` in this thread: to set it takes a lock that waiting holds for moments.
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


def note(line: str) -> None:
    """Print a line that a program reading our output should not see."""
    errors().print(line, style="dim", markup=False, highlight=False, soft_wrap=True)


def print_json(document: Any) -> None:
    print(json.dumps(document, indent=2))
