"""Listening TCP sockets, and clear errors if a port is not available."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from typing import Any

import psutil

from rlservo.errors import UsageError

BACKLOG = 2048


def listen(host: str, port: int, *, option: str = "--port") -> socket.socket:
    """Return a socket that listens on host:port (port 0: any). Raises UsageError, naming the command's `option`."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise UsageError(f"host '{host}' is not an address of this machine: {error.strerror}") from error
    is_ipv6 = family == socket.AF_INET6
    try:
        _check_route(family, address)
        return socket.create_server(address, family=family, backlog=BACKLOG, dualstack_ipv6=is_ipv6)
    except OSError as error:
        raise UsageError(_why_not(host, port, option, error)) from error


def _check_route(family: int, address: Any) -> None:
    """Raise OSError if this machine cannot reach its own address because its interface is down."""
    host, _, *rest = address
    if host in ("0.0.0.0", "::"):
        return
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((host, 9, *rest))  # only looks up a route; sends nothing


def _why_not(host: str, port: int, option: str, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        holder = port_holder(port)
        if holder is not None and holder[0] == os.getpid():
            return f"port {port} is in use by this process itself, as by --port: choose another one with {option}"
        by = "" if holder is None else f" by '{holder[1]}' (process {holder[0]})"
        return f"port {port} on {host} is in use{by}: stop that process, or choose another port with {option}"
    if error.errno == errno.ENETUNREACH:
        return f"{host} cannot be reached from this machine: is its interface up? (ip link set lo up)"
    if error.errno == errno.EACCES:
        return f"port {port} needs more rights than this user has: choose a port above 1023 with {option}"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"host '{host}' is not an address of this machine: use 127.0.0.1, or 0.0.0.0 for all of its addresses"
    return f"cannot listen on {host}:{port}: {error.strerror}"


def port_holder(port: int) -> tuple[int, str] | None:
    """Return (pid, command name) of a process that listens on a TCP port, if this user may see it."""
    for process in psutil.process_iter():  # psutil.net_connections names one process for each socket
        with contextlib.suppress(psutil.Error):
            listening = (each for each in process.net_connections("tcp") if each.status == psutil.CONN_LISTEN)
            if any(each.laddr and each.laddr.port == port for each in listening):
                return process.pid, process.name()
    return None
