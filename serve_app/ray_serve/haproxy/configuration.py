"""Edits of the HAProxy configuration that Ray Serve writes, each of which must match exactly.

What Ray's (2.60, `haproxy_templates.py` there) lacks:

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
  is enough, with four times the retries. (That a Unix socket is nobody's it knows at once, and goes on at once.)
- A replica that hangs keeps what it was sent. HAProxy closes what it has open there as soon as the replica's health
  checks fail, asks another one or answers 503, and 504 where an action takes too long. Every request is stamped with
  when it came (`STAMP`), so that a replica knows how old an observation is that waited elsewhere.
- It takes 4 new connections in a row and then turns to those it has: of 64 that opened under load the last waited for
  40 ms.
- It composes a log line for every request, whether anybody reads it or not: a tenth of its work.
"""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rlservo.serve_app.ray_serve.haproxy.error_replies import (
    ACTION_TIMEOUT_S,
    REQUEST_TIMEOUT_S,
    TOO_SLOW_CLIENT,
    TOO_SLOW_REPLICA,
    UNREACHABLE,
)
from rlservo.serve_app.wire.replica_sockets import socket_path
from rlservo.serve_app.wire.request_stamp import STAMP, stamp_format

ACTING = "{ path_end /act /infer /ModelInfer }"
CONNECT_TIMEOUT_MS = 250
FIN_TIMEOUT_S = 5  # for a connection that one side has closed
FIRST_FD = 40  # of the listening sockets in every process that has them: configurations name them by number
SETTLE_MS = 1000  # in which a bridge takes what had waited for it
MAX_ACCEPT = 64  # connections in a row
MAX_CONNECTIONS = 1024  # per client address; `ServerSettings.max_connections_per_address`
OVER = 32  # connections beyond the bound that are answered 429; further ones are closed without a word
STREAM_IDLE_S = 300.0  # `ServerSettings.stream_idle_s`
STREAM_MARGIN_S = 30  # the replica ends a silent stream, with a sentence; the proxy only what the replica has left
CHECK_SECRET = "RLSERVO_CHECK_SECRET"
CHECK_HEADER = "x-rlservo-check"
VERSION_VARIABLE = "RLSERVO_RAY_VERSION"

_REPLICA = r"^ *server SERVE_REPLICA.*$"
_SERVER = r"^ *server (?!.* backup$)"  # but for Serve's own proxy, a backend's last resort
_BACKEND = r"^backend \S+$(?=(?:\n .*|\n)*?\n +server )"  # those that have servers
_FRONTEND = r"^frontend (?:http|grpc)_frontend\n(?: .*\n)*"
_BIND = r"^ +bind (\S+:\d+)(?= |$)"


class TemplateError(Exception):
    """Ray writes another configuration than the one that is known here."""


class Limits(NamedTuple):
    """What is bounded, from the environment that Ray's processes inherit."""

    max_connections: int
    """Per client address; 0: no bound."""

    stream_idle_s: float
    secret: str
    """What HAProxy's health checks show to replicas; without one, health is nobody's secret."""

    @classmethod
    def from_environment(cls) -> Limits:
        """Return the values of `RLSERVO_*`, the names of `ServerSettings`."""
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


def patch_configuration(text: str, replies: Path, *, limits: Limits | None = None) -> str:
    """Return Ray's configuration with every edit made; `replies` is the folder of HAProxy's own replies.

    Raises TemplateError where an edit does not match exactly.
    """
    limits = limits or Limits.from_environment()
    text = _replace(text, r"^(frontend prometheus\n +bind )(:\d+)$", r"\g<1>127.0.0.1\2", "the metrics' port")
    text = _replace(text, r"^(listen stats\n +bind )\*(:\d+)$", r"\g<1>127.0.0.1\2", "the statistics' port")
    for status, file in ((502, UNREACHABLE), (503, UNREACHABLE), (504, TOO_SLOW_REPLICA)):
        text = _replace(text, rf"^( *errorfile {status}) .*$", rf"\1 {replies / file}", f"the answer {status}")
    if "RAY_SERVE_HAPROXY_TIMEOUT_CONNECT_S" not in os.environ:
        text = _replace(text, r"^( *timeout connect) .*$", rf"\1 {CONNECT_TIMEOUT_MS}ms", "'timeout connect'")
    text = _replace(text, r"^( *)nbthread \d+$", rf"\g<0>\n\1tune.maxaccept {MAX_ACCEPT}", "'nbthread'")
    text = _leave_hung_replicas(text)
    text = _by_unix_sockets(text)
    if not knows_replicas(text):
        text = _answer_without_replicas(text)
    # What is put into a frontend last comes first: connections are bounded before requests are read and stamped.
    text = _stamp(text)
    text = _hide_serve(text, limits)
    text = _bound_time(text, replies, limits)
    return _bound_connections(text, limits)


def bridge_configuration(text: str, *, hung_since: float | None = None) -> str:
    """Return a patched configuration without what is Ray's own: its admin socket, statistics and metrics.

    What comes in the beginning may have waited since a HAProxy hung (`hung_since`, `time.time`).
    """
    if hung_since is not None:
        stamp = f"http-request set-header {STAMP} {stamp_format(f'{hung_since * 1e3:.0f}')}"
        until = f"if {{ date(0,ms) -m int lt {time.time() * 1e3 + SETTLE_MS:.0f} }}"
        own = rf"^( *)http-request set-header {STAMP} .*$"
        text = _replace(text, own, rf"\g<0>\n\1{stamp} {until}", "the stamp", times=1 + _has_grpc(text))
    text = _replace(text, r"^ *stats (?:socket|timeout) .*\n", "", "the statistics' socket", times=2)
    sections = r"^(?:frontend prometheus|listen stats)\n(?: .*\n?)*"
    return _replace(text, sections, "", "the statistics' sections", times=2)


def inherit_sockets(text: str, listeners: list[str]) -> str:
    """Return a configuration that listens on the inherited sockets of these addresses."""
    for number, address in enumerate(listeners, FIRST_FD):
        text = _replace(text, rf"^( +bind ){re.escape(address)}(?= |$)", rf"\g<1>fd@{number}", f"'bind {address}'")
    return text


def listening_addresses(text: str) -> list[str]:
    """Return where the frontends listen. Raises TemplateError where one has no address, or several."""
    found = [re.findall(_BIND, part, re.MULTILINE) for part in re.findall(_FRONTEND, text, re.MULTILINE)]
    if [len(addresses) for addresses in found] != [1] * (1 + _has_grpc(text)):
        raise _unknown_template(f"the frontends listen on {found}")
    return [address for (address,) in found]


def admin_socket(text: str) -> str | None:
    """Return the path of HAProxy's admin socket."""
    found = re.search(r"^ *stats socket (\S+)", text, re.MULTILINE)
    return found[1] if found else None


def knows_replicas(text: str) -> bool:
    """Whether requests can be passed on to anybody."""
    return _count(_REPLICA, text) > 0


def _replace(text: str, pattern: str, new: str | Callable[[re.Match[str]], str], what: str, *, times: int = 1) -> str:
    """Replace the one match of a pattern, or the `times` there must be. Raises TemplateError for any other number."""
    text, count = re.subn(pattern, new, text, flags=re.MULTILINE)
    if count != times:
        raise _unknown_template(f"{what} is there {count} times, not {times}")
    return text


def _unknown_template(difference: str) -> TemplateError:
    return TemplateError(
        f"Ray {_ray_version()} writes another HAProxy configuration than Ray 2.60: {difference}; install a Ray that "
        "this version of rlservo knows"
    )


def _count(pattern: str, text: str) -> int:
    return len(re.findall(pattern, text, re.MULTILINE))


def _ray_version() -> str:
    if version := os.environ.get(VERSION_VARIABLE):
        return version
    from importlib import metadata

    return metadata.version("ray")


def _insert(text: str, protocol: str, lines: str) -> str:
    """Put lines at the beginning of a frontend."""
    name = f"frontend {protocol}_frontend"
    return _replace(text, rf"^{name}$", lambda _: f"{name}\n{lines}", f"'{name}'")


def _has_grpc(text: str) -> bool:
    return _count(r"^frontend grpc_frontend$", text) > 0


def _answer_without_replicas(text: str) -> str:
    """Say that replicas are not there yet, or no more: 404 would say that there is no such policy."""
    unknown = r"^( *http-request return) status 404 .*$"
    text = _replace(text, unknown, r"\1 status 503 default-errorfiles", "the answer to unknown paths")
    # One application has a backend and all calls, also where it has lost its replicas: nothing is unknown then.
    if _has_grpc(text) and _count(r"^backend grpc-", text) != 1:
        unknown, new = r"(hdr grpc-status )5( hdr grpc-message) .*$", r'\g<1>14\2 "no replica is there yet"'
        text = _replace(text, unknown, new, "the answer to unknown gRPC applications", times=2)
    return text


def _leave_hung_replicas(text: str) -> str:
    """Bound how long a request waits for a replica that takes it and does not answer."""
    # Counted in another way than they are matched. ListApplications has a server of its own, which is no replica.
    replicas = _count(_SERVER, text) - _count(r"^backend grpc_fallback_backend$", text)
    text = _replace(text, _REPLICA, r"\g<0> on-marked-down shutdown-sessions", "a replica", times=replicas)
    sections = re.split(r"^(?=\S)", text, flags=re.MULTILINE)
    backends = sum(part.startswith("backend ") and "\n    server " in part for part in sections)
    rule = f"    http-request set-timeout server {ACTION_TIMEOUT_S}s if {ACTING}"
    return _replace(text, _BACKEND, rf"\g<0>\n{rule}", "a backend with servers", times=backends)


def _by_unix_sockets(text: str) -> str:
    """Ask replicas, and Serve's own proxy, by Unix sockets where they have them."""
    if socket_path(0) is None:
        return text
    server = r"^( *server \S+) 127\.0\.0\.1:(\d+)(?= )"
    times = _count(r"^ *server ", text)
    return _replace(text, server, lambda one: f"{one[1]} unix@{socket_path(one[2])}", "a server's address", times=times)


def _stamp(text: str) -> str:
    """Note on every request when it came. A body that is slow to come waits for itself, so only after it."""
    stamp = f"    http-request set-header {STAMP} {stamp_format('%[date(0,ms)]')}"
    text = _insert(text, "http", f"    http-request wait-for-body time {REQUEST_TIMEOUT_S}s\n{stamp}")
    if not _has_grpc(text):
        return text
    # A call without a stream is there at once; a stream is a request that goes on.
    body = f"    http-request wait-for-body time {REQUEST_TIMEOUT_S}s unless {{ path_end StreamInfer }}"
    return _insert(text, "grpc", f"{body}\n{stamp}")


def _bound_time(text: str, replies: Path, limits: Limits) -> str:
    """Give every phase of a connection a time-out, and streams theirs."""
    # Whose requests were refused, and who administers, is logged with the client's address, not the proxy's.
    lines = f"""    option forwardfor
    timeout http-request {REQUEST_TIMEOUT_S}s
    timeout tunnel {limits.stream_s}s
    timeout client-fin {FIN_TIMEOUT_S}s
    timeout server-fin {FIN_TIMEOUT_S}s
    errorfile 408 {replies / TOO_SLOW_CLIENT}"""
    if "RAY_SERVE_HAPROXY_LOG_TARGET" not in os.environ:  # a target is for those who want to read every request
        lines = f"    option dontlog-normal\n{lines}"
    text = _replace(text, r"^defaults$", rf"\g<0>\n{lines}", "the section of defaults")
    # A connection on which nothing came gets no 408. HTTP/2 has a port of its own: here a connection of it would be a
    # hundred requests, and count as one.
    handshake = "{ method GET } { req.hdr(upgrade) -i -m str websocket }"
    no_body = "!{ req.hdr(transfer-encoding) -m found } !{ req.hdr(content-length) -m int gt 0 }"
    lines = f"""    option disable-h2-upgrade
    option http-ignore-probes
    http-request del-header upgrade unless {handshake} {no_body}"""
    text = _insert(text, "http", lines)
    if not _has_grpc(text):
        return text
    # HAProxy takes a gRPC call's silence for that of its connection.
    return _insert(text, "grpc", f"    timeout client {limits.stream_s}s")


def _bound_connections(text: str, limits: Limits) -> str:
    """Bound how many connections an address may have, HTTP and gRPC together."""
    if limits.max_connections == 0:
        return text
    most = limits.max_connections
    table = "backend connections_by_address\n    stick-table type ipv6 size 100k expire 10m store conn_cur\n"
    sentence = f"your address has more than {most} connections to this server: close some, or wait"
    body = json.dumps({"error": sentence, "code": "over-capacity"}, separators=(",", ":")).replace('"', '\\"')
    count = f"""    tcp-request connection track-sc0 src table connections_by_address
    tcp-request connection reject if {{ sc0_conn_cur gt {most + OVER} }}"""
    answers = {
        "http": f'status 429 content-type application/json hdr connection close hdr retry-after 1 string "{body}"',
        "grpc": f'status 200 content-type application/grpc hdr grpc-status 8 hdr grpc-message "{sentence}"',
    }
    for protocol in ("http", "grpc") if _has_grpc(text) else ("http",):
        answer = f"    http-request return {answers[protocol]} if {{ sc0_conn_cur gt {most} }}"
        text = _insert(text, protocol, f"{count}\n{answer}")
    return _replace(text, r"^frontend prometheus$", rf"{table}\g<0>", "the metrics' frontend")


def _hide_serve(text: str, limits: Limits) -> str:
    """Let nobody answer what Serve itself answers without a key; its health is then the health checks' alone."""
    hidden = "/-/" if limits.secret else "/-/routes"
    body = '{\\"error\\":\\"nothing is here: policies are under /v1/policies\\",\\"code\\":\\"not-found\\"}'
    answer = f'    http-request return status 404 content-type application/json string "{body}"'
    text = _insert(text, "http", f"{answer} if {{ path_beg -i {hidden} }}")
    if _has_grpc(text):
        answer = "    http-request return status 200 content-type application/grpc hdr grpc-status 12"
        rule = f'{answer} hdr grpc-message "this server has no such method" if {{ path_beg -i /ray.serve. }}'
        text = _insert(text, "grpc", rule)
    if not limits.secret:
        return text
    http, grpc = _checked_backends(text)
    new = rf"\1\n    http-check send hdr {CHECK_HEADER} {limits.secret}"
    text = _replace(text, r"^( *option httpchk GET /-/healthz)$", new, "the health check", times=http)
    return _replace(
        text,
        r"^( *tcp-check send-binary )([0-9a-f]+)$",
        lambda found: found[1] + _with_secret(bytes.fromhex(found[2]), limits.secret).hex(),
        "the gRPC health check",
        times=grpc,
    )


def _checked_backends(text: str) -> tuple[int, int]:
    """Return how many backends ask their servers for their health, over HTTP and over gRPC (`proto h2`).

    Told by the servers, so that no check at all is as wrong as another one than is known here.
    """
    backends = [part for part in re.split(r"^(?=\S)", text, flags=re.MULTILINE) if part.startswith("backend ")]
    servers = [re.findall(r"^ +server (?!.* track ).*$", part, re.MULTILINE) for part in backends]  # a track copies
    kinds = [any(" proto h2" in server for server in found) for found in servers if found]
    return kinds.count(False), kinds.count(True)


def _with_secret(request: bytes, secret: str) -> bytes:
    """Return the HTTP/2 request of Ray's gRPC health check with the secret as one more header."""
    start = request.find(b"SM\r\n\r\n") + 6 + 9  # after the preface and its empty settings
    length = int.from_bytes(request[start : start + 3], "big")
    end = start + 9 + length
    head, block, rest = request[start + 3 : start + 9], request[start + 9 : end], request[end:]
    if head[0] != 1:
        raise _unknown_template("the gRPC health check begins with another frame")
    name, value = CHECK_HEADER.encode(), secret.encode()
    block += b"\x00%c%s%c%s" % (len(name), name, len(value), value)  # a literal header, without indexing
    return request[:start] + len(block).to_bytes(3, "big") + head + block + rest
