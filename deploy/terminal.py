"""The terminal: standard output and standard error as rich consoles, made when a command first prints.

Importing rich takes as long as everything else that `rlservo --help` needs.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@cache
def output() -> Console:
    """Return the console for results."""
    from rich.console import Console

    return Console()


@cache
def errors() -> Console:
    """Return the console for errors, progress and notes, which a program that reads our output should not see."""
    from rich.console import Console

    return Console(stderr=True)
