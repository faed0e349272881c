"""Server addresses, and whether only this machine can reach them."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from urllib.parse import SplitResult, urlsplit

from rlservo.export.contract.errors import UsageError


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a server that listens on `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name may point anywhere
        return False


def parse_address(url: str, schemes: Mapping[str, str]) -> str:
    """Return `url` with its scheme replaced by `schemes`, without a trailing slash. Raises UsageError."""
    parts = urlsplit(url)
    try:
        has_host = bool(parts.hostname) and parts.port != 0
        host_of(parts)  # UnicodeError, a ValueError: a name that cannot be encoded
    except ValueError:
        has_host = False
    if parts.scheme not in schemes or not has_host:
        raise UsageError(f"{url!r} is not a server address: expected for example 'http://127.0.0.1:8000'")
    if parts.query or parts.fragment:
        raise UsageError(f"{url!r} has a query or fragment: expected only scheme, host, port and path")
    return parts._replace(scheme=schemes[parts.scheme]).geturl().rstrip("/")


def host_of(parts: SplitResult) -> bytes:
    """Return a host in its encoded form."""
    return (parts.hostname or "").encode("idna")
