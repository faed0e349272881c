"""Access to routes: every route, in every spelling of its path, as bytes on a socket, with an insufficient key.

A path that a check reads differently from the router is a way around the check, so no client that normalizes paths is
used.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import socket
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from bundles import controlled
from rlservo.errors import UsageError
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.protocols.pages import FOLDER, SWAGGER_FILES
from rlservo.serve_app.protocols.routing import WEBSOCKET
from rlservo.serve_app.server.api_keys import Access, new_key
from rlservo.serve_app.server.logs import FIELDS, configure
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower
from servers import over_uvicorn

Controlled = Callable[..., AbstractContextManager[PlanFollower]]

ROBOT, ROBOT_LINE = new_key("cell-7")
ADMIN, ADMIN_LINE = new_key("boss", admin=True)
WRONG, _ = new_key("nobody")
BODY = b'{"obs": [0], "version": "1", "alias": "production"}'
OBS = b'{"obs": [0]}'
COMMANDS = ("load", "unload", "alias", "rollback", "canary", "shadow")
ADMIN_PATHS = (
    *(f"/v1/admin/policies/{{name}}/{command}" for command in COMMANDS),
    "/v2/repository/models/{name}/load",
    "/v2/repository/models/{name}/unload",
    "/v1/admin/recordings",
    "/v1/admin/recordings/{file}/{begin}",
)
# What programs are known to drop, to decode twice, to take for a slash, or to end a line or a path at.
INSERTED = (
    *(b"%0a %0d %0d%0a %00 %09 %20 %7f %85 %c2%85 %e2%80%a8 %e2%80%a9 %c2%a0 %ef%bb%bf %ff".split()),
    *(b"%2f %2F %252f %5c \\ / // /. /./ /.. /../ /x/.. %2e %2e%2e /%2e%2e/ /..;/".split()),
    *(b";x ;x=1 ;/ . .. .json ~ * + @ :".split()),
    *(b"? ?x ?%0a # #x %23 %3f %3b %250a %u000a %".split()),
    *(b"\x01 \x7f \x80 \xc2\x85 \xe2\x80\xa8 \xff".split()),
    b"\t",
    b"\x0b",
    b"\x00",
)  # fmt: skip


WELL_FORMED = re.compile(rb"/[!-~]*")
AHEAD = 32  # requests on their way at once


def spellings(path: str) -> Iterator[bytes]:
    """Yield spellings of a path."""
    plain = path.encode()
    yield plain
    yield plain.upper()
    yield plain.title()
    yield b"http://127.0.0.1" + plain
    yield b"http://evil.example" + plain
    yield b"//evil.example" + plain
    cuts = sorted({0, 1, len(plain), *(index for index in range(len(plain)) if plain[index : index + 1] == b"/")})
    for inserted in INSERTED:
        for cut in cuts:
            yield plain[:cut] + inserted + plain[cut:]
    for index in (1, len(plain) // 2, len(plain) - 1):  # one of its own characters, escaped
        if index < len(plain):
            yield plain[:index] + b"%%%02x" % plain[index] + plain[index + 1 :]
    yield plain.replace(b"/", b"%2f")
    yield plain[:1] + plain[1:].replace(b"/", b"\\")


def plain_of(target: bytes) -> str:
    """Return the path that a target means, where it is written as it should be."""
    for absolute in (b"http://127.0.0.1", b"http://evil.example"):  # a browser writes so to proxies alone
        target = target.removeprefix(absolute)
    return target.partition(b"#")[0].partition(b"?")[0].decode("latin-1")


class Wire:
    """A connection that sends requests byte for byte, and another one when that is gone."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket: socket.socket | None = None
        self._replies: BinaryIO | None = None

    def ask(self, method: bytes, target: bytes, *headers: bytes, body: bytes = BODY) -> tuple[int, bytes]:
        content = self._request(method, target, headers, body)
        for _ in range(2):  # it may have been closed since the last answer
            with contextlib.suppress(ConnectionError):
                return self._exchange(method, content)
            self.close()
        return 0, b""  # closed without a word

    def ask_each(self, requests: Sequence[tuple[bytes, bytes, tuple[bytes, ...]]]) -> Iterator[tuple[int, bytes]]:
        """Yield the replies to requests (method, target, headers) that are sent ahead, so many at once as `AHEAD` says.

        Where the connection is closed in between, those without a reply are sent again, one by one.
        """
        for start in range(0, len(requests), AHEAD):
            some = requests[start : start + AHEAD]
            replies: list[tuple[int, bytes]] = []
            with contextlib.suppress(ConnectionError):
                self._send(b"".join(self._request(*request, BODY) for request in some))
                while len(replies) < len(some) and self._socket is not None:
                    replies.append(self._reply(some[len(replies)][0]))
            if len(replies) < len(some):
                self.close()
            yield from replies
            for method, target, headers in some[len(replies) :]:
                yield self.ask(method, target, *headers)

    @staticmethod
    def _request(method: bytes, target: bytes, headers: tuple[bytes, ...], body: bytes) -> bytes:
        lines = [method + b" " + target + b" HTTP/1.1", b"host: 127.0.0.1", b"content-type: application/json", *headers]
        return b"\r\n".join([*lines, b"content-length: %d" % len(body), b"", body])

    def _exchange(self, method: bytes, content: bytes) -> tuple[int, bytes]:
        self._send(content)
        return self._reply(method)

    def _send(self, content: bytes) -> None:
        if self._socket is None:
            self._socket = socket.create_connection(("127.0.0.1", self._port), timeout=30)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._replies = self._socket.makefile("rb")
        self._socket.sendall(content)

    def _reply(self, method: bytes) -> tuple[int, bytes]:
        assert self._replies is not None
        # By hand: http.client takes as long to read a reply as the server to give it.
        version, _, status = self._replies.readline().partition(b" ")
        if not version:
            raise ConnectionResetError("closed without a reply")
        assert version == b"HTTP/1.1", version
        headers = {}
        while line := self._replies.readline().rstrip():
            name, _, value = line.partition(b":")
            headers[name.lower()] = value.strip().lower()
        code = int(status[:3])
        answer = self._body(headers) if method != b"HEAD" and code not in (101, 204, 304) else b""
        if headers.get(b"connection") == b"close" or code == 101:
            self.close()
        return code, answer

    def _body(self, headers: dict[bytes, bytes]) -> bytes:
        assert self._replies is not None
        if headers.get(b"transfer-encoding") != b"chunked":
            return self._replies.read(int(headers[b"content-length"]) if b"content-length" in headers else -1)
        body = b""
        while size := int(self._replies.readline(), 16):
            body += self._replies.read(size)
            self._replies.readline()
        self._replies.readline()
        return body

    def close(self) -> None:
        if self._socket is not None and self._replies is not None:
            self._replies.close()
            self._socket.close()
            self._socket = self._replies = None

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class Served:
    app: PolicyApp
    control: PlanFollower
    port: int
    kind: str

    @property
    def plan(self) -> Any:
        return self.control.plan


@pytest.fixture(params=["keys", "operator", "none"])
def server(request: pytest.FixtureRequest, policies: Path) -> Iterator[Served]:
    """With keys of both kinds; with an operator's key alone; with none."""
    settings = {
        "keys": ServerSettings(api_keys=f"{ROBOT_LINE},{ADMIN_LINE}"),
        "operator": ServerSettings(operator_key=ADMIN_LINE.split()[-1]),
        "none": ServerSettings(),
    }[request.param]
    with controlled(policies) as control:
        app = create_app(control, settings)
        with over_uvicorn(app) as port:
            yield Served(app, control, port, request.param)


@pytest.fixture(scope="module")
def app(policies: Path) -> Iterator[PolicyApp]:
    with controlled(policies) as control:
        yield create_app(control, ServerSettings())


def paths(app: PolicyApp) -> list[tuple[str, str, Access]]:
    """Return (method, path with real names, who may use it) of every route, streams and files included."""
    found = []
    for route in app.table.routes:
        path = route.path.replace("{name}", "ur5").replace("{version}", "1")
        path = path.replace("{file}", "dom.js").replace("{begin}", "0")
        found.append(("GET" if route.method == WEBSOCKET else route.method, path, route.access))
    return found


def test_only_probes_and_the_page_are_open_and_only_admins_administer(app: PolicyApp) -> None:
    levels = {(route.path, route.access) for route in app.table.routes}
    assert {path for path, access in levels if access is Access.admin} == set(ADMIN_PATHS)
    opened = {path for path, access in levels if access is Access.open}
    page = {f"/page/{file.name}" for file in FOLDER.iterdir() if file.suffix != ".html"}
    docs = {"/openapi.json", "/docs", *(f"/docs/{name}" for name in SWAGGER_FILES)}
    assert opened == {"/", "/healthz", "/v2/health/live", "/v2/health/ready", *page, *docs}
    assert ("/", Access.act) in levels  # the stream; the page is another route, for GET alone


def bearer(key: str) -> tuple[bytes, ...]:
    return (b"authorization: Bearer " + key.encode(),)


def attempts(app: PolicyApp, kind: str) -> Iterator[tuple[bytes, bytes, str | None, Access]]:
    """Yield (method, target, key, who may use it): with keys that do not suffice, or none.

    A byte that ends a connection ends it before a key is read: one of the keys, and the path's own method.
    """
    for method, path, access in paths(app):
        if access is Access.admin:
            keys, methods = [None, WRONG, ROBOT], [method, *({"POST"} - {method})]
        elif kind == "keys":
            keys, methods = [WRONG], [method]
        else:
            continue
        for target in spellings(path):
            formed = WELL_FORMED.fullmatch(target)
            for key in keys if formed else keys[-1:]:
                for verb in methods if formed else methods[:1]:
                    yield verb.encode(), target, key, access


def test_no_spelling_of_a_path_gets_around_the_keys(server: Served) -> None:
    before, asked = server.plan, 0
    opened = {path for _, path, access in paths(server.app) if access is Access.open}
    # One with a byte that ends a connection goes alone: it would take the replies before it along.
    tried = sorted(attempts(server.app, server.kind), key=lambda attempt: WELL_FORMED.fullmatch(attempt[1]) is None)
    requests = [(verb, target, () if key is None else bearer(key)) for verb, target, key, _ in tried]
    formed = sum(WELL_FORMED.fullmatch(target) is not None for _, target, _, _ in tried)
    with Wire(server.port) as wire:
        replies = chain(
            wire.ask_each(requests[:formed]), (wire.ask(verb, target, *key) for verb, target, key in requests[formed:])
        )
        for (verb, target, key, access), (status, answer) in zip(tried, replies, strict=True):
            shown = (verb, target, key and key[:12], status, answer[:200])
            asked += 1
            assert status < 500, shown
            if access is not Access.open:
                assert status in (0, 400, 401, 403, 404, 405), shown
                assert status != 404 or key == ROBOT or server.kind != "keys", shown
            elif 200 <= status < 300:
                assert plain_of(target).rstrip("/") in opened, shown
    assert asked > 1000
    assert server.plan == before and server.control.store is not None
    assert server.control.store.names == ("gridworld", "ur5")


def test_asking_for_html_opens_nothing_but_the_page(server: Served) -> None:
    page, html, opened = (FOLDER / "index.html").read_bytes(), b"accept: text/html", 0
    closed = 401 if server.kind == "keys" else 404
    with Wire(server.port) as wire:
        for target in spellings("/"):
            status, answer = wire.ask(b"GET", target, html, *bearer(WRONG), body=b"")
            if plain_of(target) == "/" and status == 200:
                assert answer == page, target
                opened += 1
            else:
                assert status in (0, 400, 401, 403, 404), (target, status, answer[:200])
        for verb in (b"POST", b"PUT", b"DELETE", b"PATCH", b"OPTIONS", b"TRACE"):  # as if there were no page
            assert wire.ask(verb, b"/", html, body=b"")[0] == closed, verb
        if server.kind == "keys":
            for method, path, access in paths(server.app):
                if access is not Access.open:
                    assert path == "/" or wire.ask(method.encode(), path.encode(), html, body=b"")[0] == 401, path
    assert opened > 1


def test_other_methods_of_a_path_are_kept_as_its_own_is(server: Served) -> None:
    with Wire(server.port) as wire:
        for method, path, access in paths(server.app):
            for verb in ("GET", "HEAD", "OPTIONS", "POST", "PUT", "DELETE", "PATCH", "TRACE", "QUERY"):
                if verb == method:
                    continue
                status, _ = wire.ask(verb.encode(), path.encode(), body=b"")
                shown = (verb, path, status)
                if access is Access.admin:
                    assert status in ((401,) if server.kind != "none" else (403,)), shown
                elif access is Access.act and server.kind == "keys":
                    assert status == 401, shown
                else:
                    assert status < 500, shown


def test_no_method_of_http_leads_to_a_stream(app: PolicyApp) -> None:
    sent: list[Any] = []

    async def ask(method: str) -> int:
        async def receive() -> Any:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {"type": "http", "method": method, "path": "/v1/policies/ur5/stream", "headers": [], "client": None}
        await app(scope, receive, send)
        return int(sent[-2]["status"])

    # h11, which another server may parse with, takes any word for a method.
    assert [asyncio.run(ask(method)) for method in ("WEBSOCKET", "websocket", "GET")] == [404] * 3


def test_a_path_that_is_not_there_wants_a_key_first(server: Served) -> None:
    with Wire(server.port) as wire:
        for path in (b"/nowhere", b"/v1/admin", b"/v1/admin/", b"/v1/admin/policies/", b"/healthz/", b"/V2"):
            assert wire.ask(b"GET", path)[0] == (401 if server.kind == "keys" else 404), path
            assert wire.ask(b"GET", path, *bearer(ADMIN))[0] == 404, path


def test_an_admin_key_administers_and_paths_have_one_spelling(server: Served) -> None:
    with Wire(server.port) as wire:
        path = b"/v2/repository/models/gridworld/unload"
        if server.kind == "none":
            assert wire.ask(b"POST", path, *bearer(ADMIN))[0] == 403
            return
        for target in spellings(path.decode()):
            if plain_of(target) != path.decode():
                assert wire.ask(b"POST", target, *bearer(ADMIN))[0] in (0, 400, 403, 404, 405), target
        assert server.control.store is not None and "gridworld" in server.control.store.names
        assert wire.ask(b"POST", path + b"?x=1", *bearer(ADMIN))[0] == 200
        assert "gridworld" not in server.control.store.names


UPGRADE = (
    b"connection: Upgrade",
    b"upgrade: websocket",
    b"sec-websocket-version: 13",
    b"sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==",
)


@pytest.mark.parametrize("path", ["/", "/v1/policies/ur5/stream", "/v1/policies/ur5/versions/1/stream"])
def test_no_spelling_of_a_streams_path_opens_it_without_a_key(policies: Path, path: str) -> None:
    with controlled(policies) as control:
        settings = ServerSettings(api_keys=ROBOT_LINE, default_policy="ur5")
        with over_uvicorn(create_app(control, settings)) as port, Wire(port) as wire:
            for target in spellings(path):
                for key in ((), bearer(WRONG)):
                    status, _ = wire.ask(b"GET", target, *UPGRADE, *key, body=b"")
                    assert status in (0, 400, 401, 403, 404), (target, status)
                status, _ = wire.ask(b"GET", target, *UPGRADE, *bearer(ROBOT), body=b"")
                assert status < 500 and (status != 101 or plain_of(target) in ("/", path)), (target, status)
            assert wire.ask(b"GET", path.encode(), *UPGRADE, *bearer(ROBOT), body=b"")[0] == 101


def entries(caplog: pytest.LogCaptureFixture, logger: str) -> list[dict[str, Any]]:
    return [vars(record)[FIELDS] for record in caplog.records if record.name == logger]


def test_who_administers_and_whose_key_is_refused_is_in_the_log(
    policies: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="rlservo")
    path = b"/v1/admin/policies/ur5/alias"
    with controlled(policies) as control:
        settings = ServerSettings(api_keys=f"{ROBOT_LINE},{ADMIN_LINE}")
        with over_uvicorn(create_app(control, settings)) as port, Wire(port) as wire:
            body = b'{"alias": "candidate", "version": "2"}'
            assert wire.ask(b"POST", path, *bearer(ADMIN), b"x-request-id: change-1", body=body)[0] == 200
            wrong = b'{"alias": "candidate", "version": "77"}'
            assert wire.ask(b"POST", path, *bearer(ADMIN), b"x-request-id: change-2", body=wrong)[0] == 404
            unload = b"/v2/repository/models/gridworld/unload"
            assert wire.ask(b"POST", unload, *bearer(ADMIN), b"x-request-id: change-3")[0] == 200
            for key in (WRONG, ROBOT):
                assert wire.ask(b"POST", path, *bearer(key), b"x-request-id: refused", body=body)[0] in (401, 403)
    changes = entries(caplog, "rlservo.administration")
    told = [(entry["request_id"], entry["change"], entry["code"], entry["key"]) for entry in changes]
    assert told == [
        ("change-1", "alias ur5 candidate=2", "ok", "boss"),
        ("change-2", "alias ur5 candidate=77", "unknown-version", "boss"),
        ("change-3", "unload gridworld", "ok", "boss"),
        ("refused", "", "unauthenticated", ""),
        ("refused", "", "forbidden", "cell-7"),
    ]
    assert {entry["peer"] for entry in changes} == {"127.0.0.1"}
    assert [(entry["command"], entry["policy"], entry["version"]) for entry in changes[:3]] == [
        ("alias", "ur5", "2"), ("alias", "ur5", "77"), ("unload", "gridworld", None),
    ]  # fmt: skip
    assert {entry["path"] for entry in changes[3:]} == {path.decode()}
    assert changes[0]["generation"] == 2
    refused = [entry for entry in entries(caplog, "rlservo.requests") if entry["request_id"] == "refused"]
    assert [(entry["code"], entry["peer"]) for entry in refused] == [
        ("unauthenticated", "127.0.0.1"),
        ("forbidden", "127.0.0.1"),
    ]
    assert WRONG not in caplog.text and ADMIN not in caplog.text


def test_every_command_is_in_the_audit_whatever_became_of_it_and_no_key_is(policies: Path, tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    settings = ServerSettings(
        api_keys=f"{ROBOT_LINE},{ADMIN_LINE}", audit_file=str(file), log_level="error",
        log_file=str(tmp_path / "server.jsonl"), body_timeout_s=0.3, record=str(tmp_path),
    )  # fmt: skip
    attempts = [
        (b"alias", b'{"alias": "candidate", "version": "2"}', "ok"),
        (b"alias", b'{"alias": "candidate"}', "bad-request"),
        (b"alias", b"not json", "bad-request"),
        (b"alias", b'{"alias": "candidate", "version": "2", "key": "%s"}' % ADMIN.encode(), "bad-request"),
        (b"load", b'{"version": "77"}', "unknown-version"),
        (b"canary", b'{"version": "2"}', "bad-request"),
        (b"canary", b'{"version": "2", "share": 0.1}', "ok"),
        (b"shadow", b'{"version": "2"}', "ok"),
        (b"rollback", b"{}", "conflict"),
        (b"unload", b'{"version": "2"}', "conflict"),
        (b"unload", b" " * (5 << 20), "too-large"),
    ]
    with contextlib.ExitStack() as stack:
        stack.enter_context(listening_log(settings))
        control = stack.enter_context(controlled(policies))
        port = stack.enter_context(over_uvicorn(create_app(control, settings)))
        with Wire(port) as wire:
            for command, body, _ in attempts:
                wire.ask(b"POST", b"/v1/admin/policies/ur5/" + command, *bearer(ADMIN), body=body)
            wire.ask(b"POST", b"/v1/admin/policies/" + ADMIN.encode() + b"/load", *bearer(ADMIN), body=b"{}")
            wire.ask(b"PUT", b"/v1/admin/policies/ur5/load", *bearer(ADMIN))
            wire.ask(b"GET", b"/v1/admin/recordings", *bearer(ROBOT))
            assert wire.ask(b"GET", b"/v1/admin/recordings", *bearer(ADMIN))[0] == 200  # changes nothing
            wire.ask(b"POST", b"/v1/admin/policies/ur5/load", b"x-request-id: " + ADMIN.encode())
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [line["code"] for line in lines] == [
        *(code for *_, code in attempts), "unknown-policy", "method-not-allowed", "forbidden", "unauthenticated",
    ]  # fmt: skip
    assert [line["message"] for line in lines].count("changed") == 3
    assert {line["key"] for line in lines} == {"boss", "cell-7", ""}
    assert all(line["logger"] == "rlservo.administration" and line["peer"] == "127.0.0.1" for line in lines)
    assert ADMIN not in file.read_text() and ADMIN.removeprefix("rlservo_") not in file.read_text()
    assert lines[-1]["request_id"] == "rlservo_..."
    assert (tmp_path / "server.jsonl").read_text().count("rlservo.administration") == len(lines)


def test_an_audit_file_that_cannot_be_written_refuses_the_start(tmp_path: Path) -> None:
    settings = ServerSettings(audit_file=str(tmp_path / "gone" / "audit.jsonl"))
    with pytest.raises(UsageError, match=r"the audit file .* cannot be written: No such file"), listening_log(settings):
        pass


@contextlib.contextmanager
def listening_log(settings: ServerSettings) -> Iterator[None]:
    """Log as a replica does, and as before afterwards."""
    loggers = [logging.getLogger(name) for name in ("rlservo", "rlservo.administration")]
    try:
        configure(settings)
        yield
    finally:
        for logger in loggers:
            for handler in list(logger.handlers):
                logger.removeHandler(handler)
                handler.close()
            logger.setLevel(logging.NOTSET)
        loggers[0].propagate = True


def test_no_route_reads_a_body_beyond_the_limit(server: Served) -> None:
    """Announced or in chunks: refused before anything holds all of it; with an admin key, too."""
    limit = server.app.handler.settings.max_body_bytes
    chunk = b"%x\r\n" % 65536 + b" " * 65536 + b"\r\n"
    for method, path, access in paths(server.app):
        if path == "/" or path.endswith("/stream"):
            continue
        expected = 403 if access is Access.admin and server.kind == "none" else 413
        head = f"{method} {path} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\n".encode()
        head += bearer(ADMIN)[0] + b"\r\n"
        for rest in (b"content-length: %d\r\n\r\n{" % (limit + 1), b"transfer-encoding: chunked\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", server.port), timeout=30) as client:
                client.sendall(head + rest)
                if rest.endswith(b"chunked\r\n\r\n"):
                    with contextlib.suppress(OSError):  # it may have been answered and closed by then
                        for _ in range(limit // 65536 + 2):
                            client.sendall(chunk)
                status = int(client.recv(65536)[9:12])
            assert status == expected, (method, path, rest[:20])


@pytest.mark.parametrize("name", [b"x-request-id", b"x-session-id", b"authorization", b"x-api-key", b"user-agent"])
def test_a_header_that_is_not_utf8_is_like_any_other(server: Served, name: bytes) -> None:
    with Wire(server.port) as wire:
        for method, path in ((b"GET", b"/v1/policies"), (b"POST", b"/v1/policies/ur5/act"), (b"GET", b"/nowhere")):
            for value in (b"caf\xe9", "café".encode(), b"\x80" * 200):
                given = (b"" if name == b"authorization" else bearer(ADMIN)[0], name + b": " + value)
                plain = (given[0], name + b": cafe")
                status, answer = wire.ask(method, path, *filter(None, given), body=OBS)
                assert status == wire.ask(method, path, *filter(None, plain), body=OBS)[0] != 500, (path, answer)


def test_long_paths_that_anyone_may_send_take_no_memory(server: Served) -> None:
    table = server.app.table
    tracemalloc.start()
    try:
        for number in range(500):
            assert table.find("GET", f"/{number}".ljust(16_000, "x"), b"").route is None
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 1_000_000, kept
