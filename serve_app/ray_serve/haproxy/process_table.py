"""Linux's process table, read from /proc: the wrapper runs without psutil."""

from __future__ import annotations

import contextlib
from pathlib import Path

PROC = Path("/proc")


def process_ids() -> list[int]:
    return [int(entry.name) for entry in PROC.iterdir() if entry.name.isdigit()]


def is_running(pid: int) -> bool:
    return (PROC / str(pid)).exists()


def parent_of(pid: int) -> int:
    """Return a process's parent, 0 where there is no such process."""
    with contextlib.suppress(OSError):
        return int((PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[1])
    return 0


def command_of(pid: int) -> list[bytes]:
    """Return a process's command line, one empty word where there is no such process."""
    with contextlib.suppress(OSError):
        return (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
    return [b""]


def find_haproxies(binary: str, file: Path) -> list[int]:
    """Return the HAProxies that run with this configuration."""

    def runs_it(words: list[bytes]) -> bool:
        return words[0] == binary.encode() and str(file).encode() in words

    return [pid for pid in process_ids() if runs_it(command_of(pid))]


def has_controller(raylet: int) -> bool:
    """Whether Serve's controller runs under this raylet, that is on this node."""
    children = (pid for pid in process_ids() if parent_of(pid) == raylet)
    return any(command_of(pid)[0].startswith(b"ray::ServeController") for pid in children)
