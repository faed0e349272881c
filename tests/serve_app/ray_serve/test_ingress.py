"""Middleware before Ray Serve's handling: what the application answers by itself, and what is left to Serve."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.types import Message, Receive, Scope, Send

from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.ray_serve import ingress as ingress_module
from rlservo.serve_app.ray_serve.ingress import NO_WATCH, Ingress, ServeBypass
from rlservo.serve_app.server.access_checks import REQUEST_ID
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import load_policy
from stores import store_of

ACT = "/v1/policies/ur5/act"
OBS = json.dumps({"obs": [0.0] * 27}).encode()


@pytest.fixture(autouse=True)
def bypass(monkeypatch: pytest.MonkeyPatch) -> ServeBypass:
    """The process's bypass, for one test."""
    monkeypatch.setattr(ingress_module, "bypass", ServeBypass())
    return ingress_module.bypass


class Serve:
    """Stands for Ray Serve: notes what reaches it, and calls the application under a prefix, as Serve does."""

    def __init__(self, app: Any, prefix: str = "") -> None:
        self.seen: list[Scope] = []
        self._app = app
        self._prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.seen.append(dict(scope))
        scope["root_path"] = scope.get("root_path", "") + self._prefix
        await self._app(scope, receive, send)


@pytest.fixture
def app(ur5: Path) -> Any:
    store = store_of(load_policy(ur5))
    return create_app(lambda: store, ServerSettings())


async def ask(
    ingress: Any,
    path: str = ACT,
    *,
    method: str = "POST",
    headers: tuple[tuple[bytes, bytes], ...] = (),
    body: bytes = OBS,
    root_path: str = "",
) -> tuple[int, dict[bytes, bytes], bytes]:
    """Return (status, headers, body) of one HTTP request through the ingress."""
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http",
        "method": method,
        "path": root_path + path,
        "root_path": root_path,
        "query_string": b"",
        "headers": [(b"content-type", b"application/json"), *headers],
    }
    await ingress(scope, receive, send)
    assert [message["type"] for message in sent] == ["http.response.start", "http.response.body"]
    assert [name for name, _ in sent[0]["headers"]].count(REQUEST_ID) <= 1
    return sent[0]["status"], dict(sent[0]["headers"]), sent[1].get("body", b"")


async def opened(app: Any, *, prefix: str = "", root_path: str = "", **options: Any) -> tuple[Serve, Any]:
    """Return (Serve, the ingress before it), with the bypass installed and the prefix known."""
    serve = Serve(app, prefix)
    ingress = Ingress(serve)
    ingress_module.bypass.install(app, **options)
    await ask(ingress, prefix + ACT, root_path=root_path)
    assert len(serve.seen) == 1
    serve.seen.clear()
    return serve, ingress


def run(scenario: Callable[[], Any]) -> Any:
    return asyncio.run(scenario())


@pytest.mark.parametrize("prefix", ["", "/robots"])
@pytest.mark.parametrize("root_path", ["", "/behind/a/proxy"])
def test_requests_for_actions_do_not_reach_serve_once_the_prefix_is_known(
    app: Any, prefix: str, root_path: str
) -> None:
    async def scenario() -> None:
        serve, ingress = await opened(app, prefix=prefix, root_path=root_path)
        for path in (ACT, "/v2/models/ur5/infer", "/v1/policies/ur5/versions/10/act"):
            body = OBS
            if "infer" in path:
                tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": [0.0] * 27}
                body = json.dumps({"inputs": [tensor]}).encode()
            status, _, answer = await ask(ingress, prefix + path, body=body, root_path=root_path)
            assert status == 200 and not serve.seen, answer

    run(scenario)


def test_everything_else_is_left_to_serve_and_marked_as_not_to_be_watched(app: Any) -> None:
    async def scenario() -> None:
        serve, ingress = await opened(app)
        for method, path, status in (
            ("GET", "/healthz", 200),
            ("GET", "/v1/policies", 200),
            ("GET", ACT, 405),
            ("POST", "/v1/policies/ur5/act/", 404),
            ("POST", "/robots" + ACT, 404),
            ("POST", "/v1/policies/a/b/act", 404),
            ("POST", "//v1/policies/ur5/act", 400),
        ):
            assert (await ask(ingress, path, method=method))[0] == status
        assert len(serve.seen) == 7
        assert all(NO_WATCH in scope["headers"] for scope in serve.seen)

    run(scenario)


def test_an_answer_carries_the_clients_request_id_or_a_new_one(app: Any) -> None:
    async def scenario() -> None:
        _, ingress = await opened(app)
        made = {(await ask(ingress))[1][REQUEST_ID] for _ in range(5)}
        assert len(made) == 5 and all(made)
        given = await ask(ingress, headers=((REQUEST_ID, b"mine"),))
        assert given[1][REQUEST_ID] == b"mine"
        refused = await ask(ingress, body=b"{}", headers=((REQUEST_ID, b"yours"),))
        assert refused[0] == 422 and refused[1][REQUEST_ID] == b"yours"

    run(scenario)


def test_a_stream_reaches_the_application_without_serve(app: Any) -> None:
    async def scenario() -> None:
        serve, ingress = await opened(app)
        for path, directly in (("/v1/policies/ur5/stream", True), ("/", True), ("/elsewhere", False)):
            sent: list[Message] = []
            messages = iter([{"type": "websocket.connect"}, {"type": "websocket.disconnect", "code": 1000}])

            async def receive(messages: Any = messages) -> Message:
                return dict(next(messages))

            async def send(message: Message, sent: list[Message] = sent) -> None:
                sent.append(message)

            scope = {"type": "websocket", "path": path, "headers": [], "query_string": b""}
            await ingress(scope, receive, send)
            assert bool(serve.seen) is not directly
            assert sent[0]["type"] == "websocket.accept"

    run(scenario)


def test_keys_are_asked_for_without_serve_as_well(ur5: Path) -> None:
    key, line = new_key("robot")
    store = store_of(load_policy(ur5))
    app = create_app(lambda: store, ServerSettings(api_keys=line))

    async def scenario() -> None:
        serve, ingress = await opened(app)
        assert (await ask(ingress))[0] == 401
        assert (await ask(ingress, headers=((b"authorization", b"Bearer " + key.encode()),)))[0] == 200
        sent: list[Message] = []

        async def receive() -> Message:
            return {"type": "websocket.connect"}

        async def send(message: Message) -> None:
            sent.append(message)

        extensions = {"websocket.http.response": {}}
        scope = {"type": "websocket", "path": "/", "headers": [], "query_string": b"", "extensions": extensions}
        await ingress(scope, receive, send)
        assert sent[0]["type"] == "websocket.http.response.start" and sent[0]["status"] == 401
        assert not serve.seen

    run(scenario)


@pytest.mark.parametrize(
    ("asked_by", "forwarded", "peer"),
    [
        ("127.0.0.1", (b"203.0.113.9",), "203.0.113.9"),
        ("127.0.0.1", (b"10.1.1.1", b"203.0.113.9"), "203.0.113.9"),  # the first is the client's own claim
        ("127.0.0.1", (), "127.0.0.1"),
        ("192.0.2.7", (b"203.0.113.9",), "192.0.2.7"),
    ],
)
def test_who_was_refused_behind_the_proxy_is_logged(
    ur5: Path, asked_by: str, forwarded: tuple[bytes, ...], peer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_of(load_policy(ur5))
    app = create_app(lambda: store, ServerSettings(api_keys=new_key("robot")[1]))
    peers: list[str | None] = []

    async def scenario() -> None:
        _, ingress = await opened(app)
        monkeypatch.setattr(app._core, "record_failure", lambda *_, peer: peers.append(peer))
        server = uvicorn.Config(ingress, log_config=None)  # as Serve makes it: uvicorn reads who was forwarded
        server.load()
        headers = tuple((b"x-forwarded-for", each) for each in forwarded)

        async def at_once(scope: Scope, receive: Receive, send: Send) -> None:
            scope["client"] = (asked_by, 4711)
            assert ingress_module.find_at_once(scope) is not None
            await server.loaded_app(scope, receive, send)

        assert (await ask(at_once, headers=headers))[0] == 401

    run(scenario)
    assert peers == [peer]


def test_a_bug_outside_what_the_application_guards_is_logged_with_the_requests_id(
    app: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        _, ingress = await opened(app)
        monkeypatch.setattr(app, "_checks", None)
        with pytest.raises(AttributeError):
            await ask(ingress, headers=((REQUEST_ID, b"mine"),))

    run(scenario)
    (record,) = (record for record in caplog.records if record.name == "rlservo.serve_app.protocols.http_endpoint")
    assert record.exc_info and "mine" in str(vars(record))


@pytest.mark.parametrize("answers", [True, False])
def test_actions_are_refused_while_there_is_no_room_and_the_operator_is_not(app: Any, answers: bool) -> None:
    async def scenario() -> None:
        serve, ingress = await opened(app, answers=answers)
        admission = app.state.core.admission
        while admission._burst < admission._max_queued:  # in this very turn of the event loop
            admission.enter()
        status, headers, body = await ask(ingress)
        assert (status, headers[b"retry-after"], json.loads(body)["code"]) == (503, b"1", "over-capacity")
        assert not serve.seen and admission.turned_away == 1
        assert (await ask(ingress, "/healthz", method="GET"))[0] == 200
        assert (await ask(ingress, "/v1/admin/alias"))[0] != 503
        assert len(serve.seen) == 2

    run(scenario)


@pytest.mark.parametrize("prefix", ["", "/robots"])
def test_where_the_application_is_not_to_answer_serve_gets_the_request_as_it_came(app: Any, prefix: str) -> None:
    async def scenario() -> None:
        serve, ingress = await opened(app, prefix=prefix, answers=False)
        assert (await ask(ingress, prefix + ACT))[0] == 200
        (scope,) = serve.seen
        assert scope["root_path"] == "" and NO_WATCH in scope["headers"]

    run(scenario)


def test_in_another_threads_event_loop_everything_is_left_to_serve(app: Any) -> None:
    async def here() -> tuple[Serve, Any]:
        serve, ingress = await opened(app)
        assert (await ask(ingress))[0] == 200 and not serve.seen
        return serve, ingress

    serve, ingress = run(here)

    async def elsewhere() -> None:
        assert (await ask(ingress))[0] == 200
        assert len(serve.seen) == 1

    with ThreadPoolExecutor(1) as pool:
        pool.submit(run, elsewhere).result()


def test_in_a_proxy_everything_is_left_to_serve(app: Any) -> None:
    async def scenario() -> None:
        serve = Serve(app)
        assert (await ask(Ingress(serve)))[0] == 200
        assert len(serve.seen) == 1

    run(scenario)
