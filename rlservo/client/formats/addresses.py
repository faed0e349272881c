"""Server addresses, and whether only this machine can reach them."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from urllib.parse import quote, urlsplit

from rlservo.errors import UsageError

PATH_CHARACTERS = "/%:@!$&'()*+,;=~"  # of a path, kept as given


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a server that listens on `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name may point anywhere
        return False


def parse_address(url: str, schemes: Mapping[str, str]) -> str:
    """Return `url` in ASCII, with its scheme replaced by `schemes`, without a user and a trailing slash.

    Raises UsageError.
    """
    parts = urlsplit(url)
    try:
        host, port = (parts.hostname or "").encode("idna").decode(), parts.port
    except ValueError:  # a port beyond 65535, or (UnicodeError) a name that cannot be encoded
        host, port = "", None
    if parts.scheme not in schemes or not host or port == 0:
        raise UsageError(f"{url!r} is not a server address: expected for example 'http://127.0.0.1:8000'")
    if parts.query or parts.fragment:
        raise UsageError(f"{url!r} has a query or fragment: expected only scheme, host, port and path")
    place = (f"[{host}]" if ":" in host else host) + ("" if port is None else f":{port}")
    return f"{schemes[parts.scheme]}://{place}{quote(parts.path, safe=PATH_CHARACTERS)}".rstrip("/")
