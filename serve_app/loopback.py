"""Ports that Ray Serve's processes open for each other, bound to loopback.

A server of one machine needs one port that others reach: HAProxy's, or without HAProxy that of Serve's own proxy. Serve
(ray 2.60) binds the replicas' HTTP ports and the fallback proxy's where the public port is, and gRPC ports to every
interface, whatever it is told. `rlservo serve` sets the variable; a cluster of several machines cannot have it, since
its machines ask each other. Ray's own ports follow the node's address, which `launcher.py` and `cluster.py` set.

Serve calls `ingress.middlewares` in each process before it binds anything, and that calls `install`.
"""

from __future__ import annotations

import os
from typing import Any

VARIABLE = "RLSERVO_BIND_LOOPBACK"
LOOPBACK = "127.0.0.1"


def is_wanted() -> bool:
    """Whether this process belongs to a server of one machine."""
    return os.environ.get(VARIABLE) == "1"


def install() -> None:
    """Bind to loopback what this process opens from now on. Raises RuntimeError where Ray's names have moved."""
    import ray
    from ray.serve._private import default_impl, proxy, replica
    from ray.serve._private.constants import RAY_SERVE_ENABLE_HA_PROXY

    try:
        # A second time changes nothing.
        default_impl.add_grpc_address = _on_loopback(default_impl.add_grpc_address)
        replica.add_port_to_grpc_server = _on_loopback(replica.add_port_to_grpc_server)
        replica.start_asgi_http_server = _with_loopback_host(replica.start_asgi_http_server)
        if RAY_SERVE_ENABLE_HA_PROXY:  # Serve's own proxy is then the fallback behind it
            proxy.start_asgi_http_server = _with_loopback_host(proxy.start_asgi_http_server)
    except AttributeError as error:
        raise RuntimeError(f"Ray {ray.__version__} binds its ports in another way than 2.60 does: {error}") from error


def _on_loopback(add: Any) -> Any:
    """Wrap a function that binds a gRPC server to an address `host:port`."""

    def add_on_loopback(server: Any, address: str) -> Any:
        return add(server, f"{LOOPBACK}:{address.rpartition(':')[2]}")

    return add_on_loopback


def _with_loopback_host(start: Any) -> Any:
    """Wrap the function that starts an HTTP server with options that name the host."""

    def start_on_loopback(app: Any, http_options: Any, **more: Any) -> Any:
        return start(app, http_options.model_copy(update={"host": LOOPBACK}), **more)

    return start_on_loopback
