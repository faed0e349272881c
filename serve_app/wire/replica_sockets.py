"""Unix sockets by which HAProxy asks the replicas of a server of one machine, instead of their TCP ports.

Loopback's TCP costs a request more than HAProxy's own work does, and nobody but this user can connect to these. Whose
port would be 30000 has the file `30000.sock` in the folder that the variable names.
"""

from __future__ import annotations

import os
import socket
from typing import Any

VARIABLE = "RLSERVO_REPLICA_SOCKETS"
ASKER = ("127.0.0.1", 0)
"""Who asks over a Unix socket: HAProxy, whose word for whom it asks uvicorn takes, as from this machine."""


def socket_path(port: int | str) -> str | None:
    """Return the path of the socket in a port's place; None where TCP is meant."""
    folder = os.environ.get(VARIABLE)
    return None if folder is None else f"{folder}/{port}.sock"


def is_unix(transport: Any) -> bool:
    """Whether a connection came over a Unix socket. (A TCP connection that was reset has no address either.)"""
    connection = transport.get_extra_info("socket")
    return connection is not None and connection.family == socket.AF_UNIX
