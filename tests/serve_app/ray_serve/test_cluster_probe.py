"""Probe of a server from outside: one that others reach and that answers without a key is found."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from rlservo.serve_app.ray_serve.cluster_probe import check_keys, check_nodes, proxy_settings

APPLICATION = {"route_prefix": "/", "deployed_app_config": {"args": {"settings": {"stream_idle_s": 60, "threads": 2}}}}


@contextmanager
def answering(status: int) -> Iterator[int]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/v1/policies" else 500)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize(
    ("host", "status", "problem"),
    [
        ("127.0.0.1", 200, None),
        ("0.0.0.0", 200, "whoever reaches 0.0.0.0:"),
        ("0.0.0.0", 401, None),
        ("127.0.0.1", 503, "answers 503"),
    ],
)
def test_only_a_server_that_others_reach_needs_keys(host: str, status: int, problem: str | None) -> None:
    with answering(status) as port:
        ((name, found, _),) = check_keys({"http_options": {"host": host, "port": port}}, [APPLICATION])
    assert name == "keys"
    assert found is None if problem is None else problem in str(found)


def test_a_server_that_does_not_answer_is_a_problem() -> None:
    with answering(200) as port:
        pass
    ((_, found, _),) = check_keys({"http_options": {"host": "127.0.0.1", "port": port}}, [APPLICATION])
    assert "does not answer" in str(found)


@pytest.mark.parametrize(("there", "is_problem"), [("60.0", False), ("300", True), (None, True)])
def test_settings_that_haproxy_shares_must_be_the_nodes(there: str | None, is_problem: bool) -> None:
    versions = {"Python": "3", "Ray": "2", "rlservo": "0"}
    look = {
        "variables": {} if there is None else {"RLSERVO_STREAM_IDLE_S": there},
        "versions": versions,
        "haproxy": None,
    }
    plan = {"variables": {}, "any_value": [], "versions": versions}
    lines = list(check_nodes([("10.0.0.1", look)], plan, proxy_settings([APPLICATION]), []))
    problems = [(name, problem) for name, problem, _ in lines if problem is not None]
    assert [name for name, _ in problems] == ["settings"] * is_problem
    assert not is_problem or "the application's setting is 60" in str(problems)


def test_a_node_with_faults_is_named_with_each_of_them() -> None:
    look = {
        "variables": {"A": "2"},
        "versions": {"Python": "3.11", "Ray": "2.60", "rlservo": "not importable (No module named 'rlservo')"},
        "haproxy": "/h/haproxy cannot be read",
    }
    plan = {
        "variables": {"A": "1", "B": "1"},
        "any_value": ["C"],
        "versions": {"Python": "3.11", "Ray": "2.60", "rlservo": "0.1.0"},
    }
    looks: list[tuple[str, dict[str, Any] | str]] = [("10.0.0.1", look), ("10.0.0.2", "no task ran there within 60 s")]
    problems = {name: problem for name, problem, _ in check_nodes(looks, plan, {}, []) if problem is not None}
    assert "10.0.0.1: A is '2', not '1'; B is not set; C is not set: run eval" in problems["variables"]
    assert "10.0.0.1: rlservo not importable" in problems["versions"] and "here: " in problems["versions"]
    assert problems["haproxy"].startswith("10.0.0.1: /h/haproxy cannot be read")
    assert problems["node"] == "10.0.0.2: no task ran there within 60 s"
