"""The client when the other side misbehaves: a real socket, a server that follows a script."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest

from bundles import contract_of
from rlservo.bundle.spaces import BoxSpec
from rlservo.client.http_transport import Transport
from rlservo.client.policy_client import PolicyClient
from rlservo.errors import (
    ActionError,
    DeadlineError,
    ObservationError,
    OverloadedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from servers import free_ports

CONTRACT = contract_of(
    "arm",
    BoxSpec(shape=(3,), dtype="float32", low=None, high=None),
    BoxSpec(shape=(2,), dtype="float32", low=-1.0, high=1.0),
    version="3",
    control_rate_hz=10.0,
)
OBS = np.array([0.1, 0.2, 0.3], np.float32)
GOOD = [0.25, -0.5]

Answer = Callable[["Handler", dict[str, Any]], None]


class Handler(BaseHTTPRequestHandler):
    """Serves the contract; every `act` takes the next answer of the script, the last one repeatedly."""

    protocol_version = "HTTP/1.1"
    server: Scripted

    def do_GET(self) -> None:
        if self.path == "/v1/policies":
            self.answer(200, {"policies": [{"name": name} for name in self.server.names]})
        else:
            self.answer(200, CONTRACT.model_dump(mode="json"))

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers["content-length"])))
        self.server.requests.append(request)
        script = self.server.script
        step = script.pop(0) if len(script) > 1 else script[0]
        step(self, request)

    def answer(self, status: int, document: Any, headers: dict[str, str] | None = None) -> None:
        body = document if isinstance(document, bytes) else json.dumps(document).encode()
        self.send_response(status)
        for name, value in {"content-length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None: ...


class Scripted(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.script: list[Answer] = [good]
        self.requests: list[dict[str, Any]] = []
        self.names = ["arm"]
        self.closing = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


def reply(request: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {"action": GOOD, "policy": "arm", "version": "3", "seq": request["seq"], "infer_ms": 0.01, **changes}


def good(handler: Handler, request: dict[str, Any]) -> None:
    handler.answer(200, reply(request))


def says(document: Any, status: int = 200, headers: dict[str, str] | None = None) -> Answer:
    return lambda handler, _: handler.answer(status, document, headers)


def changed(**changes: Any) -> Answer:
    return lambda handler, request: handler.answer(200, reply(request, **changes))


def busy(after: str | None = None) -> Answer:
    headers = {} if after is None else {"retry-after": after}
    return says({"error": "the server is over capacity", "code": "over-capacity"}, 503, headers)


def hang(handler: Handler, _: dict[str, Any]) -> None:
    handler.server.closing.wait(20)
    handler.close_connection = True


def drop(handler: Handler, _: dict[str, Any]) -> None:
    handler.close_connection = True
    handler.connection.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def server() -> Iterator[Scripted]:
    with Scripted() as scripted:
        thread = threading.Thread(target=scripted.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield scripted
        scripted.closing.set()
        scripted.shutdown()
        thread.join()


@pytest.fixture
def client(server: Scripted) -> Iterator[PolicyClient]:
    with PolicyClient(server.url, "arm", timeout_s=5.0) as made:
        yield made


def test_the_action_has_the_contracts_dtype_and_shape(client: PolicyClient) -> None:
    action = client.act(OBS)
    assert (action.dtype, action.shape, action.tolist()) == (np.float32, (2,), GOOD)


def test_a_refused_connection_is_unavailable_after_bounded_retries() -> None:
    url = f"http://127.0.0.1:{free_ports(1)[0]}"
    with PolicyClient(url, "arm", retries=2) as client:
        began = time.monotonic()
        with pytest.raises(UnavailableError, match=f"{url} cannot be reached: .*refused"):
            client.act(OBS)
        waited = time.monotonic() - began
    assert 0.75 * (0.05 + 0.1) <= waited < 4.0  # two waits, 50 and 100 ms with jitter


def test_a_server_that_hangs_is_given_up_at_the_timeout_and_never_asked_again(server: Scripted) -> None:
    server.script = [hang]
    with PolicyClient(server.url, "arm", timeout_s=0.3, retries=5) as client:
        began = time.monotonic()
        with pytest.raises(DeadlineError, match=r"did not answer within 0\.3 s"):
            client.act(OBS)
        assert time.monotonic() - began < 3.0
    assert len(server.requests) == 1


def test_an_answer_that_comes_after_the_timeout_is_not_taken_for_the_next_one(server: Scripted) -> None:
    def late(handler: Handler, request: dict[str, Any]) -> None:
        time.sleep(0.5)
        good(handler, request)

    server.script = [late, changed(action=[1.0, 1.0])]
    with PolicyClient(server.url, "arm", timeout_s=0.3) as client:
        with pytest.raises(DeadlineError):
            client.act(OBS)
        time.sleep(0.4)  # the late answer is on its way
        assert client.act(OBS).tolist() == [1.0, 1.0]


def test_an_answer_that_trickles_in_is_given_up(server: Scripted) -> None:
    def trickle(handler: Handler, request: dict[str, Any]) -> None:
        body = json.dumps(reply(request)).encode()
        handler.send_response(200)
        handler.send_header("content-length", str(len(body)))
        handler.end_headers()
        for byte in body:
            if handler.server.closing.wait(0.05):
                break
            try:
                handler.wfile.write(bytes([byte]))
            except OSError:  # the client has hung up, as it should
                break
        handler.close_connection = True

    server.script = [trickle]
    with PolicyClient(server.url, "arm", timeout_s=0.3) as client:
        began = time.monotonic()
        with pytest.raises(DeadlineError):
            client.act(OBS)
        assert time.monotonic() - began < 2.0  # all of it would take five seconds


def test_a_large_request_that_is_taken_slowly_is_given_up_at_the_timeout() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def take() -> None:
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError):
                while connection.recv(65536):
                    time.sleep(0.01)

        thread = threading.Thread(target=take)
        thread.start()
        transport = Transport(f"http://127.0.0.1:{listener.getsockname()[1]}", timeout_s=0.5, retries=0)
        began = time.monotonic()
        with contextlib.closing(transport), pytest.raises(DeadlineError, match=r"did not answer within 0\.5 s"):
            transport.post("v1", document={"obs": "0" * 40_000_000})
        assert time.monotonic() - began < 3.0  # all of it would take six seconds
        thread.join(10)


def test_503_then_200_gives_the_action(client: PolicyClient, server: Scripted) -> None:
    server.script = [busy(), busy("0.05"), good]
    assert client.act(OBS).tolist() == GOOD
    assert len(server.requests) == 3
    assert len({request["seq"] for request in server.requests}) == 1  # one question, asked three times


def test_retries_of_503_are_bounded(client: PolicyClient, server: Scripted) -> None:
    server.script = [busy()]
    with pytest.raises(OverloadedError, match="the server is over capacity"):
        client.act(OBS)
    assert len(server.requests) == 3  # the first and two retries


def test_retry_after_is_honoured(client: PolicyClient, server: Scripted) -> None:
    server.script = [busy("0.4"), good]
    began = time.monotonic()
    client.act(OBS)
    assert time.monotonic() - began >= 0.4


def test_a_retry_after_beyond_the_timeout_fails_at_once(client: PolicyClient, server: Scripted) -> None:
    server.script = [busy("60")]
    began = time.monotonic()
    with pytest.raises(UnavailableError) as caught:
        client.act(OBS)
    assert time.monotonic() - began < 3.0
    assert caught.value.retry_after_s == 60.0
    assert len(server.requests) == 1


def test_a_dropped_connection_is_tried_again(client: PolicyClient, server: Scripted) -> None:
    server.script = [drop, good]
    assert client.act(OBS).tolist() == GOOD
    server.script = [drop]
    with pytest.raises(UnavailableError, match="dropped the connection"):
        client.act(OBS)
    assert len(server.requests) == 2 + 3


def test_an_error_that_is_not_503_is_not_retried(client: PolicyClient, server: Scripted) -> None:
    server.script = [says({"error": "policy 'arm' is broken", "code": "unsafe-action", "details": {"element": 1}}, 500)]
    with pytest.raises(ActionError, match=r"^policy 'arm' is broken$") as caught:
        client.act(OBS)
    assert caught.value.details == {"element": 1}
    assert len(server.requests) == 1


@pytest.mark.parametrize("status", [500, 502])  # Ray's HAProxy, for a replica that died; nginx
def test_a_gateways_error_is_tried_again(client: PolicyClient, server: Scripted, status: int) -> None:
    server.script = [says(b"Bad Gateway", status), good]
    assert client.act(OBS).tolist() == GOOD
    server.script = [says(b"Bad Gateway", status)]
    with pytest.raises(UnavailableError, match=f"answered {status} with 'Bad Gateway'"):
        client.act(OBS)
    assert len(server.requests) == 2 + 3


@pytest.mark.parametrize(
    ("answer", "kind", "sentence"),
    [
        (changed(seq=99), UnavailableError, "answered request 99, expected 1: the action was dropped"),
        (changed(seq=None), UnavailableError, "answered request None, expected 1"),
        (changed(policy="leg"), UnavailableError, "answered for policy 'leg'"),
        (changed(version="4"), UnavailableError, "version '4' of policy 'arm', but has no contract for that version"),
        (changed(version=4), UnavailableError, "version 4, expected 'arm': the action was dropped"),
        (changed(action=[0.1]), ActionError, r"has shape \(1,\), expected \(2,\)"),
        (changed(action=[[0.1, 0.2]]), ActionError, r"has shape \(1, 2\), expected \(2,\)"),
        (changed(action=[0.1, None]), ActionError, "expected numbers"),
        (changed(action="up"), ActionError, "is up, expected numbers"),
        (changed(action=[1, [2]]), ActionError, "expected numbers"),
        (changed(action=None), ActionError, "expected numbers"),
        (says(b'{"action": [NaN, 0.0], "policy": "arm", "version": "3", "seq": 1}'), RlservoError, "not"),
        (says(b"<html>hello</html>"), UnavailableError, "'<html>hello</html>', which is not JSON: is it an rlservo"),
        (says([1, 2]), UnavailableError, "answered with list, expected an object"),
        (says(b"", 200), UnavailableError, "an empty body"),
        (says({"error": "who are you", "code": "no-such-code"}, 401), UsageError, "who are you"),
        (says({"error": "gone", "code": "unknown-policy"}, 404), UnknownPolicyError, "gone"),
    ],
)
def test_an_answer_that_is_not_an_action_for_this_request_is_never_returned(
    client: PolicyClient, server: Scripted, answer: Answer, kind: type[RlservoError], sentence: str
) -> None:
    server.script = [answer]
    with pytest.raises(kind, match=sentence):
        client.act(OBS)
    assert len(server.requests) == 1


def test_every_request_has_a_number_of_its_own(client: PolicyClient, server: Scripted) -> None:
    for _ in range(3):
        client.act(OBS)
    assert [request["seq"] for request in server.requests] == [1, 2, 3]


def test_threads_get_the_answers_to_their_own_questions(client: PolicyClient, server: Scripted) -> None:
    def echo(handler: Handler, request: dict[str, Any]) -> None:
        time.sleep(0.005 * (request["seq"] % 3))
        handler.answer(200, reply(request, action=request["obs"][:2]))

    server.script = [echo]
    wrong: list[int] = []

    def ask(number: int) -> None:
        for step in range(10):
            sent = np.array([number / 8, step / 16, 0.0], np.float32)
            if not np.array_equal(client.act(sent), sent[:2]):
                wrong.append(number)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == [] and len(server.requests) == 40


@pytest.mark.parametrize(
    ("obs", "sentence"),
    [
        (np.array([0.0, np.nan, 0.0], np.float32), "element 1 is nan: expected a finite number"),
        ([0.0, 0.0, float("inf")], "element 2 is inf"),
        (np.full((2, 3), -np.inf), r"element \(0, 0\) is -inf"),
        ({"x": float("nan")}, "element 'x' is nan"),
        (["0.1", "0.2", "0.3"], "expected numbers"),
        ([[1.0], [1.0, 2.0]], "ragged"),
        ([None, 1.0, 2.0], "expected numbers"),
    ],
)
def test_what_is_not_finite_numbers_is_refused_before_it_is_sent(
    client: PolicyClient, server: Scripted, obs: Any, sentence: str
) -> None:
    with pytest.raises(ObservationError, match=sentence):
        client.act(obs)
    assert server.requests == []


def test_without_a_name_the_only_policy_is_taken_and_several_are_listed(server: Scripted) -> None:
    with PolicyClient(server.url) as client:
        assert client.contract.name == "arm"
    server.names = ["leg", "arm"]
    with (
        PolicyClient(server.url) as client,
        pytest.raises(UsageError, match="the server has 2 policies: name one of arm, leg"),
    ):
        _ = client.contract
    server.names = []
    with PolicyClient(server.url) as client, pytest.raises(UnknownPolicyError, match="no policy loaded"):
        _ = client.contract


def test_wait_until_ready_returns_when_the_server_comes_up() -> None:
    (port,) = free_ports(1)
    script = (
        "import sys, time; time.sleep(0.5); from http.server import *\n"
        "class H(BaseHTTPRequestHandler):\n"
        "    def do_GET(self): b = sys.argv[2].encode(); self.send_response(200); "
        "self.send_header('content-length', str(len(b))); self.end_headers(); self.wfile.write(b)\n"
        "    def log_message(self, *a): pass\n"
        "HTTPServer(('127.0.0.1', int(sys.argv[1])), H).serve_forever()"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(port), CONTRACT.model_dump_json()])
    try:
        with PolicyClient(f"http://127.0.0.1:{port}", "arm") as client:
            with pytest.raises(UnavailableError, match=r"was not ready within 0\.2 s: .*cannot be reached"):
                client.wait_until_ready(timeout_s=0.2)
            client.wait_until_ready(timeout_s=30.0)
            assert client.contract == CONTRACT
    finally:
        process.terminate()
        process.wait(10)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"url": "127.0.0.1:8000"}, "is not a server address"),
        ({"url": "http://host:99999"}, "is not a server address"),
        ({"url": "ftp://host"}, "is not a server address"),
        ({"url": "http://host?x=1"}, "has a query"),
        ({"url": "http://host", "timeout_s": 0.0}, "timeout_s must be above 0"),
        ({"url": "http://host", "timeout_s": float("nan")}, "timeout_s must be above 0"),
        ({"url": "http://host", "retries": -1}, "retries must be 0 or more"),
        ({"url": "http://host", "policy": ""}, "name is empty"),
        ({"url": "http://host", "version": "3"}, "without the policy's name"),
    ],
)
def test_arguments_that_cannot_work_are_refused_at_once(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        PolicyClient(**arguments)


def test_a_closed_client_says_so(client: PolicyClient) -> None:
    client.act(OBS)
    client.close()
    with pytest.raises(UsageError, match="closed"):
        client.act(OBS)


def test_the_client_imports_neither_server_nor_simulator_nor_training_code() -> None:
    heavy = ("ray", "torch", "gymnasium", "google.protobuf", "onnxruntime", "fastapi", "starlette", "mujoco")
    code = f"import sys, rlservo.client.policy_client; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
