"""Ports and processes of a launch: find free ports, tell who holds one, end every marked process.

Every process of a launch inherits one environment variable with the launch's own mark, and the session of the launch's
first process, so that whatever is left of it can be found and ended whatever became of its parents. It takes both:
Ray's workers write their title over the memory that held their environment, and whoever wants to may leave a session.
Reads /proc (Linux).
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import signal
import socket
import time
from pathlib import Path

from rlservo.export.contract.errors import UnavailableError, UsageError

MARK = "RLSERVO_LAUNCH"
SERVER_LOG = "server.log"
KEPT_BYTES = 4096  # of a log that is cut
LOG_BYTES = 4 << 20  # [bytes] of this log, and of each log of Ray's
PROC = Path("/proc")
# Where `free_ports` looks: above those Ray gives its workers, below those of replicas (`launcher.py`, 30000 and up)
# and those of outgoing connections (Linux: 32768 and up).
PORTS = range(20_000, 30_000)
QUIET_S = 0.3  # without a sign of a marked process, before the last of them counts as gone


def check_port(host: str, port: int) -> None:
    """Raise UsageError unless a server could listen on host:port right now; say who holds it."""
    if not 0 < port < 65536:
        raise UsageError(f"port must be in 1..65535, got {port}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise UsageError(f"host '{host}' is not an address of this machine: {error.strerror}") from error
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # closed connections lingering are no obstacle
        try:
            probe.bind(address)
            probe.listen(1)
        except OSError as error:
            raise UsageError(_why_not(host, port, error)) from error


def _why_not(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        holder = port_holder(port)
        if holder is None:
            return f"port {port} on {host} is in use: stop what listens there, or choose another with --port"
        pid, name = holder
        message = f"port {port} on {host} is in use by '{name}' (process {pid})"
        if name == "haproxy" and not _is_orphan(pid):
            return f"{message}, the proxy of a running server: stop that server (Ctrl-C), or choose another with --port"
        if name == "haproxy":
            return (
                f"{message}: a proxy that an earlier Ray Serve left behind, it would answer in our place; "
                f"end it with 'kill {pid}', or choose another port with --port"
            )
        return f"{message}: stop it, or choose another with --port"
    if error.errno == errno.EACCES:
        return f"port {port} needs more rights than this user has: choose one above 1023 with --port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"host '{host}' is not an address of this machine: use 127.0.0.1, or 0.0.0.0 for all of its addresses"
    return f"cannot listen on {host}:{port}: {error.strerror}"


def _is_orphan(pid: int) -> bool:
    """Return whether no Ray is left among the process's ancestors, so that it serves nobody."""
    with contextlib.suppress(OSError):
        while pid > 1:
            if (PROC / str(pid) / "comm").read_text().startswith(("raylet", "ray::")):
                return False
            pid = int((PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[1])
    return True


def port_holder(port: int) -> tuple[int, str] | None:
    """Return (pid, command name) of a process listening on a TCP port, where /proc shows it to this user."""
    inodes: set[str] = set()
    for table in ("net/tcp", "net/tcp6"):
        with contextlib.suppress(OSError):
            for line in (PROC / table).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == "0A" and int(fields[1].rsplit(":", 1)[1], 16) == port:  # 0A: LISTEN
                    inodes.add(f"socket:[{fields[9]}]")
    for pid in _pids():
        with contextlib.suppress(OSError):
            if any(str(link.readlink()) in inodes for link in (PROC / str(pid) / "fd").iterdir()):
                return pid, (PROC / str(pid) / "comm").read_text().strip()
    return None


def free_ports(count: int) -> list[int]:
    """Return ports free at the moment of asking, all different. Raises UnavailableError where there are too few.

    The system's own choice (port 0) would be one of those it also gives to outgoing connections, of which Ray makes
    hundreds before its last server listens.
    """
    candidates = list(PORTS)
    secrets.SystemRandom().shuffle(candidates)
    found: list[int] = []
    for port in candidates:
        if len(found) == count:
            break
        if is_free(port):
            found.append(port)
    if len(found) < count:
        raise UnavailableError(f"{len(found)} of the ports {PORTS[0]} to {PORTS[-1]} are free: {count} are needed")
    return found


def is_free(port: int) -> bool:
    """Whether nobody has this TCP port at the moment, on any address of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(("", port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return False
    return True


def marked(mark: str, session: int | None = None) -> list[int]:
    """Return the living processes, other than this one, that carry the launch's mark or belong to its session."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for pid in _pids():
        if pid == os.getpid():
            continue
        with contextlib.suppress(OSError):
            # A zombie's environment reads as empty: it is gone but for its parent's notice.
            has_mark = wanted in (PROC / str(pid) / "environ").read_bytes().split(b"\0")
            if has_mark or (session is not None and _session_of_living(pid) == session):
                found.append(pid)
    return found


def _session_of_living(pid: int) -> int | None:
    """Return the process's session id, None for a zombie."""
    # After the command in parentheses, which may hold anything: state, parent, group, session.
    state, _, _, session, *_ = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    return None if state == "Z" else int(session)


def end_marked(mark: str, session: int | None = None, *, timeout_s: float = 10.0) -> list[int]:
    """Kill every process of the launch (see `marked`), and those they start meanwhile; return what would not go."""
    deadline = time.monotonic() + timeout_s
    quiet_since: float | None = None
    while time.monotonic() < deadline:
        left = marked(mark, session)
        for pid in left:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        # One empty look proves nothing: in the middle of an exec a process shows no environment at all.
        if left:
            quiet_since = None
        elif quiet_since is None:
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since >= QUIET_S:
            return []
        time.sleep(0.05)
    return marked(mark, session)


def describe_end(returncode: int | None) -> str:
    """Return how a process ended, as the end of a sentence about it; negative is a signal, as `subprocess` has it."""
    if returncode is None:
        return "ended"
    if returncode >= 0:
        return f"ended with exit status {returncode}"
    with contextlib.suppress(ValueError):
        return f"was ended by {signal.Signals(-returncode).name}"
    return f"was ended by signal {-returncode}"


def cut_log(file: Path, max_bytes: int = LOG_BYTES) -> None:
    """Empty a log that has grown beyond its bound, but for its last lines; whoever writes it appends."""
    with contextlib.suppress(OSError):
        if file.stat().st_size <= max_bytes:
            return
        with file.open("rb+") as log:
            log.seek(-KEPT_BYTES, os.SEEK_END)
            kept = log.read().partition(b"\n")[2]
            log.truncate(0)
        with file.open("ab") as log:
            log.write(kept)


def remove_folder(folder: Path, *, timeout_s: float = 5.0) -> None:
    """Remove a folder that processes just ended, or another cleaner, may be touching a last time."""
    deadline = time.monotonic() + timeout_s
    while folder.exists() and time.monotonic() < deadline:
        shutil.rmtree(folder, ignore_errors=True)
        if folder.exists():
            time.sleep(0.05)


def _pids() -> list[int]:
    try:
        return [int(entry.name) for entry in PROC.iterdir() if entry.name.isdigit()]
    except OSError:
        return []
