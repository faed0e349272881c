"""The command line `rlservo` for tests: in a process of its own, or in this one.

A process takes half a second of processor time to start, and ten times that if it imports RLlib: a separate process is
used for what only a process does, and once for each kind of command.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rlservo.deploy import cli, terminal


def rlservo(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line as a user does."""
    command = [sys.executable, "-m", "rlservo.deploy.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=cwd)


def rlservo_here(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line in this process."""
    command = ["rlservo", *map(str, words)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.chdir(cwd or os.curdir),
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", command)
        for console in (terminal.output, terminal.errors):
            console.cache_clear()
        try:
            cli.main()
        except SystemExit as end:
            assert end.code is None or isinstance(end.code, int)
            code = end.code or 0
        finally:
            for console in (terminal.output, terminal.errors):
                console.cache_clear()  # they write to `out` and `err`
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())
