"""Routing: a route, and the table that finds one by method and path. Each protocol lists its own routes."""

from __future__ import annotations

import functools
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from starlette.types import Receive, Scope, Send

from rlservo.serve_app.protocols.error_statuses import Headers
from rlservo.serve_app.server.access_checks import LABEL, header_text
from rlservo.serve_app.server.api_keys import Access
from rlservo.serve_app.server.logs import AuditEntry
from rlservo.serve_app.sessions.request import Request

GET, POST = "GET", "POST"
WEBSOCKET = "WebSocket:"  # not a method that a client can send: those have no colon
PATHS_REMEMBERED, LONGEST_REMEMBERED = 1024, 512  # the longest that a name and a version can make is 170
PARAMETER = re.compile(r"\\{(\w+)\\}")  # in an escaped path


@dataclass(slots=True)
class Call:
    """A connection that a route answers: its client has been checked."""

    scope: Scope
    receive: Receive
    send: Send
    params: Mapping[str, str]  # of the path
    headers: Mapping[bytes, bytes]
    reply_headers: Headers
    """Headers of the reply besides the protocol's own."""
    audit: AuditEntry
    may_explore: bool = False
    """Whether its key may ask for exploratory actions."""
    body: bytes = b""
    """Read unless the route's `reads_body` says otherwise."""

    def request(self, protocol: str, policy: str = "", version: str | None = None) -> Request:
        """Return a request for an action, whose content is still to be read."""
        label, request_id = header_text(self.headers, LABEL), self.audit.request_id
        request = Request(protocol, policy, version, label=label, request_id=request_id, headers=self.headers)
        request.may_explore = self.may_explore
        return request


Answer: TypeAlias = Callable[[Call], Awaitable[tuple[bytes, Headers] | None]]
"""Returns the body and headers of a reply, or None after a WebSocket. Raises RlservoError and ClientGoneError."""


@dataclass(frozen=True)
class Route:
    """A method, a path such as `/v1/policies/{name}`, and its handler."""

    method: str
    path: str
    access: Access
    summary: str
    answer: Answer
    reads_body: bool = False
    """Whether `answer` reads the body itself, as for actions, or the messages of a WebSocket."""
    is_page: bool = False
    """Only for browsers, which accept HTML and not JSON; for other clients there is no such route."""
    is_documented: bool = True
    """Whether it is in the OpenAPI document."""


def of_policy(
    method: str, prefix: str, suffix: str, summary: str, answer: Answer, *, reads_body: bool = False
) -> list[Route]:
    """Return the routes of a policy's default version, and of a version or an alias."""
    paths = (f"{prefix}/{{name}}{suffix}", f"{prefix}/{{name}}/versions/{{version}}{suffix}")
    return [Route(method, path, Access.act, summary, answer, reads_body=reads_body) for path in paths]


@dataclass(frozen=True, slots=True)
class Found:
    """The route of a connection, and its path's parameters; None if no route has the path and method."""

    route: Route | None
    access: Access
    params: Mapping[str, str]
    allowed: tuple[str, ...] = ()
    """The methods of the path, if it exists."""


class RoutingTable:
    """The routes of an application; the first match counts."""

    def __init__(self, routes: Iterable[Route]) -> None:
        self.routes = tuple(routes)
        self._patterns = [
            (re.compile(PARAMETER.sub(r"(?P<\1>[^/]+)", re.escape(each.path))), each) for each in self.routes
        ]
        self._find = functools.lru_cache(PATHS_REMEMBERED)(self._look_up)

    def find(self, method: str, path: str, accept: bytes) -> Found:
        """Return the route of a connection with this `Accept` header.

        A path with another method has the access of its strictest route; an unknown path needs any key.
        """
        if method == "HEAD":  # the engine leaves out its reply's body
            method = GET
        wants_page = method == GET and b"text/html" in accept.lower() and b"json" not in accept
        # Anyone may send paths, of 16 KB each: long ones are not kept in memory.
        look_up = self._find if len(method) + len(path) <= LONGEST_REMEMBERED else self._look_up
        return look_up(method, path, wants_page)

    def _look_up(self, method: str, path: str, wants_page: bool) -> Found:
        others: list[Route] = []
        for pattern, route in self._patterns:
            match = pattern.fullmatch(path)
            if match is None or (route.method == WEBSOCKET) is not (method == WEBSOCKET):
                continue
            if route.is_page and not wants_page:
                continue
            if route.method == method:
                return Found(route, route.access, match.groupdict())
            others.append(route)
        levels = {route.access for route in others} or {Access.act}
        access = next(level for level in (Access.admin, Access.act, Access.open) if level in levels)
        return Found(None, access, {}, tuple(sorted({route.method for route in others})))
