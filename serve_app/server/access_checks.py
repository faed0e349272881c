"""Checks of a request before its body is read: form of the path, host, origin of the page, API key.

A browser lets any page send requests to any address that it reaches, including the robot's own computer, and lets it
read the answers if the page's name resolves to that address ("DNS rebinding"). So a request names the host it is for,
which must be this server; and a request that may change something must not come from a page of another origin. Robots,
their clients and proxies send neither an `Origin` nor a `Sec-Fetch-Site`.

Sources: Fetch Standard, section 3.1 (Origin); W3C Fetch Metadata Request Headers; RFC 9110, section 7.2 (Host).
"""

from __future__ import annotations

import functools
import ipaddress
import re
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rlservo.client.formats.addresses import is_loopback
from rlservo.client.formats.request_names import LABEL_HEADER
from rlservo.errors import ForbiddenError, RequestError, UnauthenticatedError
from rlservo.serve_app.server.api_keys import SCHEMES, Access, Key, Role
from rlservo.serve_app.server.settings import ServerSettings

if TYPE_CHECKING:
    from starlette.types import Scope

    from rlservo.serve_app.server.current_keys import CurrentKeys

# Enough for every path of ours. Characters that need escaping, or that programs read differently, are never routed:
# control characters, encoded and doubled slashes, dot segments, ';', '\'.
PATH = re.compile(r"(?:/(?!\.\.?(?:/|\Z))[A-Za-z0-9._~-]+)*/?")
HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+?)\.?(?::[0-9]{1,5})?")
READING = frozenset({"GET", "HEAD", "OPTIONS"})  # methods that change nothing
OWN_SITES = frozenset({b"same-origin", b"none"})  # 'none' is the user, not a page; 'same-site' is another port or name
ALL_COUNT = frozenset({b"host", b"origin", b"sec-fetch-site", b"content-type", b"content-encoding"})
PAGE_SCHEMES = (b"http://", b"https://")  # a proxy may have ended TLS
HOSTS_REMEMBERED = 256
REQUEST_ID = b"x-request-id"
LABEL = LABEL_HEADER.encode()
HOW = " (rlservo's commands: RLSERVO_API_KEY)"
ANY_HOST = "*"


def check_path(scope: Scope, path: str) -> None:
    """Raise RequestError unless the path is written in the only form that this server routes."""
    if b"%" in (scope.get("raw_path") or b"") or PATH.fullmatch(path) is None:
        raise RequestError(
            "the path is not valid: expected letters, digits, '.', '_', '-' and '~' between single slashes, "
            "without percent-encoding and without the segments '.' and '..'"
        )


class OriginChecks:
    """Refuses HTTP requests and WebSockets for another host, or from a page of another origin."""

    def __init__(self, listening_on: str, settings: ServerSettings, *, keyed: bool) -> None:
        """Take the address that the server listens on; `keyed`: whether every action needs an API key."""
        names = {name.strip().lower() for name in settings.allowed_hosts.split(",")} - {""}
        self._local = is_loopback(listening_on)
        # A page does not know the key, whatever its name; and clusters call servers by many names.
        self._any = ANY_HOST in names or (keyed and not self._local and not names)
        self._names = names | {"localhost", listening_on.strip("[]").lower()}
        if not self._local:
            self._names |= {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        self.permit = functools.lru_cache(HOSTS_REMEMBERED)(self._permit)
        """Returns whether a request with this `Host` is for this server."""

    def check(self, scope: Scope, headers: Mapping[bytes, bytes]) -> None:
        """Raise ForbiddenError for another host's request or another origin's page, RequestError for two hosts.

        `headers` are the scope's (`fold_headers`).
        """
        host = headers.get(b"host")
        if host is not None and b"," in host:
            raise RequestError("the request has two Host headers: send one")
        if host is not None and not self.permit(host):
            raise ForbiddenError(
                f"the request names the host '{host[:100].decode('latin-1')}': use the server's address, or add the "
                "name to RLSERVO_ALLOWED_HOSTS"
            )
        if (b"origin" in headers or b"sec-fetch-site" in headers) and (
            scope["type"] == "websocket" or scope["method"] not in READING
        ):
            _check_page(headers.get(b"origin"), headers.get(b"sec-fetch-site"), host)

    def _permit(self, host: bytes) -> bool:
        match = HOST.fullmatch(host.decode("latin-1").lower())
        if match is None or self._any:
            return self._any
        name = match["name"].strip("[]")
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        # An address cannot be redirected, as a name can. Orchestrators probe by address.
        return address.is_loopback or not self._local


def authorize(keys: CurrentKeys, presented: bytes | None, access: Access) -> Key | None:
    """Return the key that permits a route or a method; None if it needs none.

    The call counts as a request with that key. Raises UnauthenticatedError, ForbiddenError or RateLimitError.
    """
    if access is Access.open:
        return None
    admin, accepted = access is not Access.act, keys.accepted
    if not accepted.keys and not (admin and accepted.operator):
        if admin:
            raise ForbiddenError(
                "administration needs an admin key, and this server has none: see 'rlservo key --help'"
            )
        return None
    if presented is None:
        what, how = ("administration needs an admin", "") if admin else ("this server requires an API", HOW)
        raise UnauthenticatedError(f"{what} key: send 'Authorization: Bearer KEY'{how}")
    key = accepted.find(presented)
    if key is None:
        raise UnauthenticatedError("the server does not know this API key")
    if key.limit is not None:
        keys.limits.spend(key, key.limit)
    if admin and key.role is not Role.admin:
        raise ForbiddenError(f"the key '{key.label}' is for actions; this request needs an admin key", key=key.label)
    return key


@dataclass(frozen=True)
class StreamKey:
    """The key of an open stream, checked and counted with every request: it may have been removed since."""

    keys: CurrentKeys
    presented: bytes | None

    def check(self) -> bool:
        """Return whether the key may ask for exploratory actions.

        Raises as `authorize` does; RateLimitError concerns only this request.
        """
        key = authorize(self.keys, self.presented, Access.act)
        return key is None or key.may_explore


def fold_headers(headers: Iterable[tuple[bytes, bytes]]) -> dict[bytes, bytes]:
    """Return headers by name: the first of several with one name, or all of them if each must be right."""
    pairs = list(headers)
    folded = dict(pairs)
    if len(folded) == len(pairs):
        return folded
    folded = {}
    for name, value in pairs:
        folded[name] = folded[name] + b", " + value if name in folded and name in ALL_COUNT else folded.get(name, value)
    return folded


def header_text(headers: Mapping[bytes, bytes], name: bytes) -> str | None:
    """Return a header as text, or None if it is absent."""
    value = headers.get(name)
    return None if value is None else value.decode("latin-1")


def presented_key(headers: Mapping[bytes, bytes]) -> bytes | None:
    """Return the API key among the headers."""
    value = headers.get(b"authorization")
    if value is not None:
        scheme, _, key = value.partition(b" ")
        if scheme.lower() in SCHEMES:
            return key.strip()
    value = headers.get(b"x-api-key")
    return None if value is None else value.strip()


def _check_page(origin: bytes | None, site: bytes | None, host: bytes | None) -> None:
    if site is not None and site.strip().lower() not in OWN_SITES:
        raise ForbiddenError("web pages of other sites may not use this server")
    own = () if host is None else {scheme + host.lower() for scheme in PAGE_SCHEMES}
    if origin is not None and origin.lower() not in own:
        raise ForbiddenError(
            f"a web page of {origin[:100].decode('latin-1')} may not use this server: only its own pages may"
        )
