"""Unix sockets by which HAProxy asks the replicas of a server of one machine, instead of their TCP ports.

Loopback's TCP costs a request more than HAProxy's own work does, and nobody but this user can connect to these. Whose
port would be 30000 has the file `30000.sock` in the folder that the variable names.
"""

from __future__ import annotations

import os

VARIABLE = "RLSERVO_REPLICA_SOCKETS"
ASKER = ("127.0.0.1", 0)
"""Who asks by a socket that has no address: HAProxy, whose word for whom it asks uvicorn takes from this machine."""


def socket_path(port: int | str) -> str | None:
    """Return the path of the socket in a port's place; None where TCP is meant."""
    folder = os.environ.get(VARIABLE)
    return None if folder is None else f"{folder}/{port}.sock"
