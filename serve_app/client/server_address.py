"""Address of a policy server."""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import SplitResult, urlsplit

from rlservo.export.contract.errors import UsageError


def parse_address(url: str, schemes: Mapping[str, str]) -> str:
    """Return `url` with its scheme mapped by `schemes`, without a trailing slash. Raises UsageError."""
    parts = urlsplit(url)
    try:
        has_host = bool(parts.hostname) and parts.port != 0
        host_of(parts)  # UnicodeError, a ValueError: a name that no wire can carry
    except ValueError:
        has_host = False
    if parts.scheme not in schemes or not has_host:
        raise UsageError(f"{url!r} is not a server address: expected an address such as 'http://127.0.0.1:8000'")
    if parts.query or parts.fragment:
        raise UsageError(f"{url!r} has a query or fragment: expected only scheme, host, port and path")
    return parts._replace(scheme=schemes[parts.scheme]).geturl().rstrip("/")


def host_of(parts: SplitResult) -> bytes:
    """Return a host in its encoded form."""
    return (parts.hostname or "").encode("idna")
