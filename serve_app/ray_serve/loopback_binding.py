"""Ports that Ray Serve's processes open for each other, bound to loopback or replaced by Unix sockets.

A server of one machine needs one port that others reach: HAProxy's, or without HAProxy that of Serve's own proxy. Serve
(ray 2.60) binds the replicas' HTTP ports and the fallback proxy's where the public port is, and gRPC ports to every
interface, whatever its options say. Where HAProxy asks by Unix sockets (`wire/replica_sockets.py`), each gets one in
its port's place. `rlservo serve` sets the variable; a cluster of several machines cannot have it, since its machines
ask each other. Ray's own ports follow the node's address, which `launcher.py` and `cluster_process.py` set.

Serve calls `ingress.middlewares` in each process before it binds anything, and that calls `install`.
"""

from __future__ import annotations

import errno
import importlib
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlservo.serve_app.ray_serve.ray_parts import KNOWN, find
from rlservo.serve_app.wire.replica_sockets import socket_path

VARIABLE = "RLSERVO_BIND_LOOPBACK"
ALL = "1"
INNER = "inner"
"""Without HAProxy, and not on loopback: Serve's own proxy is what others reach."""
LOOPBACK = "127.0.0.1"


def is_wanted() -> bool:
    """Whether this process belongs to a server of one machine."""
    return os.environ.get(VARIABLE) in (ALL, INNER)


def install() -> None:
    """Bind to loopback what this process opens from now on. Raises RuntimeError where Ray's names have moved."""
    # A second time changes nothing. Serve pickles its proxy's class with the functions it calls, hence the names that
    # those look up.
    if os.environ[VARIABLE] == ALL:
        _replace("ray.serve._private.default_impl:add_grpc_address", _on_loopback)
    # Without HAProxy Serve's own proxy is the public one, and replicas have no port.
    if find("ray.serve._private.constants:RAY_SERVE_ENABLE_HA_PROXY"):
        _replace("ray.serve._private.http_util:socket", _sockets)
    _replace("ray.serve._private.replica:add_port_to_grpc_server", _on_loopback)


def _replace(name: str, wrap: Callable[[Any], Any]) -> None:
    """Put a wrapper in the place of what a module of Ray's looks up by a name."""
    module, _, attribute = name.partition(":")
    own = find(name)
    setattr(importlib.import_module(module), attribute, wrap(own))


def _on_loopback(add: Any) -> Any:
    """Wrap a function that binds a gRPC server to an address `host:port`; port 0, any, is for Serve itself."""

    def add_on_loopback(server: Any, address: str) -> Any:
        port = address.rpartition(":")[2]
        path = None if port == "0" else socket_path(port)
        if path is None:
            return add(server, f"{LOOPBACK}:{port}")
        try:
            _vacate(path)
        except OSError as error:  # gRPC itself would take it over, and remove it when the other one stops
            raise RuntimeError(f"port {port} cannot be had") from error
        return add(server, f"unix:{path}")

    return add_on_loopback


def _vacate(path: str) -> None:
    """Remove the socket that a killed process left at a path. Raises OSError where somebody listens, as on a port."""
    with socket.socket(socket.AF_UNIX) as other:
        other.setblocking(False)
        error = other.connect_ex(path)
    if error == errno.ECONNREFUSED:
        Path(path).unlink()
    elif error != errno.ENOENT:
        raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE), path)


class _LoopbackSocket(socket.socket):
    """Binds a port on loopback, whatever address it is given, or a Unix socket in its place."""

    def __init__(self, family: int, kind: int) -> None:
        super().__init__(family if socket_path(0) is None else socket.AF_UNIX, kind)

    def bind(self, address: Any) -> None:
        path = socket_path(address[1])
        if path is None:
            super().bind((LOOPBACK, address[1]))
            return
        _vacate(path)
        super().bind(path)
        Path(path).chmod(0o600)
        self.listen()  # or another one would take it for a dead one's: uvicorn listens a turn later


class _Sockets:
    """The module `socket`, as Serve's HTTP server sees it."""

    AF_INET6 = socket.AF_INET
    socket = _LoopbackSocket

    def __getattr__(self, name: str) -> Any:
        return getattr(socket, name)


SOCKETS = _Sockets()


def _sockets(module: Any) -> _Sockets:
    """Return what stands in for the module `socket` in Serve's HTTP server."""
    if module not in (socket, SOCKETS):
        import ray

        raise RuntimeError(f"Ray {ray.__version__} opens its HTTP ports in another way than {KNOWN} does")
    return SOCKETS
