"""Processes of a server as the machine sees them: who belongs to it, CPU time, memory.

Reads /proc (Linux).
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
MARK = "RLSERVO_BENCHMARK"  # in the environment of every process started here, so that none can be left unnoticed
REPLICA, PROXY, OTHER = "replica", "proxy", "other"


@dataclass(frozen=True)
class Process:
    """A process as /proc shows it."""

    pid: int
    parent: int
    session: int
    command: str
    cpu_s: float

    @property
    def role(self) -> str:
        """Whether it answers requests, passes them on, or does something else."""
        if self.command.startswith("ray::ServeReplica"):
            return REPLICA
        if "haproxy" in self.command.split(" ")[0] or self.command.startswith("ray::ProxyActor"):
            return PROXY
        return OTHER


def processes() -> dict[int, Process]:
    """Return every living process of the machine."""
    found: dict[int, Process] = {}
    for entry in PROC.glob("[0-9]*"):
        with suppress(OSError, IndexError, ValueError):  # gone meanwhile
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
            if fields[0] == "Z":  # ended; whoever started it has not looked yet
                continue
            pid = int(entry.name)
            found[pid] = Process(
                pid, int(fields[1]), int(fields[3]), command, (int(fields[11]) + int(fields[12])) * TICK_S
            )
    return found


def family(root: int, mark: str) -> dict[int, Process]:
    """Return the processes of a server: descendants of `root`, its sessions, and whatever carries `mark`.

    All three are needed: Ray's workers write their titles over their environments, and proxies outlive their parents.
    """
    everyone = processes()
    needle = f"{MARK}={mark}".encode()
    members = {pid for pid in everyone if pid == root or _has_mark(pid, needle)}
    sessions = {everyone[pid].session for pid in members}
    grown = True
    while grown:
        more = {
            pid
            for pid, one in everyone.items()
            if pid not in members and (one.parent in members or one.session in sessions)
        }
        members |= more
        sessions |= {everyone[pid].session for pid in more}
        grown = bool(more)
    return {pid: everyone[pid] for pid in members if pid in everyone}


def _has_mark(pid: int, needle: bytes) -> bool:
    try:
        return needle in (PROC / str(pid) / "environ").read_bytes().split(b"\0")
    except OSError:  # gone meanwhile, or another user's
        return False


def cpu_by_role(members: dict[int, Process]) -> dict[str, float]:
    """Return the CPU seconds that these processes have used since they began."""
    used: dict[str, float] = {REPLICA: 0.0, PROXY: 0.0, OTHER: 0.0}
    for pid, process in members.items():
        with suppress(OSError, IndexError, ValueError):
            fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
            used[process.role] += (int(fields[11]) + int(fields[12])) * TICK_S
    return used


def pss_mb(pid: int) -> float:
    """Return a process's memory [MB], shared pages counted in proportion; 0 when it has gone."""
    with suppress(OSError):
        for line in (PROC / str(pid) / "smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0


def rss_mb(pid: int) -> float:
    """Return a process's resident memory [MB]; 0 when it has gone."""
    with suppress(OSError, IndexError):
        return int((PROC / str(pid) / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    return 0.0
