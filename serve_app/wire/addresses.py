"""Addresses of servers, and whether only this machine reaches them."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from urllib.parse import SplitResult, urlsplit

from rlservo.export.contract.errors import UsageError


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens on `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name: wherever it points
        return False


def parse_address(url: str, schemes: Mapping[str, str]) -> str:
    """Return `url` under the scheme that `schemes` has for its own, without a slash at its end. Raises UsageError."""
    parts = urlsplit(url)
    try:
        has_host = bool(parts.hostname) and parts.port != 0
        host_of(parts)  # UnicodeError, a ValueError: a name that no wire can carry
    except ValueError:
        has_host = False
    if parts.scheme not in schemes or not has_host:
        raise UsageError(f"{url!r} is not a server address: expected for example 'http://127.0.0.1:8000'")
    if parts.query or parts.fragment:
        raise UsageError(f"{url!r} has a query or fragment: expected only scheme, host, port and path")
    return parts._replace(scheme=schemes[parts.scheme]).geturl().rstrip("/")


def host_of(parts: SplitResult) -> bytes:
    """Return a host as the wire has it."""
    return (parts.hostname or "").encode("idna")
