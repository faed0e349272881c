"""TCP ports of this machine: whether a server may listen on one, which process has it, free ones for a launch."""

from __future__ import annotations

import contextlib
import errno
import secrets
import socket

import psutil

from rlservo.export.contract.errors import UnavailableError, UsageError

# Where `free_ports` looks: above those Ray gives its workers, below those of a cluster's replicas (30000 and up)
# and those of outgoing connections (Linux: 32768 and up).
PORTS = range(20_000, 30_000)
_claimed: set[int] = set()  # ports that this process means to listen on, or has somebody listen on


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
    with contextlib.suppress(psutil.Error):
        return not any(parent.name().startswith(("raylet", "ray::")) for parent in psutil.Process(pid).parents())
    return True


def port_holder(port: int) -> tuple[int, str] | None:
    """Return (pid, command name) of a process that listens on a TCP port, where the system shows it to this user.

    HAProxy, where it is one of several: its listening sockets are its wrapper's, too.
    """
    holders: list[tuple[int, str]] = []
    for process in psutil.process_iter():  # psutil.net_connections names one process for each socket
        with contextlib.suppress(psutil.Error):
            listening = (each for each in process.net_connections("tcp") if each.status == psutil.CONN_LISTEN)
            if any(each.laddr and each.laddr.port == port for each in listening):
                holders.append((process.pid, process.name()))
    return min(holders, key=lambda holder: holder[1] != "haproxy", default=None)


def free_ports(count: int) -> list[int]:
    """Return ports that nobody has, all different, and claimed. Raises UnavailableError where there are too few.

    The system's own choice (port 0) would be one of those it also gives to outgoing connections, of which Ray makes
    hundreds before its last server listens.
    """
    candidates = list(PORTS)
    secrets.SystemRandom().shuffle(candidates)
    found: list[int] = []
    for port in candidates:
        if len(found) == count:
            break
        if port not in _claimed and claim_port(port):
            found.append(port)
    if len(found) < count:
        raise UnavailableError(f"{len(found)} of the ports {PORTS[0]} to {PORTS[-1]} are free: {count} are needed")
    return found


def claim_port(port: int) -> bool:
    """Return whether a TCP port is free, and now ours: no other process that asks here gets it while this one lives.

    Seconds pass between the choice of a port and whoever listens there, and another server may be starting meanwhile.
    The claim is a socket's name in the same network namespace as the port, which goes with its process.
    """
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0rlservo-port-{port}")
    except OSError as error:
        claim.close()
        if error.errno != errno.EADDRINUSE:
            raise
        return False
    if not is_free(port):
        claim.close()
        return False
    claim.detach()  # open, and with it the claim, until this process ends
    _claimed.add(port)
    return True


def is_free(port: int) -> bool:
    """Return whether nobody has this TCP port at the moment, on any address of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(("", port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return False
    return True
