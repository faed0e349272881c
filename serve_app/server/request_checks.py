"""Checks of a request before it is routed: the form of its path, the host it names, the web page that sends it.

A browser lets any page send requests to any address that it reaches, the robot's own computer included, and lets it
read the answers where the page's name leads to that address ("DNS rebinding"). So a request says which host it is for,
and that must be one of this server's; and what may change something must not come from a page of another origin.
Robots, their clients and proxies send neither an `Origin` nor a `Sec-Fetch-Site`.

Sources: Fetch Standard, section 3.1 (Origin); W3C Fetch Metadata Request Headers; RFC 9110, section 7.2 (Host).
"""

from __future__ import annotations

import ipaddress
import re
import socket
from typing import TYPE_CHECKING

from rlservo.export.contract.errors import ForbiddenError, RequestError
from rlservo.serve_app.server.api_keys import SCHEMES
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.wire.loopback import is_loopback

if TYPE_CHECKING:
    from starlette.types import Scope

# Every path of ours can be written in it. What needs escaping, or is read differently by different programs, is not
# routed at all: control characters, encoded and doubled slashes, dot segments, ';', '\'.
PATH = re.compile(r"(?:/(?!\.\.?(?:/|\Z))[A-Za-z0-9._~-]+)*/?")
HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+?)\.?(?::[0-9]{1,5})?")
SECONDS = re.compile(rb"[0-9]{1,9}(\.[0-9]{1,9})?")
READING = frozenset({"GET", "HEAD", "OPTIONS"})  # methods that change nothing
OWN_SITES = frozenset({b"same-origin", b"none"})  # 'none' is the user, not a page; 'same-site' is another port or name
UNREADABLE = b"x-rlservo-unreadable"  # says which header is not UTF-8, where `mend_headers` has made it so
TIMEOUT = b"x-request-timeout-seconds"  # Ray Serve's; infinity makes its event loop raise
PAGE_SCHEMES = (b"http://", b"https://")  # a proxy may have ended TLS
HOSTS_REMEMBERED = 256
ANY_HOST = "*"


def check_path(scope: Scope, path: str) -> None:
    """Raise RequestError unless the path is written in the one way in which a path of ours can be."""
    if b"%" in (scope.get("raw_path") or b"") or PATH.fullmatch(path) is None:
        raise RequestError(
            "the path is not usable: it may hold letters, digits, '.', '_', '-' and '~' between single slashes, "
            "without percent-encoding and without the segments '.' and '..'"
        )


class Hosts:
    """The names and addresses by which requests may call this server."""

    def __init__(self, listening_on: str, settings: ServerSettings, *, keyed: bool) -> None:
        """Take the address listened on; `keyed`: whether every action needs an API key."""
        names = {name.strip().lower() for name in settings.allowed_hosts.split(",")} - {""}
        self._local = is_loopback(listening_on)
        # A page does not know the key, whatever name it is of; and clusters call servers by many names.
        self._any = ANY_HOST in names or (keyed and not self._local and not names)
        self._names = names | {"localhost", listening_on.strip("[]").lower()}
        if not self._local:
            self._names |= {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        self._seen: dict[bytes, bool] = {}

    def permit(self, host: bytes) -> bool:
        """Return whether a request with this `Host` is for this server."""
        permitted = self._seen.get(host)
        if permitted is None:
            if len(self._seen) >= HOSTS_REMEMBERED:
                self._seen.clear()
            permitted = self._seen[host] = self._any or self._is_ours(host.decode("latin-1").lower())
        return permitted

    def _is_ours(self, host: str) -> bool:
        match = HOST.fullmatch(host)
        if match is None:
            return False
        name = match["name"].strip("[]")
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        # An address cannot be made to lead elsewhere, as a name can. Orchestrators probe by address.
        return address.is_loopback or not self._local


class RequestChecks:
    """Reads a request's headers, once, and refuses what no client of ours sends."""

    def __init__(self, hosts: Hosts) -> None:
        self._hosts = hosts

    def read(self, scope: Scope) -> tuple[bytes | None, str | None]:
        """Return (the API key presented, the name of a header that is not UTF-8); None for what is not there.

        Raises ForbiddenError for another host's request or another origin's page, RequestError for two hosts.
        """
        host = origin = site = key = unreadable = None
        for name, value in scope["headers"]:
            if name == b"host":
                if host is not None:
                    raise RequestError("the request has two Host headers: send one")
                host = value
            elif name == b"origin":  # of several, which no browser sends, none is anybody's
                origin = value if origin is None else b"several origins"
            elif name == b"sec-fetch-site":
                site = value if site is None else b"several"
            elif name == b"authorization":
                if key is None:
                    key = _bearer(value)
            elif name == b"x-api-key" and key is None:
                key = value.strip()
            elif name == UNREADABLE:
                unreadable = value.decode("latin-1")
            if not value.isascii() and not _is_utf8(value):
                unreadable = name.decode("latin-1")
        if host is not None and not self._hosts.permit(host):
            raise ForbiddenError(
                f"this server is not called '{host[:100].decode('latin-1')}': call it by its address, or name it in "
                "RLSERVO_ALLOWED_HOSTS"
            )
        if (origin is not None or site is not None) and (
            scope["type"] == "websocket" or scope["method"] not in READING
        ):
            _check_page(origin, site, host)
        return key, unreadable


def mend_headers(headers: list[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    """Return headers that Ray Serve (2.60) can read, which decodes some as UTF-8 and answers what it cannot with 500.

    `RequestChecks` refuses such a request later, when it has seen the key.
    """
    mended: list[tuple[bytes, bytes]] = []
    for name, value in headers:
        if not value.isascii() and not _is_utf8(value):
            mended += [(name, value.decode("latin-1").encode()), (UNREADABLE, name)]
        elif name != TIMEOUT or SECONDS.fullmatch(value):
            mended.append((name, value))
    return mended


def _is_utf8(value: bytes) -> bool:
    try:
        value.decode()
    except UnicodeDecodeError:
        return False
    return True


def presented_key(headers: list[tuple[bytes, bytes]]) -> bytes | None:
    """Return the API key among the headers, where only that is wanted (gRPC)."""
    for name, value in headers:
        key = _bearer(value) if name == b"authorization" else value.strip() if name == b"x-api-key" else None
        if key is not None:
            return key
    return None


def _bearer(value: bytes) -> bytes | None:
    scheme, _, key = value.partition(b" ")
    return key.strip() if scheme.lower() in SCHEMES else None


def _check_page(origin: bytes | None, site: bytes | None, host: bytes | None) -> None:
    if site is not None and site.strip().lower() not in OWN_SITES:
        raise ForbiddenError("a web page of another site may ask nothing of this server")
    own = () if host is None else {scheme + host.lower() for scheme in PAGE_SCHEMES}
    if origin is not None and origin.lower() not in own:
        raise ForbiddenError(
            f"a web page of {origin[:100].decode('latin-1')} may ask nothing of this server: only its own may"
        )
