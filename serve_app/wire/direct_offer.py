"""Header of a reply in which a server offers its direct port to clients of its own machine.

An address says little about who listens there: `localhost:8000` may lead elsewhere, through a tunnel or into a
container, and `localhost:8001` to somebody else. So an offer names the machine and its network namespace, too, and a
client takes one from its own alone: there the address is the server's.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

from rlservo.serve_app.wire.request_stamp import BOOT_ID

OFFER = "x-rlservo-direct"  # the header: `host:port` that the replicas listen on themselves, and where that holds
NAMESPACE = Path("/proc/self/ns/net")
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}


def network_id() -> str | None:
    """Return what two processes have in common for which an address leads to the same listener."""
    with contextlib.suppress(OSError):
        return hashlib.sha256(f"{BOOT_ID.read_text()} {NAMESPACE.readlink()}".encode()).hexdigest()[:16]
    return None


def make_offer(host: str, port: int) -> str | None:
    """Return the header's value for a server that listens there, None where a machine cannot be told from another."""
    place = network_id()
    host = EVERYWHERE.get(host.strip("[]"), host.strip("[]"))
    return None if place is None else f"[{host}]:{port} {place}" if ":" in host else f"{host}:{port} {place}"


def find_offer(value: str) -> tuple[str, int] | None:
    """Return (host, port) of an offer that holds for this process."""
    address, _, place = value.partition(" ")
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port[:6]) < 65536 or place != network_id():
        return None
    return host.strip("[]"), int(port)
