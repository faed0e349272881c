"""Watcher of a running HAProxy: ends one that hangs, and runs another one until Ray Serve's next one takes over.

When HAProxy or its actor is killed, Serve looks three times before it starts another one, which takes seconds. The
watcher waits for HAProxy's end and at once starts it again, with the last configuration that knew replicas: a *bridge*,
until Serve's next one knows its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import socket
import subprocess
import time
from pathlib import Path

from rlservo.serve_app.ray_serve.haproxy.configuration import admin_socket, bridge_configuration, knows_replicas
from rlservo.serve_app.ray_serve.haproxy.listening_sockets import SocketKeeper
from rlservo.serve_app.ray_serve.haproxy.process_table import find_haproxies, has_controller, is_running, parent_of

BRIDGE, LOCK = "bridge.cfg", "bridge.lock"
KNOWN = "known.cfg"  # the last configuration that knew replicas
# A HAProxy whose admin socket says nothing for so long hangs.
PROBE_S, PROBE_WAITS, HUNG_S = 0.1, 5, 1.5
HANGS = -1  # instead of a process id
CHECK_PERIOD_S = 0.1  # of a bridge, of whether it is still needed
ORPHAN_S = 8.0  # without Serve's controller, which comes back within a few seconds or not at all


def leave_watcher(binary: str, file: Path, addresses: list[str]) -> None:
    """Leave a process that sees the end of HAProxy, which this process becomes: its standard output is a pipe."""
    raylet, proxy = parent_of(os.getppid()), os.getpid()
    read_end, write_end = os.pipe()
    if (child := os.fork()) > 0:
        os.waitpid(child, 0)  # it ends at once; what it leaves is nobody's child, so HAProxy need not wait for it
        os.dup2(write_end, 1)
        os.close(read_end)
        os.close(write_end)
        return
    os.setsid()  # Ray ends an actor's process group with the actor
    if os.fork() > 0:
        os._exit(0)
    keeper = SocketKeeper(file.parent, addresses)
    try:
        os.close(write_end)
        hung_since = _wait_for_end(read_end, proxy, file, keeper)
        _bridge(binary, file, raylet, keeper, hung_since)
    finally:
        keeper.close()
        os._exit(0)


def _wait_for_end(output: int, proxy: int, file: Path, keeper: SocketKeeper) -> float | None:
    """Pass on HAProxy's output until it ends, and end it where it hangs; then return since when (`time.time`)."""
    ran, hung_s, patience_s, probed = time.time(), 0.0, 3 * HUNG_S, 0.0  # longer for one that is starting
    while True:
        waiting: list[int | socket.socket] = [output] if keeper.socket is None else [output, keeper.socket]
        ready, _, _ = select.select(waiting, [], [], 0.5)
        if keeper.socket in ready:
            keeper.give()
        if output in ready:
            if not (content := os.read(output, 65536)):
                return ran if hung_s else None
            os.write(1, content)
        if time.monotonic() - probed < 0.4:
            continue
        probed = time.monotonic()
        responding = _responding_haproxy(file)
        if responding == proxy:
            ran, hung_s, patience_s = time.time(), 0.0, HUNG_S
        elif responding > 0:  # it has been replaced, and may take as long as it likes
            patience_s = float("inf")
        elif responding == HANGS:
            hung_s += PROBE_WAITS * PROBE_S
            if hung_s >= patience_s and is_running(proxy):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(proxy, signal.SIGKILL)


def _responding_haproxy(file: Path) -> int:
    """Return which HAProxy answers its admin socket; 0 where none listens, HANGS where one does and says nothing."""
    path = admin_socket(file.read_text())
    if path is None:
        return 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(PROBE_S)
        try:
            connection.connect(path)
            connection.sendall(b"show info\n")
        except BlockingIOError:  # so many wait already
            return HANGS
        except OSError:
            return 0
        content = b""
        for _ in range(PROBE_WAITS):  # short ones: a machine that stood still is no proof that HAProxy did
            try:
                while piece := connection.recv(65536):
                    content += piece
            except TimeoutError:
                continue
            except OSError:
                return 0
            break
        else:
            return HANGS
    fields = dict(line.split(": ", 1) for line in content.decode(errors="replace").splitlines() if ": " in line)
    return int(fields.get("Pid", 0)) if fields.get("Stopping", "0") == "0" else 0


def _bridge(binary: str, file: Path, raylet: int, keeper: SocketKeeper, hung_since: float | None) -> None:
    """Run another HAProxy, unless one is there already or Serve has ended, too.

    On nodes without Serve's controller nothing is bridged: there nobody could tell when to end.
    """
    if _responding_haproxy(file) or not keeper.addresses or not has_controller(raylet):
        return
    lock = os.open(file.with_name(LOCK), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # another watcher's bridge is there
        return
    old = set(find_haproxies(binary, file))  # replaced earlier, and busy with what they still carry
    copy, known = file.with_name(BRIDGE), file.with_name(KNOWN)
    copy.write_text(bridge_configuration((known if known.exists() else file).read_text(), hung_since=hung_since))
    command, nowhere = [binary, "-db", "-f", str(copy)], subprocess.DEVNULL

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, pass_fds=keeper.descriptors)

    process, controlled = start(), time.monotonic()
    while (ended := process.poll()) is None or ended < 0:
        if ended is not None:  # killed, as the one before it
            process = start()
        now = time.monotonic()
        if has_controller(raylet):
            controlled = now
        if now - controlled > ORPHAN_S or not is_running(raylet):
            process.kill()
            process.wait()
            break
        if set(find_haproxies(binary, file)) - old and knows_replicas(file.read_text()):
            time.sleep(1.0)  # it listens by then
            process.send_signal(signal.SIGUSR1)  # answers what it has, and ends
            process.wait()
            break
        if keeper.socket is None:
            time.sleep(CHECK_PERIOD_S)
        elif select.select([keeper.socket], [], [], CHECK_PERIOD_S)[0]:
            keeper.give()
