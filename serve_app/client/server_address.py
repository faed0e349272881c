"""Address of a policy server, as a client is given it."""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import SplitResult, urlsplit

from rlservo.export.contract.errors import UsageError


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
