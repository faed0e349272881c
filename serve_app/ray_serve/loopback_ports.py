"""Ports that Ray Serve's processes open for each other, bound to loopback.

A server of one machine needs one port that others reach: HAProxy's, or without HAProxy that of Serve's own proxy. Serve
(ray 2.60) binds the replicas' HTTP ports and the fallback proxy's where the public port is, and gRPC ports to every
interface, whatever it is told. `rlservo serve` sets the variable; a cluster of several machines cannot have it, since
its machines ask each other. Ray's own ports follow the node's address, which `launcher.py` and `cluster_process.py`
set.

Serve calls `ingress.middlewares` in each process before it binds anything, and that calls `install`.
"""

from __future__ import annotations

import os
import socket
from typing import Any

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
    import ray
    from ray.serve._private import default_impl, http_util, replica
    from ray.serve._private.constants import RAY_SERVE_ENABLE_HA_PROXY

    http: Any = http_util  # what they import they do not export
    own: Any = replica
    try:
        # A second time changes nothing. Serve pickles its proxy's class with the functions it calls, hence the names
        # that those look up.
        if os.environ[VARIABLE] == ALL:
            default_impl.add_grpc_address = _on_loopback(default_impl.add_grpc_address)
        if RAY_SERVE_ENABLE_HA_PROXY:  # otherwise Serve's own proxy is the public one, and replicas have no port
            if http.socket not in (socket, SOCKETS):
                raise AttributeError("its HTTP server has no module 'socket'")
            http.socket = SOCKETS
        own.add_port_to_grpc_server = _on_loopback(own.add_port_to_grpc_server)
    except AttributeError as error:
        raise RuntimeError(f"Ray {ray.__version__} binds its ports in another way than 2.60 does: {error}") from error


def _on_loopback(add: Any) -> Any:
    """Wrap a function that binds a gRPC server to an address `host:port`."""

    def add_on_loopback(server: Any, address: str) -> Any:
        return add(server, f"{LOOPBACK}:{address.rpartition(':')[2]}")

    return add_on_loopback


class _LoopbackSocket(socket.socket):
    """A TCP socket that binds its port on loopback, whatever address it is given."""

    def bind(self, address: Any) -> None:
        super().bind((LOOPBACK, address[1]))


class _Sockets:
    """The module `socket`, as Serve's HTTP server sees it."""

    AF_INET6 = socket.AF_INET
    socket = _LoopbackSocket

    def __getattr__(self, name: str) -> Any:
        return getattr(socket, name)


SOCKETS = _Sockets()
