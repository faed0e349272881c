"""Listening sockets that outlive HAProxy: one process opens them, watchers keep them, each HAProxy inherits them.

A listening socket that ends with its process refuses connections, and loses those that wait in it. So HAProxy's
frontends listen on inherited sockets (`bind fd@N`), and the next HAProxy gets them from a watcher (`SCM_RIGHTS`): who
connects while none runs waits in the kernel and is answered.
"""

from __future__ import annotations

import array
import contextlib
import os
import socket
from pathlib import Path

from rlservo.serve_app.ray_serve.haproxy.configuration import FIRST_FD

BACKLOG = 4096
KEEPER = "l."  # and the process id of a watcher: the Unix socket where it gives its listening sockets away


def inherit_or_open(folder: Path, addresses: list[str]) -> tuple[list[str], bool]:
    """Have sockets that listen there at `FIRST_FD` and up; return (their addresses, whether a watcher had them all).

    Those that a watcher keeps; where it has none for us, new ones. None where they cannot be had: then HAProxy binds.
    """
    kept: dict[str, int] = {}
    for keeper in sorted(folder.glob(f"{KEEPER}*"), key=lambda path: path.name, reverse=True):
        try:
            kept = _receive(keeper)
        except ConnectionRefusedError:  # of a watcher that was killed
            keeper.unlink(missing_ok=True)
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


def _receive(keeper: Path) -> dict[str, int]:
    """Return the sockets that a watcher keeps, by address. Raises OSError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(1.0)
        connection.connect(str(keeper))
        content, messages, _, _ = connection.recvmsg(4096, socket.CMSG_SPACE(16 * 4))
    descriptors = array.array("i")
    for level, kind, data in messages:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            descriptors.frombytes(data[: len(data) // 4 * 4])
    return dict(zip(content.decode().split(), descriptors, strict=False))


class SocketKeeper:
    """Gives this process's listening sockets to whoever may enter the folder."""

    def __init__(self, folder: Path, addresses: list[str]) -> None:
        self.addresses = addresses
        self._path = folder / f"{KEEPER}{os.getpid()}"
        self.socket: socket.socket | None = None
        with contextlib.suppress(OSError):  # its path may be too long: then the next HAProxy opens sockets of its own
            self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self.socket.setblocking(False)
            self.socket.bind(str(self._path))
            self._path.chmod(0o600)
            self.socket.listen()

    @property
    def descriptors(self) -> range:
        return range(FIRST_FD, FIRST_FD + len(self.addresses))

    def give(self) -> None:
        """Give the sockets to the next one who connects."""
        assert self.socket is not None
        with contextlib.suppress(OSError):
            connection, _ = self.socket.accept()
            with connection:
                content = " ".join(self.addresses).encode() or b" "
                rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", self.descriptors))
                connection.sendmsg([content], [rights])

    def close(self) -> None:
        self._path.unlink(missing_ok=True)
