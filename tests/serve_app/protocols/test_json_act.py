"""The JSON protocol over real bundles, through uvicorn and http.client: no mock between the bytes and the policy."""

from __future__ import annotations

import gzip
import http.client
import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.bundle.contract import Contract
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import exchange, over_uvicorn
from stores import control_of, load_store

OBS = [round(0.01 * i, 2) for i in range(27)]
JSON = {"content-type": "application/json"}
HALF_SENT = (
    b"POST /v1/policies/ur5/act HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    b'content-type: application/json\r\ncontent-length: 1000\r\n\r\n{"obs": ['
)

SETTINGS = ServerSettings(max_body_bytes=200_000, max_batch=64, body_timeout_s=1.0)
Ask = Callable[..., tuple[int, dict[str, str], Any]]


@pytest.fixture(scope="module")
def store(policies: Path) -> PolicyStore:
    return load_store(policies)


class Loading:
    """A store provider that can be told to have nothing yet."""

    def __init__(self, store: PolicyStore) -> None:
        self.store: PolicyStore | None = store

    def __call__(self) -> PolicyStore | None:
        return self.store


@pytest.fixture(scope="module")
def loading(store: PolicyStore) -> Loading:
    return Loading(store)


@pytest.fixture(scope="module")
def port(loading: Loading) -> Iterator[int]:
    with over_uvicorn(create_app(control_of(loading), SETTINGS)) as port:
        yield port


@pytest.fixture(scope="module")
def ask(port: int) -> Ask:
    def call(
        method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> tuple[int, dict[str, str], Any]:
        reply = exchange(port, method, path, body, **(headers or {}))
        return reply.status, reply.headers, reply.document

    return call


def act(ask: Ask, body: Any, name: str = "ur5") -> tuple[int, Any]:
    status, _, reply = ask("POST", f"/v1/policies/{name}/act", body)
    return status, reply


def test_act_answers_with_the_newest_versions_action(ask: Ask, store: PolicyStore) -> None:
    status, reply = act(ask, {"obs": OBS, "seq": 41})
    assert status == 200
    assert {key: reply[key] for key in ("policy", "version", "seq")} == {"policy": "ur5", "version": "10", "seq": 41}
    assert reply["infer_ms"] > 0
    np.testing.assert_allclose(reply["action"], store.get("ur5").act(OBS), rtol=1e-6)


def test_a_version_a_batch_and_a_named_observation(ask: Ask, store: PolicyStore) -> None:
    status, _, reply = ask("POST", "/v1/policies/ur5/versions/2/act", {"obs": [OBS, OBS]})
    assert (status, reply["version"], np.shape(reply["action"])) == (200, "2", (2, 6))
    np.testing.assert_allclose(reply["action"][0], store.get("ur5", "2").act(OBS), rtol=1e-6)
    named = {f"element_{i}": value for i, value in enumerate(OBS)}
    assert act(ask, {"obs": named})[1]["action"] == act(ask, {"obs": OBS})[1]["action"]
    assert "seq" not in reply


def test_a_discrete_action_is_a_plain_integer(ask: Ask) -> None:
    assert type(act(ask, {"obs": 2}, "gridworld")[1]["action"]) is int
    assert len(act(ask, {"obs": [0, 1, 2]}, "gridworld")[1]["action"]) == 3


@pytest.mark.parametrize(
    ("body", "status", "code", "sentence"),
    [
        ({"obs": OBS[:26]}, 422, "bad-observation", "policy 'ur5' expects obs of shape (27,), got (26,)"),
        ({"obs": [*OBS[:26], "x"]}, 422, "bad-observation", "element 26 (element_26) is the string 'x'"),
        (
            b'{"obs": [%s NaN]}' % (b"0," * 26),
            422,
            "bad-observation",
            "(element_26) is nan, not a finite number; JSON has no NaN",
        ),
        (b'{"obs": [%s 1e400]}' % (b"0," * 26), 422, "bad-observation", "(element_26) is inf"),
        (b'{"obs": %s, "seq": NaN}' % json.dumps(OBS).encode(), 400, "bad-request", "'seq' must be an integer"),
        ({}, 422, "bad-observation", "no 'obs'"),
        (
            {"obs": OBS, "observation": OBS},
            400,
            "bad-request",
            "unknown field 'observation': expected one of deadline_ms",
        ),
        ({"observation": OBS}, 400, "bad-request", "unknown field 'observation'"),
        ({"obs": OBS, "state": {"h": [0]}}, 400, "bad-request", "does not fit policy 'ur5' (its state: none"),
        ({"obs": OBS, "state": [0]}, 400, "bad-request", "'state' must be an object, got a list"),
        ({"obs": OBS, "session_id": 7}, 400, "bad-request", "'session_id' must be a string, got the number 7"),
        ({"obs": OBS, "reset": True}, 400, "bad-request", "'reset' needs a session: also send its 'session_id'"),
        ({"obs": OBS, "timestamp": "now"}, 400, "bad-request", "'timestamp' must be a valid number, got a string"),
        ({"obs": OBS, "explore": 1}, 400, "bad-request", "'explore' must be true or false"),
        ({"obs": OBS, "seed": -1}, 400, "bad-request", "'seed' must be greater than or equal to 0, got the number -1"),
        ({"obs": OBS, "seed": True}, 400, "bad-request", "'seed' must be an integer, got true"),
        ({"obs": OBS, "deadline_ms": "1"}, 400, "bad-request", "'deadline_ms' must be a valid number"),
        ({"obs": OBS, "deadline_ms": 0}, 408, "deadline-passed", "no action was computed"),
        ([OBS], 400, "bad-request", "must be a JSON object"),
        (b"", 400, "bad-request", "the request body is empty"),
        (b"{", 400, "bad-request", "the request body is not JSON"),
        (b"[" * 10_000, 400, "bad-request", "not JSON"),
        (b'{"obs": [1], "session_id": "\\ud800"}', 400, "bad-request", "not JSON: no low surrogate in string"),
        (b'{"obs": "\\ud800"}', 400, "bad-request", "not JSON: no low surrogate in string"),
        (b"[" * 100_000, 413, "too-large", "more than 1128 lists"),
        ({"obs": [OBS] * 65}, 413, "too-large", "at most 64"),
        (b" " * 200_001, 413, "too-large", "larger than 200000 bytes"),
    ],
)
def test_a_bad_request_gets_its_status_code_and_sentence(
    ask: Ask, body: Any, status: int, code: str, sentence: str
) -> None:
    got, reply = act(ask, body)
    assert (got, reply["code"]) == (status, code), reply
    assert sentence in reply["error"]
    assert act(ask, {"obs": OBS, "deadline_ms": 5000})[0] == 200


def test_unknown_names_versions_paths_and_methods(ask: Ask) -> None:
    cases = [
        ("POST", "/v1/policies/ur6/act", 404, "unknown-policy", "this server has gridworld, ur5"),
        ("POST", "/v1/policies/ur5/versions/9/act", 404, "unknown-version", "expected one of 1, 2, 10"),
        ("POST", "/v1/policies/..%2f..%2fetc/act", 400, "bad-request", "without percent-encoding"),
        ("POST", "/v1/policies/ur5/act/", 404, "not-found", "nothing at"),
        ("GET", "/v1/policies/ur6", 404, "unknown-policy", "this server has"),
        ("GET", "/v1/policies/ur5/versions/9", 404, "unknown-version", "expected one of"),
        ("GET", "/nowhere", 404, "not-found", "policies are under /v1/policies"),
        ("GET", "/v1/policies/ur5/act", 405, "method-not-allowed", "POST is"),
        ("DELETE", "/v1/policies/ur5", 405, "method-not-allowed", "GET is"),
    ]
    for method, path, status, code, sentence in cases:
        got, _, reply = ask(method, path, {"obs": OBS} if method == "POST" else None)
        assert (got, reply["code"]) == (status, code), (path, reply)
        assert sentence in reply["error"]


def test_other_content_types_and_encodings_are_refused(ask: Ask) -> None:
    body = json.dumps({"obs": OBS}).encode()
    for headers in ({"content-type": "application/x-www-form-urlencoded"}, {"content-type": "text/plain"}):
        status, _, reply = ask("POST", "/v1/policies/ur5/act", body, headers)
        assert (status, reply["code"]) == (415, "wrong-media-type")
        assert headers["content-type"] in reply["error"]
    for content in (gzip.compress(body), gzip.compress(body)[:20]):
        status, _, reply = ask("POST", "/v1/policies/ur5/act", content, {**JSON, "content-encoding": "gzip"})
        assert (status, reply["code"]) == (415, "wrong-media-type")
    for accepted in ("application/json; charset=utf-8", "Application/JSON"):
        assert ask("POST", "/v1/policies/ur5/act", body, {"content-type": accepted})[0] == 200


def test_a_client_that_hangs_up_halfway_does_no_harm(port: int, ask: Ask) -> None:
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
            client.sendall(HALF_SENT)
    assert act(ask, {"obs": OBS})[0] == 200


def test_a_body_in_chunks_is_read_and_limited(port: int) -> None:
    for size, status in ((len(json.dumps({"obs": OBS})), 200), (SETTINGS.max_body_bytes + 1, 413)):
        body = json.dumps({"obs": OBS}).encode().ljust(size)
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        pieces = (body[i : i + 5000] for i in range(0, len(body), 5000))
        connection.request("POST", "/v1/policies/ur5/act", pieces, JSON, encode_chunked=True)
        assert connection.getresponse().status == status
        connection.close()


def test_until_the_policies_are_loaded_everything_but_health_is_503_with_retry_after(
    ask: Ask, loading: Loading
) -> None:
    store, loading.store = loading.store, None
    try:
        for method, path in (("GET", "/v2/health/ready"), ("GET", "/v1/policies"), ("POST", "/v1/policies/ur5/act")):
            status, headers, reply = ask(method, path, {"obs": OBS} if method == "POST" else None)
            assert (status, reply["code"], headers["retry-after"]) == (503, "unavailable", "1")
        assert ask("GET", "/healthz")[0] == ask("GET", "/v2/health/live")[0] == 200
    finally:
        loading.store = store
    assert ask("GET", "/v2/health/ready")[2] == {"ready": True}
    assert ask("GET", "/healthz")[2] == b"OK"


def test_listings_and_contracts_are_the_bundles_own(ask: Ask, store: PolicyStore) -> None:
    listed = {policy["name"]: policy for policy in ask("GET", "/v1/policies")[2]["policies"]}
    assert listed["ur5"]["version"] == "10" and listed["ur5"]["versions"] == ["1", "2", "10"]
    for path, version in (("/v1/policies/ur5", None), ("/v1/policies/ur5/versions/2", "2")):
        assert Contract.model_validate(ask("GET", path)[2]) == store.get("ur5", version).contract


def test_an_unexpected_failure_says_no_more_than_that(
    ask: Ask, loading: Loading, caplog: pytest.LogCaptureFixture
) -> None:
    store, loading.store = loading.store, object()  # type: ignore[assignment]  # whatever is used of it, raises
    try:
        for method, path in (("POST", "/v1/policies/ur5/act"), ("GET", "/v1/policies")):
            status, _, reply = ask(method, path, {"obs": OBS} if method == "POST" else None)
            assert status == 500
            assert reply == {"error": "the server failed on this request; its log has the cause", "code": "internal"}
    finally:
        loading.store = store
    assert "AttributeError" in caplog.text


VALUES = [
    b"null", b"true", b"-1", b"1e400", b"-1e999", b"1e-400", b"123456789012345678901234567890", b'""', b'"\\ud800"',
    b'"\xff"', b"[]", b"{}", b"[[]]", b"[[[[[]]]]]", b'[{"a":[1]}]', b"NaN", b"-Infinity", b"1.5", b"0x10", b'"1"',
    b"1" * 310, b"-" + b"9" * 310, b"1" * 4000, b"1" + b"0" * 400 + b".5",  # no float can hold them
    b"[true]", "\"\N{SNOWMAN}\"".encode(), b"[null,1]", b"[" * 900 + b"]" * 900, b"[" * 60 + b"1" + b"]" * 60,
]  # fmt: skip
ACT, GRID, INFER = "/v1/policies/ur5/act", "/v1/policies/gridworld/act", "/v2/models/ur5/infer"
ROW = b'{"inputs": [{"name": "obs", "datatype": "FP32", "shape": %s, "data": [' + b"0," * 26 + b"%s]}]}"
PLACES = [
    *((path, form) for path in (ACT, GRID) for form in (b"%s", b'{"obs": %s}', b'{"obs": [%s, 1]}')),
    (ACT, b'{"obs": [' + b"0," * 26 + b"%s]}"), (ACT, b'{"obs": [[' + b"0," * 26 + b"%s]]}"),
    (ACT, b'{"obs": {"element_0": %s}}'),
    *((ACT, json.dumps({"obs": OBS, field: "VALUE"}).encode().replace(b'"VALUE"', b"%s")) for field in (
        "explore", "seed", "seq", "deadline_ms", "timestamp", "reward", "session_id", "last_action", "state", "\0")),
    (INFER, ROW % (b"[1, 27]", b"%s")), (INFER, ROW % (b"[1, %s]", b"0")),
    *((INFER, (ROW % (b"[1, 27]", b"0"))[:-1] + b', "parameters": {"%s": %%s}}' % field) for field in (
        b"deadline_ms", b"timestamp", b"timeout", b"priority", b"seed", b"seq", b"sequence_id")),
]  # fmt: skip


def test_no_value_in_any_place_gets_a_5xx_or_stops_the_server(ask: Ask) -> None:
    seen: dict[int, int] = {}
    for path, form in PLACES:
        for value in VALUES:
            body = form % value
            status, _, reply = ask("POST", path, body)
            seen[status] = seen.get(status, 0) + 1
            assert status < 500, (body[:200], reply)
            if status != 200:
                assert set(reply) <= {"error", "code", "details"}, (body[:200], reply)
                assert len(reply["error"]) < 400 and "Traceback" not in reply["error"], (body[:200], reply)
            elif "action" in reply:
                assert np.isfinite(reply["action"]).all()
    assert seen[400] > 100 and seen[422] > 100
    assert act(ask, {"obs": OBS})[0] == 200
