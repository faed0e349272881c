"""Listening socket of the direct port, shared by all replicas of a machine.

Sockets that share a port by SO_REUSEPORT have a queue each, and what waits in it is reset when its replica ends. One
socket in several processes has one queue, and whoever still lives takes from it. So under `rlservo serve` the launcher,
which outlives every replica, binds the socket, and gives it (`SCM_RIGHTS`) to each replica that asks at a Unix socket
in the server's private folder. A cluster's nodes have nobody to hold it: there replicas bind sockets of their own.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

from rlservo.export.contract.errors import UsageError

VARIABLE = "RLSERVO_DIRECT_SOCKET"  # of a replica's environment: where the socket is to be had
GIVEN_S = 5.0  # [s] for the launcher to give it


def open_port(host: str, port: int) -> tuple[socket.socket, bool]:
    """Return (a bound socket, whether other processes have the same one). Raises UsageError."""
    keeper = os.environ.get(VARIABLE)
    try:
        if keeper is not None:
            return _receive(keeper), True
        return _bind(host, port, reuse=True), False
    except OSError as error:
        raise UsageError(f"the direct port {port} on {host} cannot be listened on: {error.strerror or error}") from None


@contextlib.contextmanager
def hold_port(host: str, port: int, keeper: Path) -> Iterator[None]:
    """Bind the port, and give the socket to whoever may connect to the Unix socket `keeper`. Raises UsageError."""
    with contextlib.ExitStack() as stack:
        try:
            bound = stack.enter_context(_bind(host, port, reuse=False))
            giver = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            giver.bind(str(keeper))
            keeper.chmod(0o600)
            giver.listen()
        except OSError as error:
            raise UsageError(f"the direct port {port} on {host} cannot be had: {error.strerror or error}") from None
        thread = threading.Thread(target=_give, args=(giver, bound), daemon=True)
        thread.start()
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                giver.shutdown(socket.SHUT_RDWR)  # wakes the thread
            thread.join()


def _bind(host: str, port: int, *, reuse: bool) -> socket.socket:
    family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    bound = socket.socket(family, kind)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if reuse:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        bound.bind(address)
    except BaseException:
        bound.close()
        raise
    return bound


def _give(giver: socket.socket, bound: socket.socket) -> None:
    while True:
        try:
            connection, _ = giver.accept()
        except OSError:
            return
        with connection, contextlib.suppress(OSError):
            socket.send_fds(connection, [b"."], [bound.fileno()])


def _receive(keeper: str) -> socket.socket:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(GIVEN_S)
        connection.connect(keeper)
        _, descriptors, _, _ = socket.recv_fds(connection, 1, 1)
    if not descriptors:
        raise OSError("the launcher gave no socket")
    return socket.socket(fileno=descriptors[0])
